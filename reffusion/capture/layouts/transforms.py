"""nerfstudio's transforms.json, and Blender's transforms_train.json with _test and _val."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.capture.layouts.capture import (
    NO_POINTS,
    Brought,
    Capture,
    Poses,
    counted,
    inverse,
    paths_below,
    rigid,
)
from reffusion.capture.layouts.depth_maps import points_from_depth
from reffusion.capture.layouts.frame_lens import frame_lens, load_frame_lens, read_number
from reffusion.capture.layouts.points import keep_points_in_frame
from reffusion.capture.names import list_pictures, name_views, normalize_path, pair_pictures
from reffusion.io.arrays import load_json
from reffusion.io.files import BadInput, shortened, there, understood
from reffusion.io.images import ENDINGS
from reffusion.io.ply import load_points

SPLITS = ("train", "test", "val")
USUAL = ("images", "images_2", "images_4", "images_8", "input", "rgb")  # folders of pictures


@dataclass(frozen=True)
class Frame:
    """A frame of a transforms file.

    Attributes:
        values: its keys over the file's.
        listed: its file_path.
        source: the file.
        split: "", or of Blender's files "train", "test" or "val".
    """

    values: dict[str, Any]
    listed: str
    source: Path
    split: str


def split_files(folder: Path) -> dict[str, Path]:
    """Split -> file: {"": transforms.json}, or Blender's transforms_train.json with _test and _val; empty without."""
    if there(folder / "transforms.json"):
        return {"": folder / "transforms.json"}
    found = {
        split: folder / f"transforms_{split}.json" for split in SPLITS if there(folder / f"transforms_{split}.json")
    }
    return found if "train" in found else {}


def read(folder: Path, images: str | None) -> Capture:
    """See `load_capture`. Of Blender's splits, test views are those of _test, without it those of _val."""
    sources = split_files(folder)
    unread = [sources.pop("val").name] if {"test", "val"} <= sources.keys() else []
    frames = [frame for split, source in sources.items() for frame in _load_frames(source, split)]
    source = next(iter(sources.values()))
    files = _find_pictures(folder, images, frames)
    if not files:
        raise BadInput(f"{source}: none of its {len(frames)} frames has a picture; name their folder as `images`")
    missing = [frame.listed for k, frame in enumerate(frames) if k not in files]
    root = Path(os.path.commonpath([path.parent for path in files.values()]))
    of_path = {path.relative_to(root).as_posix(): frames[k] for k, path in files.items()}
    if len(of_path) < len(files):
        raise BadInput(f"{source}: two of its frames are the same picture; remove one")
    views = name_views(list(of_path))
    pictures = {view: root / path for view, path in views.items()}
    placed = {view: of_path[path] for view, path in views.items()}
    lenses = {view: load_frame_lens(each.values, pictures[view], each.source) for view, each in placed.items()}
    poses = {view: _frame_pose(each.values, view, each.source) for view, each in placed.items()}
    found = Poses(lenses, poses, *NO_POINTS, {})
    points, said = _points(folder, source, frames[0].values, placed, found, pictures)
    paths = paths_below(root, pictures)
    warnings = (
        counted(f"of the {len(frames)} frames in {source.name} have no picture", sorted(missing)),
        counted("beside the test views are left out", unread),
        *said,
    )
    return Capture(
        "transforms",
        pictures,
        {view: (*paths[view], each.listed) for view, each in placed.items()} | {path: (path,) for path in missing},
        replace(found, points=points[0], colors=points[1]),
        source,
        next(iter(pictures.values())).parent if len({path.parent for path in pictures.values()}) == 1 else root,
        tuple(filter(None, warnings)),
        tuple(view for view, each in placed.items() if each.split in ("test", "val")),
        _named_files(folder, placed, "mask_path"),
        tuple(_named_files(folder, placed, "depth_file_path").values()),
    )


def read_cameras(folder: Path) -> Poses:
    """The lenses and poses alone, of a capture whose pictures are not there; their sizes are the file's w and h."""
    frames = [each for split, source in split_files(folder).items() for each in _load_frames(source, split)]
    listed = {normalize_path(each.listed): each for each in frames}
    if len(listed) < len(frames):
        twice = next(path for path in listed if sum(normalize_path(each.listed) == path for each in frames) > 1)
        raise BadInput(f"{frames[0].source}: two frames are called '{Path(twice).stem}'; rename one")
    lenses, poses = {}, {}
    for view, path in name_views(list(listed)).items():
        each = listed[path]
        if "w" not in each.values or "h" not in each.values:
            raise BadInput(
                f"{each.source}: neither pictures nor w and h of '{Path(path).name}'; give its size in pixels"
            )
        lenses[view] = frame_lens(each.values, Path(path), each.source, (0, 0))
        poses[view] = _frame_pose(each.values, view, each.source)
    return Poses(lenses, poses, *NO_POINTS, {})


def has_pictures(folder: Path) -> bool:
    """Is a picture of one of its frames there?"""
    frames = [each for split, source in split_files(folder).items() for each in _load_frames(source, split)]
    return bool(_find_pictures(folder, None, frames))


def _load_frames(source: Path, split: str) -> list[Frame]:
    record = load_json(source)
    return [Frame({**record, **frame}, frame["file_path"], source, split) for frame in _frames(record, source)]


def _frames(record: object, source: Path) -> list[dict]:
    frames = record.get("frames") if isinstance(record, dict) else None
    if not isinstance(frames, list) or not frames:
        raise BadInput(f"{source}: it has no list `frames`")
    for frame in frames:
        if not isinstance(frame, dict) or "transform_matrix" not in frame or not _is_path(frame.get("file_path")):
            raise BadInput(f"{source}: a frame without file_path or transform_matrix: {shortened(frame)}")
    return frames


def _is_path(value: object) -> bool:
    return isinstance(value, str) and bool(Path(value).name) and "\0" not in value


def _find_pictures(folder: Path, images: str | None, frames: list[Frame]) -> dict[int, Path]:
    """Number of a frame -> its picture, of those that have one.

    As listed, the ending may be missing; with `images`, or where none is as listed, the pictures of that folder or of a
    usual one that are called like it (`pair_pictures`): paths of another machine, or of another size's folder.
    """
    listed = {k: path for k, frame in enumerate(frames) if (path := _as_listed(folder, frame.listed)) is not None}
    if images is None and listed:
        return listed
    for place in [images] if images is not None else USUAL:
        names = list_pictures(folder / place, nested=True)
        pairs = pair_pictures({k: frame.listed for k, frame in enumerate(frames)}, names)
        if pairs:
            return {k: folder / place / name for k, name in sorted(pairs.items())}
    return {}


def _as_listed(folder: Path, listed: str) -> Path | None:
    """The file of a path in the record, usual endings tried; None where it is not there."""
    base = folder / listed.replace("\\", "/")
    if base.suffix.lower() in ENDINGS:
        there(base)  # a folder or a pipe of that name is no missing picture
    candidates = [base, *(base.with_name(base.name + end) for e in ENDINGS for end in (e, e.upper()))]
    return next((path for path in candidates if path.is_file()), None)


def _named_files(folder: Path, placed: Mapping[str, Frame], key: str) -> dict[str, Path]:
    """View name -> the file that its frame names under a key (`mask_path`, `depth_file_path`), where it is there."""
    named = {view: each.values[key] for view, each in placed.items() if _is_path(each.values.get(key))}
    files = {view: folder / path.replace("\\", "/") for view, path in named.items()}
    return {view: path for view, path in files.items() if path.is_file()}


def _frame_pose(frame: dict, name: str, source: Path) -> np.ndarray:
    """OpenGL camera-to-world (y up, looking along -z) -> [4, 4] world-to-camera of ours."""
    with understood(source, f"a number in each place of the transform_matrix of '{name}'"):
        matrix = np.array(frame["transform_matrix"])
        if matrix.dtype.kind not in "fiu":
            raise BadInput(f"{source}: the transform_matrix of '{name}' is no 4x4 matrix of numbers")
        matrix = matrix.astype(np.float64)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise BadInput(f"{source}: the transform_matrix of '{name}' is no 4x4 matrix")
    camera_to_world = np.eye(4)
    camera_to_world[:3] = matrix[:3] * (1.0, -1.0, -1.0, 1.0)
    return inverse(rigid(camera_to_world, name, source))


def _points(
    folder: Path,
    source: Path,
    record: dict[str, Any],
    placed: Mapping[str, Frame],
    poses: Poses,
    pictures: Mapping[str, Path],
) -> tuple[Brought, list[str | None]]:
    """The points of `ply_file_path` (or sparse_pc.ply) in the frame of the poses, else of the frames' depth maps; and
    sentences about what is not used.

    `applied_transform` and `applied_scale` say what was done to poses and points alike: there is nothing to undo.
    """
    listed = record.get("ply_file_path")
    if listed is not None and not _is_path(listed):
        raise BadInput(f"{source}: ply_file_path = {shortened(listed)} is no file's name")
    path = folder / (listed.replace("\\", "/") if listed else "sparse_pc.ply")
    said: list[str | None] = []
    if there(path):
        points, refused = keep_points_in_frame(path, load_points(path), poses, pictures)
        if len(points[0]):
            return points, []
        said.append(refused)
    elif listed:
        said.append(f"{path}: named by {source.name}, but missing")
    if depths := _named_files(folder, placed, "depth_file_path"):
        scale = read_number(record, "integer_depth_scale", 1e-3, path, source)
        made = points_from_depth(depths, scale, pictures, poses.lenses, poses.world_to_camera)
        kept, refused = keep_points_in_frame(next(iter(depths.values())).parent, made, poses, pictures)
        said.append(refused or f"{len(kept[0])} points are made of the depth maps (depth_file_path) of {source.name}")
        return kept, said
    return NO_POINTS, said

"""Reads nerfstudio's transforms.json, and Blender's transforms_train.json with _test and _val."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.capture.layouts.capture import (
    NO_POINTS,
    Capture,
    PointCloud,
    Poses,
    count_message,
    invert_pose,
    nearest_rigid,
    relative_paths,
)
from reffusion.capture.layouts.depth_maps import points_from_depth
from reffusion.capture.layouts.frame_lens import frame_lens, load_frame_lens, read_number
from reffusion.capture.layouts.points import keep_points_in_frame
from reffusion.capture.names import list_pictures, name_views, normalize_path, pair_pictures
from reffusion.io.arrays import load_json
from reffusion.io.files import BadInput, as_bad_input, is_file, shorten
from reffusion.io.images import ENDINGS
from reffusion.io.ply import load_points

SPLITS = ("train", "test", "val")
USUAL = ("images", "images_2", "images_4", "images_8", "input", "rgb")  # folders of pictures


@dataclass(frozen=True)
class Frame:
    """A frame of a transforms file.

    Attributes:
        values: its keys over the file's.
        file_path: its key of that name, the path of the picture.
        source: the file.
        split: "", or for Blender's files "train", "test" or "val".
    """

    values: dict[str, Any]
    file_path: str
    source: Path
    split: str


def split_files(folder: Path) -> dict[str, Path]:
    """Split -> file: {"": transforms.json}, or Blender's transforms_train.json with _test and _val; empty without
    either."""
    if is_file(folder / "transforms.json"):
        return {"": folder / "transforms.json"}
    found = {
        split: folder / f"transforms_{split}.json" for split in SPLITS if is_file(folder / f"transforms_{split}.json")
    }
    return found if "train" in found else {}


def read(folder: Path, images: str | None) -> Capture:
    """Read a scene in this layout, see `load_capture`. Blender's test views are those of _test, or without it those of
    _val."""
    sources = split_files(folder)
    unread = [sources.pop("val").name] if {"test", "val"} <= sources.keys() else []
    frames = [frame for split, source in sources.items() for frame in _load_frames(source, split)]
    source = next(iter(sources.values()))
    files = _find_pictures(folder, images, frames)
    if not files:
        raise BadInput(f"{source}: none of its {len(frames)} frames has a picture; name their folder as `images`")
    missing = [frame.file_path for k, frame in enumerate(frames) if k not in files]
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
    points, messages = _points(folder, source, frames[0].values, placed, found, pictures)
    paths = relative_paths(root, pictures)
    warnings = (
        count_message(f"of the {len(frames)} frames in {source.name} have no picture", sorted(missing)),
        count_message("beside the test views are left out", unread),
        *messages,
    )
    return Capture(
        "transforms",
        pictures,
        {view: (*paths[view], each.file_path) for view, each in placed.items()} | {path: (path,) for path in missing},
        replace(found, points=points[0], colors=points[1]),
        source,
        next(iter(pictures.values())).parent if len({path.parent for path in pictures.values()}) == 1 else root,
        tuple(filter(None, warnings)),
        tuple(view for view, each in placed.items() if each.split in ("test", "val")),
        _named_files(folder, placed, "mask_path"),
        tuple(_named_files(folder, placed, "depth_file_path").values()),
    )


def read_cameras(folder: Path) -> Poses:
    """Lenses and poses alone, of a capture whose pictures are missing; sizes are the file's w and h."""
    frames = [each for split, source in split_files(folder).items() for each in _load_frames(source, split)]
    listed = {normalize_path(each.file_path): each for each in frames}
    if len(listed) < len(frames):
        twice = next(path for path in listed if sum(normalize_path(each.file_path) == path for each in frames) > 1)
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
    """Does a picture of one of the frames exist?"""
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
            raise BadInput(f"{source}: a frame without file_path or transform_matrix: {shorten(frame)}")
    return frames


def _is_path(value: object) -> bool:
    return isinstance(value, str) and bool(Path(value).name) and "\0" not in value


def _find_pictures(folder: Path, images: str | None, frames: list[Frame]) -> dict[int, Path]:
    """Index of a frame -> its picture, for the frames that have one.

    Pictures lie where file_path says, possibly with another ending. With `images`, or where none lies there, pictures
    are looked for in that folder, or in a usual one, by their names (`pair_pictures`): file_path may be of another
    machine, or name the folder of another size.
    """
    listed = {
        k: path for k, frame in enumerate(frames) if (path := _existing_picture(folder, frame.file_path)) is not None
    }
    if images is None and listed:
        return listed
    for place in [images] if images is not None else USUAL:
        names = list_pictures(folder / place, nested=True)
        pairs = pair_pictures({k: frame.file_path for k, frame in enumerate(frames)}, names)
        if pairs:
            return {k: folder / place / name for k, name in sorted(pairs.items())}
    return {}


def _existing_picture(folder: Path, listed: str) -> Path | None:
    """The file that file_path names, with the usual endings tried; None where it does not exist."""
    base = folder / listed.replace("\\", "/")
    if base.suffix.lower() in ENDINGS:
        is_file(base)  # a folder or a pipe of that name is no missing picture
    candidates = [base, *(base.with_name(base.name + end) for e in ENDINGS for end in (e, e.upper()))]
    return next((path for path in candidates if path.is_file()), None)


def _named_files(folder: Path, placed: Mapping[str, Frame], key: str) -> dict[str, Path]:
    """View name -> the file that its frame names under a key (`mask_path`, `depth_file_path`), where it exists."""
    named = {view: each.values[key] for view, each in placed.items() if _is_path(each.values.get(key))}
    files = {view: folder / path.replace("\\", "/") for view, path in named.items()}
    return {view: path for view, path in files.items() if path.is_file()}


def _frame_pose(frame: dict, name: str, source: Path) -> np.ndarray:
    """OpenGL camera-to-world (y up, looking along -z) -> our world-to-camera [4, 4]."""
    with as_bad_input(source, f"a number in each place of the transform_matrix of '{name}'"):
        matrix = np.array(frame["transform_matrix"])
        if matrix.dtype.kind not in "fiu":
            raise BadInput(f"{source}: the transform_matrix of '{name}' is no 4x4 matrix of numbers")
        matrix = matrix.astype(np.float64)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise BadInput(f"{source}: the transform_matrix of '{name}' is no 4x4 matrix")
    camera_to_world = np.eye(4)
    camera_to_world[:3] = matrix[:3] * (1.0, -1.0, -1.0, 1.0)
    return invert_pose(nearest_rigid(camera_to_world, name, source))


def _points(
    folder: Path,
    source: Path,
    record: dict[str, Any],
    placed: Mapping[str, Frame],
    poses: Poses,
    pictures: Mapping[str, Path],
) -> tuple[PointCloud, list[str | None]]:
    """The points of `ply_file_path` (or sparse_pc.ply) in the frame of the poses, else those of the depth maps; and
    sentences about what is not used.

    `applied_transform` and `applied_scale` describe what was done to poses and points alike, so there is nothing to
    undo.
    """
    listed = record.get("ply_file_path")
    if listed is not None and not _is_path(listed):
        raise BadInput(f"{source}: ply_file_path = {shorten(listed)} is no file's name")
    path = folder / (listed.replace("\\", "/") if listed else "sparse_pc.ply")
    messages: list[str | None] = []
    if is_file(path):
        points, refused = keep_points_in_frame(path, load_points(path), poses, pictures)
        if len(points[0]):
            return points, []
        messages.append(refused)
    elif listed:
        messages.append(f"{path}: named by {source.name}, but missing")
    if depths := _named_files(folder, placed, "depth_file_path"):
        scale = read_number(record, "integer_depth_scale", 1e-3, path, source)
        depth_points = points_from_depth(depths, scale, pictures, poses.lenses, poses.world_to_camera)
        points_in_frame, refused = keep_points_in_frame(
            next(iter(depths.values())).parent, depth_points, poses, pictures
        )
        messages.append(
            refused or f"{len(points_in_frame[0])} points are made of the depth maps (depth_file_path) of {source.name}"
        )
        return points_in_frame, messages
    return NO_POINTS, messages

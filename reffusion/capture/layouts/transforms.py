"""Reads a capture in the layout "transforms": nerfstudio's transforms.json, or Blender's transforms_<split>.json.

Blender's files are transforms_train.json and optionally transforms_test.json and transforms_val.json.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.capture.layouts.capture import (
    AS_GIVEN,
    NO_POINTS,
    Capture,
    Correction,
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
USUAL = ("images", "images_2", "images_4", "images_8", "input", "rgb")  # usual folders of pictures


@dataclass(frozen=True)
class Frame:
    """A frame of a transforms file.

    Attributes:
        values: the keys of the frame, together with the keys of the whole file that the frame does not have.
        file_path: value of the frame's key `file_path`: a path of its picture, which need not exist.
        source: the transforms file.
        split: "" for transforms.json; "train", "test" or "val" for Blender's files.
    """

    values: dict[str, Any]
    file_path: str
    source: Path
    split: str


def split_files(folder: Path) -> dict[str, Path]:
    """Return split -> transforms file of a scene folder.

    This is {"": transforms.json} if that file exists; else Blender's files that exist, by "train", "test" and "val", if
    transforms_train.json is among them; else empty.
    """
    if is_file(folder / "transforms.json"):
        return {"": folder / "transforms.json"}
    found = {
        split: folder / f"transforms_{split}.json" for split in SPLITS if is_file(folder / f"transforms_{split}.json")
    }
    return found if "train" in found else {}


def read(folder: Path, images: str | None, correction: Correction = AS_GIVEN) -> Capture:
    """Read a scene folder with transforms files.

    The test views of Blender's files are the frames of transforms_test.json, or without that file those of
    transforms_val.json, which is otherwise not read. Frames without a picture are left out. `Capture.warnings` tells
    both.

    Args:
        images: folder of pictures, relative to the scene. None to use the paths in the frames, or the usual folders if
            no frame's path leads to a picture.
        correction: what is changed in the poses.

    Raises:
        BadInput: a file or frame is wrong; no frame has a picture; or two frames have the same picture.
    """
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
    found = correction.apply(Poses(lenses, poses, *NO_POINTS, {}))
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
    """Read the lenses and poses of all frames of all transforms files, without pictures. The result has no points.

    Raises:
        BadInput: a file or frame is wrong; a frame has no w and h, which tell the size of its picture; or two frames
            have the same file_path.
    """
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
    """Return whether a picture of at least one frame exists."""
    frames = [each for split, source in split_files(folder).items() for each in _load_frames(source, split)]
    return bool(_find_pictures(folder, None, frames))


def _load_frames(source: Path, split: str) -> list[Frame]:
    """Read the frames of a transforms file. `split`: see `Frame`."""
    record = load_json(source)
    return [Frame({**record, **frame}, frame["file_path"], source, split) for frame in _frames(record, source)]


def _frames(record: object, source: Path) -> list[dict]:
    """Return the list `frames` of a parsed transforms file. Raises BadInput if it is missing or a frame lacks a key."""
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
    """Return index of a frame -> its picture file, for the frames that have a picture.

    A picture lies at the frame's file_path, which may lack the ending. If `images` is given, or if no picture lies at
    such a path, pictures are searched by their names (`pair_pictures`) in the folder `images`, or in the usual folders.
    This is because a file_path may come from another machine, or name the folder of another picture size.

    Args:
        folder: the scene's folder.
        images: folder of pictures, relative to the scene, or None.
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
    """Return the file that a frame's file_path (`listed`) names, as it is or with an ending added; None if missing."""
    base = folder / listed.replace("\\", "/")
    if base.suffix.lower() in ENDINGS:
        is_file(base)  # raises BadInput for a folder or pipe, which would else count as a missing picture
    candidates = [base, *(base.with_name(base.name + end) for e in ENDINGS for end in (e, e.upper()))]
    return next((path for path in candidates if path.is_file()), None)


def _named_files(folder: Path, placed: Mapping[str, Frame], key: str) -> dict[str, Path]:
    """Return view name -> the existing file that its frame names under `key`, such as mask_path or depth_file_path."""
    named = {view: each.values[key] for view, each in placed.items() if _is_path(each.values.get(key))}
    files = {view: folder / path.replace("\\", "/") for view, path in named.items()}
    return {view: path for view, path in files.items() if path.is_file()}


def _frame_pose(frame: dict, name: str, source: Path) -> np.ndarray:
    """Return the world-to-camera pose [4, 4] (y down, looking along +z) of a frame.

    The key transform_matrix is OpenGL's camera-to-world pose (y up, looking along -z), 3x4 or 4x4.

    Args:
        frame: the keys of the frame.
        name, source: the view and the transforms file, for messages.

    Raises:
        BadInput: the matrix is not of numbers, has another shape, or is no rigid pose.
    """
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
    """Return the sparse points of a capture, in the frame of the poses.

    The points are read from the file that the key ply_file_path names, or from sparse_pc.ply. If there are none, or if
    they are not in the frame of the poses, points are made from the depth maps that the frames name. The keys
    applied_transform and applied_scale are ignored: they describe what was done to both poses and points.

    Args:
        source: the transforms file.
        record: the keys of the file.
        placed: view name -> its frame.
        pictures: view name -> picture file.

    Returns:
        The points, perhaps none; and messages to the user (None among them is no message).
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

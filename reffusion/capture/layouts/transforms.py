"""Reads a capture in the layout "transforms": nerfstudio's transforms.json, or Blender's transforms_<split>.json.

Blender's files are transforms_train.json and optionally transforms_test.json and transforms_val.json. `ns-export
cameras` writes transforms_train.json and transforms_eval.json as lists of frames; both are read if they have focal
lengths.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.capture.checks.sparse_points import keep_points_in_frame
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
from reffusion.capture.layouts.pose_matrices import read_matrices
from reffusion.capture.layouts.transforms_lens import frame_lens, load_frame_lens, read_number
from reffusion.capture.names import list_pictures, name_views, normalize_path, pair_pictures
from reffusion.io.arrays import load_json
from reffusion.io.files import BadInput, is_file, shorten
from reffusion.io.images import ENDINGS
from reffusion.io.ply import load_points

HELD_OUT = ("test", "val", "eval")  # names of splits; the first that exists has the test views
UNUSED = "unused"  # split of frames that none of the file's lists names
MATRIX, EXPORTED = "transform_matrix", "transform"  # keys of a frame's matrix; the second is of `ns-export cameras`
USUAL = ("images", "images_2", "images_4", "images_8", "input", "rgb")  # usual folders of pictures


@dataclass(frozen=True)
class Frame:
    """A frame of a transforms file.

    Attributes:
        values: the keys of the frame, together with the keys of the whole file that the frame does not have.
        file_path: value of the frame's key `file_path`: a path of its picture, which need not exist.
        source: the transforms file.
        split: "train", one of `HELD_OUT`, or `UNUSED`, by the file's name or by the file's own lists; "" if neither
            tells.
        matrix: [4, 4] float64, OpenGL's camera-to-world pose (y up, looking along -z).
        transposed: True if the file has the matrix transposed.
    """

    values: dict[str, Any]
    file_path: str
    source: Path
    split: str
    matrix: np.ndarray
    transposed: bool


def split_files(folder: Path) -> dict[str, Path]:
    """Return split -> transforms file of a scene folder.

    This is {"": transforms.json} if that file exists; else Blender's files that exist, by "train" and `HELD_OUT`, if
    transforms_train.json is among them and has focal lengths; else empty.
    """
    if is_file(folder / "transforms.json"):
        return {"": folder / "transforms.json"}
    files = {split: folder / f"transforms_{split}.json" for split in ("train", *HELD_OUT)}
    found = {split: path for split, path in files.items() if is_file(path)}
    return found if "train" in found and not _is_without_lenses(found["train"]) else {}


def _is_without_lenses(path: Path) -> bool:
    """Return whether a file is a list of poses without focal lengths, as `ns-export cameras` writes it."""
    content = path.read_bytes()
    return content.lstrip().startswith(b"[") and not any(key in content for key in (b'"fl_x"', b'"camera_angle_x"'))


def read(folder: Path, images: str | None, correction: Correction = AS_GIVEN) -> Capture:
    """Read a scene folder with transforms files (`split_files`), at least one.

    The test views of Blender's files are the frames of transforms_test.json, or without that file those of
    transforms_val.json, which is otherwise not read. Those of transforms.json are its `test_filenames`, or without them
    its `val_filenames`. Frames without a picture are left out, and so are frames that are listed again.
    `Capture.warnings` tells this.

    Args:
        images: folder of pictures, relative to the scene. None to use the paths in the frames, or the usual folders if
            no frame's path leads to a picture.
        correction: what is changed in the poses.

    Raises:
        BadInput: a file or frame is wrong; no frame has a picture; or two frames have the same picture and differ.
    """
    sources = split_files(folder)
    if not sources:
        raise BadInput(f"{folder}: no transforms.json, and no transforms_train.json; correct `layout` in scene.yaml")
    unread = [sources.pop(split).name for split in [each for each in HELD_OUT if each in sources][1:]]
    frames = [frame for split, source in sources.items() for frame in _load_frames(source, split)]
    source = next(iter(sources.values()))
    files = _find_pictures(folder, images, frames)
    if not files:
        raise BadInput(f"{source}: none of its {len(frames)} frames has a picture; {_find_remedy(folder)}")
    missing = [frame.file_path for k, frame in enumerate(frames) if k not in files]
    root = Path(os.path.commonpath([path.parent for path in files.values()]))
    of_path, repeated = _drop_repeated((path.relative_to(root).as_posix(), frames[k]) for k, path in files.items())
    views = name_views(list(of_path))
    pictures = {view: root / path for view, path in views.items()}
    placed = {view: of_path[path] for view, path in views.items()}
    lenses = {view: load_frame_lens(each.values, pictures[view], each.source) for view, each in placed.items()}
    poses = {view: _frame_pose(each, view) for view, each in placed.items()}
    test, unused, split_messages = _split(placed)
    found = correction.apply(Poses(lenses, poses, *NO_POINTS, {}))
    points, messages = _points(folder, source, frames[0].values, placed, found, pictures)
    paths = relative_paths(root, pictures)
    beside = [path for key in ("mask_path", "depth_file_path") for path in _named_files(folder, placed, key).values()]
    rest = _unlisted_pictures(root, [*files.values(), *beside])
    warnings = (
        count_message(f"pictures are not in {source.name} and are left out", rest),
        count_message(f"of the {len(frames)} frames in {source.name} have no picture", sorted(missing)),
        count_message("beside the test views are left out", unread),
        count_message(f"of the {len(frames)} frames in {source.name} are listed again with the same pose", repeated),
        *(
            f"{name}: its matrices are transposed (their last column is 0 0 0 1) and are read as such"
            for name in dict.fromkeys(each.source.name for each in frames if each.transposed)
        ),
        *split_messages,
        *messages,
    )
    return Capture(
        "transforms",
        pictures,
        {view: (*paths[view], each.file_path) for view, each in placed.items()}
        | {path: (path,) for path in missing + rest},
        replace(found, points=points[0], colors=points[1]),
        source,
        next(iter(pictures.values())).parent if len({path.parent for path in pictures.values()}) == 1 else root,
        tuple(filter(None, warnings)),
        test,
        unused,
        _named_files(folder, placed, "mask_path"),
        tuple(_named_files(folder, placed, "depth_file_path").values()),
    )


def read_cameras(folder: Path) -> Poses:
    """Read the lenses and poses of all frames of all transforms files, without pictures. The result has no points.

    Raises:
        BadInput: a file or frame is wrong; a frame has no w and h, which tell the size of its picture; or two frames
            have the same file_path and differ.
    """
    frames = [each for split, source in split_files(folder).items() for each in _load_frames(source, split)]
    listed, _ = _drop_repeated((normalize_path(each.file_path), each) for each in frames)
    lenses, poses = {}, {}
    for view, path in name_views(list(listed)).items():
        each = listed[path]
        if "w" not in each.values or "h" not in each.values:
            raise BadInput(
                f"{each.source}: neither pictures nor w and h of '{Path(path).name}'; give its size in pixels"
            )
        lenses[view] = frame_lens(each.values, Path(path), each.source, (0, 0))
        poses[view] = _frame_pose(each, view)
    return Poses(lenses, poses, *NO_POINTS, {})


def has_pictures(folder: Path) -> bool:
    """Return whether a picture of at least one frame exists; raises BadInput if a file or frame is wrong."""
    frames = [each for split, source in split_files(folder).items() for each in _load_frames(source, split)]
    return bool(_find_pictures(folder, None, frames))


def _load_frames(source: Path, split: str) -> list[Frame]:
    """Read the frames of a transforms file. `split`: the split of all frames, unless the file itself has lists."""
    record = load_json(source)
    shared, frames = (record if isinstance(record, dict) else {}), _frames(record, source)
    names = [frame["file_path"] for frame in frames]
    matrices, transposed = read_matrices([frame.get(MATRIX, frame.get(EXPORTED)) for frame in frames], names, source)
    splits = {**dict.fromkeys(names, split), **_listed_splits(shared, names, source)}
    return [
        Frame({**shared, **frame}, name, source, splits[name], matrix, transposed)
        for frame, name, matrix in zip(frames, names, matrices, strict=True)
    ]


def _frames(record: object, source: Path) -> list[dict]:
    """Return the frames of a parsed transforms file, its list `frames` or the file itself; raises BadInput if wrong."""
    frames = record.get("frames") if isinstance(record, dict) else record
    if not isinstance(frames, list):
        raise BadInput(f"{source}: it has no list `frames`")
    if not frames:
        raise BadInput(f"{source}: its list `frames` is empty; export the poses again")
    for frame in frames:
        if not isinstance(frame, dict) or not frame.keys() & {MATRIX, EXPORTED} or not _is_path(frame.get("file_path")):
            raise BadInput(f"{source}: a frame without file_path or transform_matrix: {shorten(frame)}")
    return frames


def _listed_splits(shared: Mapping[str, Any], names: list[str], source: Path) -> dict[str, str]:
    """Return file_path -> split by the lists `*_filenames`, {} without lists; raises BadInput for an unknown name."""
    lists = {split: shared[f"{split}_filenames"] for split in ("train", *HELD_OUT) if shared.get(f"{split}_filenames")}
    # a frame in no list is unused, unless there is no train_filenames
    splits = dict.fromkeys(names, UNUSED if "train" in lists else "train") if lists else {}
    # the first of the lists of `HELD_OUT` counts, and takes precedence over train_filenames
    for split in [each for each in lists if each == "train"] + [each for each in HELD_OUT if each in lists][:1]:
        listed = lists[split]
        if not isinstance(listed, list) or not all(_is_path(name) for name in listed):
            raise BadInput(f"{source}: {split}_filenames = {shorten(listed)} is no list of names")
        found = pair_pictures({name: name for name in listed}, names)
        if lost := sorted(set(listed) - found.keys()):
            raise BadInput(f"{source}: {split}_filenames: '{shorten(lost[0])}' is no frame's file_path; correct it")
        splits |= dict.fromkeys(found.values(), split)
    return splits


def _split(placed: Mapping[str, Frame]) -> tuple[tuple[str, ...], tuple[str, ...], list[str | None]]:
    """Return the test views, the views that are neither training nor test views, and messages to the user."""
    held_out = next((split for split in HELD_OUT if any(each.split == split for each in placed.values())), None)
    test = tuple(view for view, each in placed.items() if each.split == held_out)
    unused = [view for view, each in placed.items() if each.split not in ("", "train", held_out)]
    return (
        test,
        tuple(unused),
        [count_message("frames are neither in the list of training views nor of test views", unused)],
    )


def _drop_repeated(listed: Iterable[tuple[str, Frame]]) -> tuple[dict[str, Frame], list[str]]:
    """Return path -> frame, and the repeated paths; raises BadInput if pose, lens or split of a repetition differ."""
    frames: dict[str, Frame] = {}
    repeated = []
    for path, frame in listed:
        first = frames.setdefault(path, frame)
        if first is frame:
            continue
        lenses = [frame_lens(each.values, Path(path), each.source, (1, 1)) for each in (first, frame)]
        alike = {
            "pose": np.allclose(first.matrix, frame.matrix, rtol=1e-6, atol=1e-9),
            "lens": lenses[0] == lenses[1],
            "split": first.split == frame.split,
        }
        if differs := [what for what, same in alike.items() if not same]:
            raise BadInput(f"{frame.source}: '{path}' is listed twice, with another {differs[0]} each time; remove one")
        repeated.append(path)
    return frames, repeated


def _is_path(value: object) -> bool:
    return isinstance(value, str) and bool(Path(value).name) and "\0" not in value


def _find_pictures(folder: Path, images: str | None, frames: list[Frame]) -> dict[int, Path]:
    """Return index of a frame -> picture file, at its file_path, or by name in the folder `images` or usual ones."""
    listed = {
        k: path for k, frame in enumerate(frames) if (path := _existing_picture(folder, frame.file_path)) is not None
    }
    if images is None and listed:
        return listed
    # a file_path may come from another machine, or name the folder of another picture size
    for place in [images] if images is not None else USUAL:
        names = list_pictures(folder / place, nested=True)
        pairs = pair_pictures({k: frame.file_path for k, frame in enumerate(frames)}, names)
        if pairs:
            return {k: folder / place / name for k, name in sorted(pairs.items())}
    return {}


def _find_remedy(folder: Path) -> str:
    """Return what the user may do if no frame has a picture, as a part of a sentence."""
    odd = min((path.name for path in folder.iterdir() if "\\" in path.name), default=None)
    if odd is None:
        return "name their folder as `images`"
    return (
        f"the folder holds files called `{odd}`, as some unzip programs write archives made on Windows; unpack it "
        "again with another program"
    )


def _unlisted_pictures(root: Path, listed: Sequence[Path]) -> list[str]:
    """Return the pictures, relative to `root`, that lie beside those of the frames and that no frame lists, sorted."""
    folders = {path.parent for path in listed if root in path.parents}
    found = {folder / name for folder in folders for name in list_pictures(folder)}
    return sorted(path.relative_to(root).as_posix() for path in found - {*listed})


def _existing_picture(folder: Path, listed: str) -> Path | None:
    """Return the file that a frame's file_path (`listed`) names, as it is or with an ending added; None if missing."""
    base = folder / listed.replace("\\", "/")
    if base.suffix.lower() in ENDINGS:
        is_file(base)  # raises BadInput for a folder or pipe, which would else count as a missing picture
    candidates = [base, *(base.with_name(base.name + end) for e in ENDINGS for end in (e, e.upper()))]
    return next((path for path in candidates if path.is_file()), None)


def _named_files(folder: Path, placed: Mapping[str, Frame], key: str) -> dict[str, Path]:
    """Return view name -> the existing file that its frame names under `key`, such as mask_path or depth_file_path."""
    files = {view: folder / path.replace("\\", "/") for view, path in _listed_paths(placed, key).items()}
    return {view: path for view, path in files.items() if path.is_file()}


def _listed_paths(placed: Mapping[str, Frame], key: str) -> dict[str, str]:
    """Return view name -> the path, perhaps of a missing file, that its frame names under `key`."""
    return {view: each.values[key] for view, each in placed.items() if _is_path(each.values.get(key))}


def _frame_pose(frame: Frame, name: str) -> np.ndarray:
    """Return a frame's world-to-camera pose [4, 4] (y down, looking along +z); raises BadInput if it is not rigid."""
    camera_to_world = np.eye(4)
    camera_to_world[:3] = frame.matrix[:3] * (1.0, -1.0, -1.0, 1.0)
    return invert_pose(nearest_rigid(camera_to_world, name, frame.source))


def _points(
    folder: Path,
    source: Path,
    record: dict[str, Any],
    placed: Mapping[str, Frame],
    poses: Poses,
    pictures: Mapping[str, Path],
) -> tuple[PointCloud, list[str | None]]:
    """Return a capture's sparse points in the frame of the poses, perhaps none, and messages to the user (or None)."""
    listed = record.get("ply_file_path")
    if listed is not None and not _is_path(listed):
        raise BadInput(f"{source}: ply_file_path = {shorten(listed)} is no file's name")
    # The keys applied_transform and applied_scale are ignored: they describe what was done to both poses and points.
    path = folder / (listed.replace("\\", "/") if listed else "sparse_pc.ply")
    messages: list[str | None] = []
    if is_file(path):
        points, refused = keep_points_in_frame(path, load_points(path), poses, pictures)
        if len(points[0]):
            return points, []
        messages.append(refused)
    elif listed:
        messages.append(f"{path}: named by {source.name}, but missing")
    # without points in the frame of the poses, points are made from depth maps
    in_poses = {view: each for view, each in placed.items() if view in poses.lenses}  # a correction may leave out views
    listed_depths = _listed_paths(in_poses, "depth_file_path")
    depths = _named_files(folder, in_poses, "depth_file_path")
    if lost := [path for view, path in listed_depths.items() if view not in depths]:
        messages.append(
            f"{len(lost)} of {len(listed_depths)} files of depth_file_path in {source.name} are missing "
            f"(first: {shorten(lost[0])})"
        )
    if depths:
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

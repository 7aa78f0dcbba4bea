"""nerfstudio's transforms.json."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from reffusion.capture.frame import depths_in_view
from reffusion.capture.layouts.capture import (
    NO_POINTS,
    Capture,
    Poses,
    counted,
    fitted,
    inverse,
    rigid,
    unique,
)
from reffusion.capture.lens import Lens
from reffusion.io.arrays import load_json
from reffusion.io.files import BadInput, shortened, there, understood
from reffusion.io.images import ENDINGS, image_size
from reffusion.io.ply import load_points

MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)


def read(folder: Path, images: str | None) -> Capture:
    """See `load_capture`."""
    source = folder / "transforms.json"
    record = load_json(source)
    frames = _frames(record, source)
    files = [_frame_file(folder, images, frame["file_path"]) for frame in frames]
    missing = [frame["file_path"] for frame, path in zip(frames, files, strict=True) if path is None]
    placed = [(frame, path) for frame, path in zip(frames, files, strict=True) if path is not None]
    if not placed:
        raise BadInput(f"{source}: none of its {len(frames)} frames has a picture; name their folder as `images`")
    pictures = unique((path.stem, path) for _, path in placed)
    lenses, poses = {}, {}
    for frame, path in placed:
        lenses[path.stem] = _frame_lens({**record, **frame}, path, source)
        poses[path.stem] = _frame_pose(frame, path.stem, source)
    points, warning = _points(source, folder, record, lenses, poses)
    warnings = counted(f"of the {len(frames)} frames in {source.name} have no picture", sorted(missing)), warning
    in_order = lambda values: {name: values[name] for name in pictures}
    return Capture(
        "transforms",
        pictures,
        Poses(in_order(lenses), in_order(poses), *points, {}),
        source,
        next(iter(pictures.values())).parent,
        frozenset(Path(path).stem for path in missing),
        tuple(filter(None, warnings)),
    )


def read_cameras(folder: Path) -> Poses:
    """The lenses and poses alone, of a capture whose pictures are not there; their sizes are the file's w and h."""
    source = folder / "transforms.json"
    record = load_json(source)
    lenses, poses = {}, {}
    for frame in _frames(record, source):
        path, values = Path(frame["file_path"].replace("\\", "/")), {**record, **frame}
        if path.stem in lenses:
            raise BadInput(f"{source}: two frames are called '{path.stem}'; rename one")
        if "w" not in values or "h" not in values:
            raise BadInput(f"{source}: neither pictures nor w and h of '{path.name}'; give its size in pixels")
        lenses[path.stem] = _valid(_lens(values, path, source, (0, 0)), path, source)
        poses[path.stem] = _frame_pose(frame, path.stem, source)
    in_order = lambda values: dict(sorted(values.items()))
    return Poses(in_order(lenses), in_order(poses), *NO_POINTS, {})


def has_pictures(folder: Path) -> bool:
    """Is a picture of one of its frames there?"""
    source = folder / "transforms.json"
    return any(_frame_file(folder, None, frame["file_path"]) for frame in _frames(load_json(source), source))


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


def _frame_file(folder: Path, images: str | None, listed: str) -> Path | None:
    """The frame's picture: as listed, or by its name in the folder `images`; usual endings are tried."""
    listed_path = Path(listed.replace("\\", "/"))
    base = folder / listed_path if images is None else folder / images / listed_path.name
    if base.suffix.lower() in ENDINGS:
        there(base)  # a folder or a pipe of that name is no missing picture
    candidates = [base, *(base.with_name(base.name + end) for e in ENDINGS for end in (e, e.upper()))]
    if images is not None:
        candidates += [base.with_suffix(end) for e in ENDINGS for end in (e, e.upper())]
    return next((path for path in candidates if path.is_file()), None)


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


def _frame_lens(values: dict, picture: Path, source: Path) -> Lens:
    """The lens from the frame's keys over the file's, at the size of the picture."""
    return fitted(_valid(_lens(values, picture, source, image_size(picture)), picture, source), picture)


def _valid(lens: Lens, picture: Path, source: Path) -> Lens:
    if min(lens.fx, lens.fy) <= 0:
        raise BadInput(f"{source}: the focal length (or angle) of '{picture.name}' is not positive")
    if lens.width < 1 or lens.height < 1:
        raise BadInput(f"{source}: w and h of '{picture.name}' are {lens.width}x{lens.height}; give its size in pixels")
    return lens


def _number(values: dict, key: str, default: float, picture: Path, source: Path) -> float:
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e12:
        raise BadInput(f"{source}: {key} = {shortened(value)} of '{picture.name}' is no finite number")
    return float(value)


def _lens(values: dict, picture: Path, source: Path, size: tuple[int, int]) -> Lens:
    number = lambda key, default=0.0: _number(values, key, default, picture, source)
    width, height = number("w", size[0]), number("h", size[1])
    fx = _focal_length(values, "x", width, number)
    if fx is None:
        raise BadInput(f"{source}: neither fl_x nor camera_angle_x for '{picture.name}'; one of them is needed")
    fy = _focal_length(values, "y", height, number)
    model = values.get("camera_model", "OPENCV")
    model = model.upper() if isinstance(model, str) else shortened(model)
    fisheye = "FISHEYE" in model or bool(values.get("is_fisheye", False))
    if model not in MODELS:
        raise BadInput(f"{source}: camera_model {shortened(model)} is not understood; one of {', '.join(MODELS)}")
    k = [number(f"k{i}") for i in range(1, 7)]
    rational = model == "FULL_OPENCV"
    return Lens(
        round(width),
        round(height),
        fx,
        fx if fy is None else fy,
        number("cx", width / 2),
        number("cy", height / 2),
        radial=_trimmed(k[:3] if rational else k[:4]),
        denominator=_trimmed(k[3:]) if rational else (),
        tangential=(0.0, 0.0) if fisheye else (number("p1"), number("p2")),
        fisheye=fisheye,
        model=model,
    )


def _focal_length(values: dict, axis: str, extent: float, number: Callable[..., float]) -> float | None:
    """Pixels along one axis of `extent` pixels, from the focal length or else the angle of view; None without."""
    if f"fl_{axis}" in values:
        return number(f"fl_{axis}")
    if f"camera_angle_{axis}" in values:
        angle = number(f"camera_angle_{axis}")
        return 0.5 * extent / float(np.tan(0.5 * angle)) if 0 < angle < np.pi else 0.0
    return None


def _trimmed(coefficients: list[float]) -> tuple[float, ...]:
    """Without the zeros at the end."""
    while coefficients and coefficients[-1] == 0.0:
        coefficients = coefficients[:-1]
    return tuple(coefficients)


def _points(
    source: Path, folder: Path, record: dict, lenses: dict[str, Lens], poses: dict[str, np.ndarray]
) -> tuple[tuple[np.ndarray, np.ndarray], str | None]:
    """The points of `ply_file_path` (or sparse_pc.ply), in the frame of the poses; and a warning, or None.

    `applied_transform` and `applied_scale` say what was done to poses and points alike: there is nothing to undo.
    """
    listed = record.get("ply_file_path")
    if listed is not None and not _is_path(listed):
        raise BadInput(f"{source}: ply_file_path = {shortened(listed)} is no file's name")
    path = folder / (listed or "sparse_pc.ply")
    if not there(path):
        return NO_POINTS, f"{path}: named by transforms.json, but missing" if listed else None
    points, colors = load_points(path)
    finite = np.isfinite(points).all(axis=1)
    points, colors = points[finite], colors[finite]
    shares = [len(depths_in_view(points, poses[name], lens)) for name, lens in lenses.items()]
    if len(points) == 0 or np.median(shares) < 0.02 * len(points):
        return NO_POINTS, f"{path}: its points are not in the frame of the poses and are not used"
    return (points, colors), None

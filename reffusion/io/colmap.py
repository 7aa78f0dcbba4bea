"""Reading and writing of COLMAP models: folders with the files cameras, images and points3D, binary or text."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reffusion.io.files import BadInput, Cursor, is_file, reading, shorten
from reffusion.io.rotations import quaternion_to_pose, rotation_to_quaternion

# Name of a camera model -> number of its parameters. The order is that of COLMAP's model ids, from 0 on.
MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4,
    "EUCM": 6, "EQUIRECTANGULAR": 2,
}  # fmt: skip
NAMES = tuple(MODELS)
OBSERVATIONS = re.compile(r"[-+.\deE\s]+")  # a line of numbers in images.txt: x, y, id of a point, and so on


@dataclass(frozen=True)
class ModelCamera:
    """The intrinsics of a camera in a COLMAP model.

    Attributes:
        model: COLMAP's name of the camera model, a key of `MODELS`.
        width, height: image size in pixels.
        params: parameters of the camera model, in COLMAP's order.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """A registered image of a COLMAP model.

    Attributes:
        name: file name of the image, as the model has it.
        camera_id: id of its camera in the model.
        world_to_camera: [4, 4] float64 rigid transform, in COLMAP's axes (+z forward, x right, y down).
    """

    name: str
    camera_id: int
    world_to_camera: np.ndarray


@dataclass(frozen=True)
class ModelPoints:
    """The P sparse points of a COLMAP model, and their T observations in images.

    Attributes:
        positions: [P, 3] float64, in the world frame of the model.
        colors: [P, 3] uint8.
        track_points: [T] int64, for each observation the row of its point in `positions`.
        track_images: [T] int64, for each observation the id of the image that observes the point.
    """

    positions: np.ndarray
    colors: np.ndarray
    track_points: np.ndarray
    track_images: np.ndarray


def model_file(folder: Path, stem: str) -> Path | None:
    """Return `<folder>/<stem>.bin` if this file exists, else `<folder>/<stem>.txt`; None if neither exists."""
    return next((p for p in (Path(folder) / f"{stem}{end}" for end in (".bin", ".txt")) if is_file(p)), None)


def is_model(folder: Path) -> bool:
    """Return whether the folder has the files cameras and images of a COLMAP model; points3D may be missing."""
    return model_file(folder, "cameras") is not None and model_file(folder, "images") is not None


# ---------------------------------------------------------------------------------------------- reading


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines of a text file as pairs (number, stripped line), without blank lines and comments."""
    lines = enumerate(map(str.strip, Path(path).read_text(encoding="utf-8-sig").splitlines()), start=1)
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def load_cameras(path: Path) -> dict[int, ModelCamera]:
    """Read cameras.bin or cameras.txt as a dict camera id -> intrinsics.

    Raises:
        BadInput: the file cannot be read, or a camera has an image size of zero, a parameter that is not finite, or a
            focal length that is not positive. The message names the file.
    """
    with reading(path, "COLMAP's cameras"):
        found = _cameras_binary(path) if path.suffix == ".bin" else _cameras_text(path)
    for identity, camera in found.items():
        focal = camera.params[:1] if camera.model in _ONE_FOCAL_LENGTH else camera.params[:2]
        if not np.isfinite(camera.params).all():
            raise BadInput(f"{path}: camera {identity}: camera parameters that are not finite")
        if min(focal) <= 0:
            raise BadInput(f"{path}: camera {identity}: a focal length of {min(focal):g} px; it must be positive")
        if camera.width < 1 or camera.height < 1:
            raise BadInput(f"{path}: camera {identity} is for a picture of {camera.width}x{camera.height} px")
    return found


_ONE_FOCAL_LENGTH = (
    "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_DIVISION",
    "SIMPLE_FISHEYE",
)  # fmt: skip


def _cameras_binary(path: Path) -> dict[int, ModelCamera]:
    file, cameras = Cursor(path), {}
    for _ in range(file.read_count(40)):
        identity, model, width, height = file.read("IiQQ")
        if not 0 <= model < len(NAMES):
            raise BadInput(f"{path}: unknown camera model number {model}")
        params = file.read(f"{MODELS[NAMES[model]]}d")
        _add(cameras, identity, ModelCamera(NAMES[model], width, height, params), path)
    file.check_end()
    return cameras


def _cameras_text(path: Path) -> dict[int, ModelCamera]:
    cameras = {}
    for number, line in _lines(path):
        with _line_errors(path, number, "camera", line):
            identity, model, width, height, *params = line.split()
            if len(params) != MODELS[model]:
                raise ValueError("its number of parameters")
            camera = ModelCamera(model, int(width), int(height), tuple(map(float, params)))
            _add(cameras, int(identity), camera, path)
    return cameras


def _add(found: dict, identity: int, value: ModelCamera | ModelImage, path: Path) -> None:
    """Add a value to `found` under its id; raises BadInput if the id exists already."""
    if identity in found:
        raise BadInput(f"{path}: the number {identity} comes twice")
    found[identity] = value


@contextmanager
def _line_errors(path: Path, number: int, what: str, line: str) -> Iterator[None]:
    """Turn parsing errors inside the context into BadInput, which shows the file, the line and `what` it describes."""
    try:
        yield
    except BadInput:
        raise
    except (ValueError, KeyError, OverflowError) as error:
        raise BadInput(
            f"{path}: line {number}: cannot read the {what} '{shorten(line)}' ({shorten(str(error))})"
        ) from None


def load_images(path: Path) -> dict[int, ModelImage]:
    """Read images.bin or images.txt as a dict image id -> image with its name, camera id and pose.

    Raises:
        BadInput: the file cannot be read, or a pose is not finite. The message names the file.
    """
    with reading(path, "COLMAP's images"):
        found = _images_binary(path) if path.suffix == ".bin" else _images_text(path)
    for image in found.values():
        if not np.isfinite(image.world_to_camera).all():
            raise BadInput(
                f"{path}: the pose of {shorten(image.name)} is not finite; remove the view or solve it again"
            )
    return found


def _images_binary(path: Path) -> dict[int, ModelImage]:
    file, images = Cursor(path), {}
    for _ in range(file.read_count(73)):
        identity, *pose, camera_id = file.read("I7dI")
        name = file.read_text()
        seen = file.read_count(24)
        file.at += 24 * seen
        _add(
            images,
            identity,
            ModelImage(_check_name(name, path), camera_id, quaternion_to_pose(pose[:4], pose[4:])),
            path,
        )
    file.check_end()
    return images


def _images_text(path: Path) -> dict[int, ModelImage]:
    """Read images.txt. The next line after that of an image may hold the points that the image observes."""
    images: dict[int, ModelImage] = {}
    points_at = 0
    for number, line in _lines(path):
        if number == points_at and OBSERVATIONS.fullmatch(line) and len(line.split()) % 3 == 0:
            continue
        with _line_errors(path, number, "image", line):
            fields = line.split(maxsplit=9)
            if len(fields) != 10:
                raise ValueError("10 fields are expected")
            pose = [float(f) for f in fields[1:8]]
            image = ModelImage(_check_name(fields[9], path), int(fields[8]), quaternion_to_pose(pose[:4], pose[4:]))
            _add(images, int(fields[0]), image, path)
        points_at = number + 1
    return images


def _check_name(name: str, path: Path) -> str:
    """Return the file name of an image; raises BadInput if it has no stem or contains a zero byte."""
    if not Path(name).stem or "\0" in name:
        raise BadInput(f"{path}: an image without a name")
    return name


POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


def load_model_points(path: Path) -> ModelPoints:
    """Read points3D.bin or points3D.txt: the points, and which images observe them.

    Raises:
        BadInput: the file cannot be read, or a position is not finite.
    """
    with reading(path, "COLMAP's points"):
        points = _points_binary(path) if path.suffix == ".bin" else _points_text(path)
    if not np.isfinite(points.positions).all():
        raise BadInput(f"{path}: points that are not finite")
    return points


def _points_binary(path: Path) -> ModelPoints:
    file = Cursor(path)
    count = file.read_count(POINT.itemsize)
    # The length of a record depends on the length of its track. So this loop only finds where each record starts, and
    # numpy reads all records at once afterwards.
    starts, at, track_at = np.empty(count, np.int64), file.at, POINT.itemsize - 8
    for k in range(count):
        starts[k] = at
        at += POINT.itemsize + 8 * int.from_bytes(file.data[at + track_at : at + POINT.itemsize], "little")
        if at > len(file.data):
            raise BadInput(f"{path}: cut off at byte {len(file.data)}; copy or export it again")
    file.at = at
    file.check_end()
    data = np.frombuffer(file.data, np.uint8)
    records = data[starts[:, None] + np.arange(POINT.itemsize)].reshape(-1).view(POINT)
    lengths = records["track"].astype(np.int64)
    rows = np.repeat(np.arange(count), lengths)
    place = np.arange(len(rows)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    track_bytes = starts[rows] + POINT.itemsize + 8 * place
    images = data[track_bytes[:, None] + np.arange(4)].reshape(-1).view("<u4").astype(np.int64)
    return ModelPoints(records["xyz"].astype(np.float64), records["rgb"].copy(), rows, images)


def _points_text(path: Path) -> ModelPoints:
    positions, colors, tracks = [], [], []
    for number, line in _lines(path):
        with _line_errors(path, number, "point", line):
            row = line.split()
            x, y, z, red, green, blue, _ = row[1:8]
            positions.append((float(x), float(y), float(z)))
            colors.append(np.array((int(red), int(green), int(blue)), np.uint8))
            tracks.append(np.array(row[8::2], np.int64))
    return ModelPoints(
        np.array(positions).reshape(-1, 3),
        np.array(colors, np.uint8).reshape(-1, 3),
        np.repeat(np.arange(len(tracks)), [len(track) for track in tracks]),
        np.concatenate([np.zeros(0, np.int64), *tracks]),
    )


# ---------------------------------------------------------------------------------------------- writing


def save_model(
    folder: Path,
    cameras: dict[int, ModelCamera],
    images: dict[int, ModelImage],
    positions: np.ndarray,
    colors: np.ndarray,
) -> None:
    """Write a COLMAP model: cameras.bin, images.bin and points3D.bin. No tracks (observations of points) are written.

    Args:
        folder: created if it does not exist.
        cameras: camera id -> intrinsics.
        images: image id -> registered image.
        positions: [P, 3] float64 sparse points.
        colors: [P, 3] uint8.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "cameras.bin", "wb") as file:
        file.write(struct.pack("<Q", len(cameras)))
        for identity, camera in cameras.items():
            head = (identity, NAMES.index(camera.model), camera.width, camera.height)
            file.write(struct.pack(f"<IiQQ{MODELS[camera.model]}d", *head, *camera.params))
    with open(folder / "images.bin", "wb") as file:
        file.write(struct.pack("<Q", len(images)))
        for identity, image in images.items():
            pose = (*rotation_to_quaternion(image.world_to_camera[:3, :3]), *image.world_to_camera[:3, 3])
            file.write(struct.pack("<I7dI", identity, *pose, image.camera_id))
            file.write(image.name.encode() + b"\0" + struct.pack("<Q", 0))
    records = np.zeros(len(positions), POINT)
    records["id"] = np.arange(1, len(positions) + 1)
    records["xyz"], records["rgb"] = positions, colors
    with open(folder / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", len(records)) + records.tobytes())

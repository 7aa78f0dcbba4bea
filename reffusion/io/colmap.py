"""COLMAP models: a folder of cameras, images and points3D, binary or text."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# Order is COLMAP's numbering in binary files.
MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}
NAMES = tuple(MODELS)


@dataclass(frozen=True)
class ModelCamera:
    """Intrinsics: COLMAP's model name, size in pixels, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """A registered image: file name, camera id, [4, 4] float64 world-to-camera."""

    name: str
    camera_id: int
    world_to_camera: np.ndarray


@dataclass(frozen=True)
class ModelPoints:
    """P sparse points.

    Attributes:
        positions: [P, 3] float64.
        colors: [P, 3] uint8.
        track_points, track_images: [T] int64 each: point index (row) and image id of every observation.
    """

    positions: np.ndarray
    colors: np.ndarray
    track_points: np.ndarray
    track_images: np.ndarray


def model_file(folder: Path, stem: str) -> Path | None:
    """`<folder>/<stem>.bin` or, failing that, `.txt`; None where neither is there."""
    return next((p for p in (Path(folder) / f"{stem}{end}" for end in (".bin", ".txt")) if p.is_file()), None)


def is_model(folder: Path) -> bool:
    """True where cameras and images are both there (points may be missing)."""
    return model_file(folder, "cameras") is not None and model_file(folder, "images") is not None


# ---------------------------------------------------------------------------------------------- reading


class _Bytes:
    """A cursor over a file that says so where the file ends early."""

    def __init__(self, path: Path):
        self.path, self.data, self.at = path, Path(path).read_bytes(), 0

    def read(self, layout: str) -> tuple:
        layout = "<" + layout
        try:
            values = struct.unpack_from(layout, self.data, self.at)
        except struct.error:
            raise ValueError(f"{self.path}: cut off at byte {len(self.data)}") from None
        self.at += struct.calcsize(layout)
        return values

    def array(self, dtype: np.dtype | str, count: int) -> np.ndarray:
        dtype = np.dtype(dtype)
        if self.at + count * dtype.itemsize > len(self.data):
            raise ValueError(f"{self.path}: cut off at byte {len(self.data)}")
        values = np.frombuffer(self.data, dtype, count, self.at)
        self.at += count * dtype.itemsize
        return values

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise ValueError(f"{self.path}: cut off at byte {len(self.data)}")
        name, self.at = self.data[self.at : end].decode(), end + 1
        return name


def _lines(path: Path) -> list[str]:
    """The lines of a text file but comments; a blank line is kept, it may be an image without points."""
    return [line.strip() for line in Path(path).read_text().splitlines() if not line.lstrip().startswith("#")]


def load_cameras(path: Path) -> dict[int, ModelCamera]:
    """Camera id -> intrinsics, from cameras.bin or cameras.txt."""
    found = _cameras_binary(path) if path.suffix == ".bin" else _cameras_text(path)
    for camera in found.values():
        if not np.isfinite(camera.params).all():
            raise ValueError(f"{path}: camera parameters that are not finite")
    return found


def _cameras_binary(path: Path) -> dict[int, ModelCamera]:
    file, cameras = _Bytes(path), {}
    for _ in range(file.read("Q")[0]):
        identity, model, width, height = file.read("IiQQ")
        if not 0 <= model < len(NAMES):
            raise ValueError(f"{path}: unknown camera model number {model}")
        params = file.read(f"{MODELS[NAMES[model]]}d")
        cameras[identity] = ModelCamera(NAMES[model], width, height, params)
    return cameras


def _cameras_text(path: Path) -> dict[int, ModelCamera]:
    cameras = {}
    for line in filter(None, _lines(path)):
        identity, model, width, height, *params = line.split()
        if model not in MODELS or len(params) != MODELS[model]:
            raise ValueError(f"{path}: cannot read the camera '{line}'")
        cameras[int(identity)] = ModelCamera(model, int(width), int(height), tuple(map(float, params)))
    return cameras


def load_images(path: Path) -> dict[int, ModelImage]:
    """Image id -> pose and name, from images.bin or images.txt. ValueError where a pose is not finite."""
    found = _images_binary(path) if path.suffix == ".bin" else _images_text(path)
    for image in found.values():
        if not np.isfinite(image.world_to_camera).all():
            raise ValueError(f"{path}: the pose of {image.name} is not finite; remove the view or solve it again")
    return found


def _images_binary(path: Path) -> dict[int, ModelImage]:
    file, images = _Bytes(path), {}
    for _ in range(file.read("Q")[0]):
        identity, *pose, camera_id = file.read("I7dI")
        name = file.text()
        file.array("V24", file.read("Q")[0])
        images[identity] = ModelImage(name, camera_id, pose_matrix(pose[:4], pose[4:]))
    return images


def _images_text(path: Path) -> dict[int, ModelImage]:
    images, lines = {}, _lines(path)
    while lines and not lines[0]:
        lines.pop(0)
    for line in lines[::2]:
        if not line:
            break
        fields = line.split(maxsplit=9)
        if len(fields) != 10:
            raise ValueError(f"{path}: cannot read the image '{line}'")
        pose = [float(f) for f in fields[1:8]]
        images[int(fields[0])] = ModelImage(fields[9], int(fields[8]), pose_matrix(pose[:4], pose[4:]))
    return images


POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])


def load_model_points(path: Path) -> ModelPoints:
    """The points of points3D.bin or points3D.txt, with the images that see each."""
    points = _points_binary(path) if path.suffix == ".bin" else _points_text(path)
    if not np.isfinite(points.positions).all():
        raise ValueError(f"{path}: points that are not finite")
    return points


def _points_binary(path: Path) -> ModelPoints:
    file = _Bytes(path)
    count = file.read("Q")[0]
    # Records follow each other at distances that their track lengths tell: first the places, then all at once.
    starts, at, track_at = np.empty(count, np.int64), file.at, POINT.itemsize - 8
    for k in range(count):
        starts[k] = at
        at += POINT.itemsize + 8 * int.from_bytes(file.data[at + track_at : at + POINT.itemsize], "little")
        if at > len(file.data):
            raise ValueError(f"{path}: cut off at byte {len(file.data)}")
    data = np.frombuffer(file.data, np.uint8)
    records = data[starts[:, None] + np.arange(POINT.itemsize)].reshape(-1).view(POINT)
    lengths = records["track"].astype(np.int64)
    rows = np.repeat(np.arange(count), lengths)
    place = np.arange(len(rows)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    track_bytes = starts[rows] + POINT.itemsize + 8 * place
    images = data[track_bytes[:, None] + np.arange(4)].reshape(-1).view("<u4").astype(np.int64)
    return ModelPoints(records["xyz"].astype(np.float64), records["rgb"].copy(), rows, images)


def _points_text(path: Path) -> ModelPoints:
    rows = [line.split() for line in filter(None, _lines(path))]
    tracks = [np.array(row[8::2], np.int64) for row in rows]
    return ModelPoints(
        np.array([[float(v) for v in row[1:4]] for row in rows]).reshape(-1, 3),
        np.array([[int(v) for v in row[4:7]] for row in rows], np.uint8).reshape(-1, 3),
        np.repeat(np.arange(len(rows)), [len(track) for track in tracks]),
        np.concatenate([np.zeros(0, np.int64), *tracks]),
    )


def pose_matrix(quaternion: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """[4, 4] float64 from wxyz (any length but zero) and a translation."""
    w, x, y, z = np.asarray(quaternion, np.float64) / np.linalg.norm(quaternion)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = translation
    return matrix


def quaternion_of(rotation: np.ndarray) -> np.ndarray:
    """[4] wxyz of a [3, 3] rotation, w >= 0, without loss where the angle nears pi."""
    r = np.asarray(rotation, np.float64)
    # The largest of the four components is found first, so that none is divided by a small number.
    squares = np.array(
        [
            1 + r[0, 0] + r[1, 1] + r[2, 2],
            1 + r[0, 0] - r[1, 1] - r[2, 2],
            1 - r[0, 0] + r[1, 1] - r[2, 2],
            1 - r[0, 0] - r[1, 1] + r[2, 2],
        ]
    )
    products = np.array(
        [
            [squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], squares[1], r[1, 0] + r[0, 1], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[1, 0] + r[0, 1], squares[2], r[2, 1] + r[1, 2]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2], squares[3]],
        ]
    )
    quaternion = products[int(np.argmax(squares))]
    quaternion = quaternion / np.linalg.norm(quaternion)
    return quaternion if quaternion[0] >= 0 else -quaternion


# ---------------------------------------------------------------------------------------------- writing


def save_model(
    folder: Path,
    cameras: dict[int, ModelCamera],
    images: dict[int, ModelImage],
    positions: np.ndarray,
    colors: np.ndarray,
) -> None:
    """Write cameras.bin, images.bin and points3D.bin (without tracks)."""
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
            pose = (*quaternion_of(image.world_to_camera[:3, :3]), *image.world_to_camera[:3, 3])
            file.write(struct.pack("<I7dI", identity, *pose, image.camera_id))
            file.write(image.name.encode() + b"\0" + struct.pack("<Q", 0))
    records = np.zeros(len(positions), POINT)
    records["id"] = np.arange(1, len(positions) + 1)
    records["xyz"], records["rgb"] = positions, colors
    with open(folder / "points3D.bin", "wb") as file:
        file.write(struct.pack("<Q", len(records)) + records.tobytes())

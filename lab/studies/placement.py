"""Placement of a synthetic object in a real capture, and selection of the photographs that show the object.

A capture is a nerfstudio folder: `transforms.json` and a point cloud. All coordinates are in the capture's own frame. A
camera in this module is a camera-to-world matrix [4, 4]; it looks along +z, with x right and y down.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reffusion.io.arrays import load_json
from reffusion.io.ply import load_points, save_points
from reffusion.io.scene import load_scene

MARGIN = 20  # least distance of the object's axis to the picture's border, px
FRONT_TOLERANCE = 1.06  # points belong to the front surface up to this factor of the nearest points' depth
MIN_POINTS = 8  # least number of points that define a surface
YAW = 25.0  # degrees by which the object is turned away from the view in which it is placed
HALF_EXTENTS = (0.55, 0.4, 0.5)  # half extents of the object, relative to its height
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from this module's camera axes to those of transforms.json


@dataclass(frozen=True)
class Place:
    """Place in a capture at which an object is put, and options of the scene made there.

    Attributes:
        name: name of the place.
        capture: name of the capture's folder.
        view: name of the photograph in which the place is marked.
        pixel: the place in this photograph, (column, row) in px; lens distortion is ignored.
        size: height of the object over its distance from the camera of `view`.
        arc: photographs are used whose azimuth about the object differs from that of `view` by at most this angle,
            degrees.
        train: wanted number of training photographs; at most `train` + `test` photographs are used.
        test: wanted number of test photographs; the number is approximate, and at most half of all.
        near: radius around the pixel within which sparse points define the surface, px.
        shape: "box" or "ellipsoid".
    """

    name: str
    capture: str
    view: str
    pixel: tuple[float, float]
    size: float
    arc: float
    train: int = 45
    test: int = 15
    near: float = 18.0
    shape: str = "box"


@dataclass(frozen=True)
class Photographs:
    """Capture with its cameras and sparse points. Views whose photograph is missing are omitted.

    Attributes:
        folder: folder of the capture.
        meta: content of transforms.json without its frames.
        intrinsics: [3, 3], the same for all views.
        distortion: [4], OpenCV's k1, k2, p1, p2.
        width: px.
        height: px.
        frames: view -> entry in transforms.json.
        cameras: view -> camera-to-world matrix [4, 4].
        points: [P, 3], sparse points.
    """

    folder: Path
    meta: dict[str, Any]
    intrinsics: np.ndarray
    distortion: np.ndarray
    width: int
    height: int
    frames: dict[str, dict[str, Any]]
    cameras: dict[str, np.ndarray]
    points: np.ndarray

    @property
    def cloud(self) -> str:
        """Name of the file with the sparse points."""
        return self.meta.get("ply_file_path", "sparse_pc.ply")

    def project(self, camera: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points [P, 3]; return image points [P, 2] without lens distortion, and depths [P]."""
        seen = (points - camera[:3, 3]) @ camera[:3, :3]
        depth = seen[:, 2]
        image = seen[:, :2] / depth[:, None]
        return image @ self.intrinsics[:2, :2].T + self.intrinsics[:2, 2], depth


@dataclass(frozen=True)
class PlacedObject:
    """Synthetic object in the capture's frame.

    Attributes:
        foot: [3], the point of the surface on which the object stands.
        height: height in the capture's unit; `half` is a multiple of it.
        axes: [3, 3], the object's axes in rows: two along the surface, then up, which is the surface's normal.
        half: [3], half extents along the axes.
        shape: "box" or "ellipsoid".
    """

    foot: np.ndarray
    height: float
    axes: np.ndarray
    half: np.ndarray
    shape: str

    @property
    def normal(self) -> np.ndarray:
        """Normal [3] of the surface on which the object stands."""
        return self.axes[2]

    @property
    def middle(self) -> np.ndarray:
        """Center [3] of the object."""
        return self.foot + self.normal * self.half[2]


class Views(NamedTuple):
    """Names of the selected photographs, in the order of their azimuth about the object.

    Attributes:
        all: all selected photographs.
        test: the test views among them.
    """

    all: list[str]
    test: list[str]

    @property
    def train(self) -> list[str]:
        """The training views."""
        return [name for name in self.all if name not in self.test]


def load_photographs(folder: Path) -> Photographs:
    """Load a capture.

    Raises:
        ValueError: transforms.json or the file of the points is missing.
    """
    if not (folder / "transforms.json").exists():
        raise ValueError(f"{folder} holds no transforms.json: it is no nerfstudio capture")
    meta = load_json(folder / "transforms.json")
    frames = {Path(frame["file_path"]).stem: frame for frame in meta.pop("frames")}
    frames = {name: frame for name, frame in frames.items() if (folder / frame["file_path"]).exists()}
    cloud = folder / meta.get("ply_file_path", "sparse_pc.ply")
    if not cloud.exists():
        raise ValueError(f"{cloud} is missing: a place needs the capture's points")
    intrinsics = np.array([[meta["fl_x"], 0, meta["cx"]], [0, meta["fl_y"], meta["cy"]], [0, 0, 1.0]])
    cameras = {name: np.array(frame["transform_matrix"], float) @ OPENGL for name, frame in frames.items()}
    distortion = np.array([meta.get(key, 0.0) for key in ("k1", "k2", "p1", "p2")])
    size = int(meta["w"]), int(meta["h"])
    return Photographs(folder, meta, intrinsics, distortion, *size, frames, cameras, load_points(cloud)[0])


def convert_poses(poses: Path, out: Path) -> None:
    """Write a nerfstudio capture from a folder of the stage `poses`, for captures that have no points.

    Args:
        poses: its folder. Photographs are undistorted there, and at the size of the profile.
        out: folder of the capture; it must not exist.

    Raises:
        ValueError: the cameras have different intrinsics.
    """
    scene = load_scene(poses)
    lenses = {(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in scene.cameras.values()}
    if len(lenses) != 1:
        raise ValueError(f"{poses}: the photographs have {len(lenses)} different intrinsics; places need one")
    lens = dict(zip(("w", "h", "fl_x", "fl_y", "cx", "cy"), lenses.pop(), strict=True))
    frames = [
        {
            "file_path": f"images/{name}.png",
            "transform_matrix": (np.linalg.inv(camera.world_to_camera) @ OPENGL).tolist(),
        }
        for name, camera in scene.cameras.items()
    ]
    shutil.copytree(poses / "images", out / "images")
    (out / "transforms.json").write_text(json.dumps({**lens, "frames": frames}, indent=1))
    save_points(out / "sparse_pc.ply", scene.points, scene.point_colors)


def save_transforms(capture: Photographs, names: list[str], path: Path) -> None:
    """Write transforms.json for the named views, with images/<view>.png as their photographs."""
    frames = [capture.frames[name] | {"file_path": f"images/{name}.png"} for name in names]
    path.write_text(json.dumps(capture.meta | {"frames": frames}, indent=1))


def place_object(capture: Photographs, place: Place) -> PlacedObject:
    """Return an object on the plane through the sparse points around the place's pixel.

    Raises:
        ValueError: the view is unknown, or there are too few points near the pixel.
    """
    if place.view not in capture.cameras:
        raise ValueError(f"{place.name}: {capture.folder} has no photograph {place.view}")
    camera = capture.cameras[place.view]
    through, normal = _plane(_surface(capture, place))
    up = -np.mean([other[:3, 1] for other in capture.cameras.values()], 0)
    normal = normal if normal @ up > 0 else -normal
    ray = camera[:3, :3] @ np.linalg.solve(capture.intrinsics, [*place.pixel, 1.0])
    ray /= np.linalg.norm(ray)
    foot = camera[:3, 3] + ray * ((through - camera[:3, 3]) @ normal) / (ray @ normal)
    height = place.size * float(np.linalg.norm(foot - camera[:3, 3]))
    across = np.cross(normal, ray)
    across /= np.linalg.norm(across)
    ahead = np.cross(across, normal)
    c, s = np.cos(np.radians(YAW)), np.sin(np.radians(YAW))
    axes = np.stack([c * across + s * ahead, c * ahead - s * across, normal])
    return PlacedObject(foot, height, axes, np.array(HALF_EXTENTS) * height, place.shape)


def _surface(capture: Photographs, place: Place) -> np.ndarray:
    """Return the sparse points [P, 3] of the front surface around the place's pixel."""
    image, depth = capture.project(capture.cameras[place.view], capture.points)
    close = (depth > 0) & (np.linalg.norm(image - place.pixel, axis=1) < place.near)
    if close.sum() < MIN_POINTS:
        count = f"{close.sum()} points within {place.near:g} px of its pixel"
        raise ValueError(f"{place.name}: {count}, {MIN_POINTS} are needed")
    return capture.points[close & (depth < FRONT_TOLERANCE * np.percentile(depth[close], 20))]


def _plane(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit a plane to points [P, 3] and return (a point [3] on the plane, normal [3])."""
    for _ in range(5):  # each time the points farthest from the plane are removed
        normal = np.linalg.svd(points - points.mean(0))[2][2]
        off = np.abs((points - np.median(points, 0)) @ normal)
        points = points[off <= max(np.percentile(off, 85), 1e-9)]
    return np.median(points, 0), normal


def azimuth(thing: PlacedObject, base: np.ndarray, camera: np.ndarray) -> float:
    """Return the angle about the surface's normal from the camera `base` to another camera, degrees in (-180, 180].

    It is positive counterclockwise, seen from above the surface.
    """
    one, other = (_along(thing, at[:3, 3] - thing.foot) for at in (base, camera))
    return float(np.degrees(np.arctan2(np.cross(one, other) @ thing.normal, one @ other)))


def _along(thing: PlacedObject, vector: np.ndarray) -> np.ndarray:
    """Return the component of a vector along the surface."""
    return vector - thing.normal * (vector @ thing.normal)


def select_views(capture: Photographs, place: Place, thing: PlacedObject) -> Views:
    """Select photographs that show the object, evenly in azimuth, and evenly spread test views among them.

    A photograph shows the object if the object's axis is in the picture and the azimuth is within `place.arc`.

    Raises:
        ValueError: fewer than 4 photographs show the object.
    """
    axis = np.stack([thing.foot, thing.middle, thing.foot + 2 * thing.normal * thing.half[2]])
    base, angles = capture.cameras[place.view], {}
    for name in sorted(capture.cameras):
        camera = capture.cameras[name]
        image, depth = capture.project(camera, axis)
        angle = azimuth(thing, base, camera)
        inside = (image > MARGIN).all() and (image < [capture.width - MARGIN, capture.height - MARGIN]).all()
        if depth.min() > 0 and abs(angle) <= place.arc and inside:
            angles[name] = angle
    visible = sorted(angles, key=angles.__getitem__)
    count = min(len(visible), place.train + place.test)
    if count < 4:
        raise ValueError(f"{place.name}: {count} photographs show the object, 4 are needed")
    selected = [visible[k] for k in np.linspace(0, len(visible) - 1, count).round().astype(int)]
    every = max(2, round(count / max(1, place.test)))
    return Views(selected, selected[every // 2 :: every])

"""Structure from motion through COLMAP: SIFT on the CPU, exhaustive matching, incremental mapping."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from PIL import Image

from reffusion.capture.layouts.capture import Poses
from reffusion.capture.lens import from_colmap
from reffusion.capture.undistort import load_resized
from reffusion.io.files import BadInput
from reffusion.io.images import image_size, open_image, save_image
from reffusion.types import Camera

if TYPE_CHECKING:
    import pycolmap

LEAST_VIEWS = 3  # that must be placed
LEAST_SIGHTINGS = 100  # observations, below which a view is not adjusted
SAME_FOCAL = 1.01  # ratio of EXIF focal lengths up to which photographs count as taken at one zoom
EXIF_PART, MAKER, MODEL = 0x8769, 0x010F, 0x0110  # EXIF tags: the camera's part, and what names the camera
FOCAL_TAGS = (0x920A, 0xA405, 0xA20E, 0xA210)  # mm; mm of 35 mm film; pixels per unit of the sensor; that unit


@dataclass(frozen=True)
class Reconstruction:
    """The result of structure from motion.

    Attributes:
        poses: lenses, poses and points, in an arbitrary frame, of the views that were placed.
        photographs: number of photographs.
        lenses: number of different lenses that were estimated.
        track_length: mean number of views that show a point.
        residual: mean reprojection error in px of the reduced pictures.
    """

    poses: Poses
    photographs: int
    lenses: int
    track_length: float
    residual: float

    def facts(self) -> dict[str, float | str]:
        """The figures by name, and a line for people."""
        lenses = "1 lens" if self.lenses == 1 else f"{self.lenses} lenses"
        placed, points = len(self.poses.lenses), len(self.poses.points)
        return {
            "photographs": self.photographs,
            "placed": placed,
            "lenses": self.lenses,
            "points": points,
            "mean_track_length": self.track_length,
            "mean_residual_px": self.residual,
            "summary": f"structure from motion: {placed} of {self.photographs} photographs, {lenses}, {points:,} "
            f"points in {self.track_length:.1f} views each, {self.residual:.2f} px mean reprojection error",
        }


def reconstruct(photographs: Mapping[str, Path], longest: int, work: Path, seed: int = 0) -> Reconstruction:
    """Estimate lenses, poses and sparse points of photographs, which are turned as their orientation tags say.

    Photographs of one size and one EXIF focal length share a SIMPLE_RADIAL lens; portrait pictures are turned to
    landscape for this. The same pictures give the same poses: order, seeds and, where it matters, a single thread are
    fixed.

    Args:
        photographs: view name -> file; sizes may differ.
        longest: px to which the longer side is reduced.
        work: a folder for pictures and the database; created, and removed at the end.

    Returns:
        The reconstruction at the reduced size; with fewer views than `photographs` where some were not placed.

    Raises:
        BadInput: naming the views that were not placed, where fewer than 3 were.
    """
    import pycolmap

    shutil.rmtree(work, ignore_errors=True)
    pictures, database = work / "images", work / "database.db"
    pictures.mkdir(parents=True)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.set_random_seed(seed)
    turned = {name for name, path in photographs.items() if _is_portrait(image_size(path, upright=True))}
    for group, focal in group_by_lens(photographs, work):
        for name in group:
            image = load_resized(photographs[name], longest, upright=True)
            save_image(pictures / _file_of(name), np.rot90(image) if name in turned else image)
        _register(database, pictures, [_file_of(name) for name in group], focal)
    _match(database, pictures, seed)
    model = _reconstruct(database, pictures, work, seed)
    images = {} if model is None else {image.name: image for image in model.images.values() if image.has_pose}
    placed = {name: images[_file_of(name)] for name in sorted(photographs) if _file_of(name) in images}
    if len(placed) < LEAST_VIEWS:
        folder, lost = next(iter(photographs.values())).parent, sorted(set(photographs) - set(placed))
        raise BadInput(
            f"structure from motion placed {len(placed)} of {len(photographs)} views in {folder}; not "
            f"{', '.join(lost)}. "
            "Take more photos that overlap by two thirds, sharp and of things that do not move, or bring poses"
        )
    lenses = len({image.camera_id for image in placed.values()})
    poses = _poses_of(model, placed, turned)
    shutil.rmtree(work)
    return Reconstruction(
        poses, len(photographs), lenses, model.compute_mean_track_length(), model.compute_mean_reprojection_error()
    )


def _register(database: Path, folder: Path, files: Sequence[str], focal: float | None) -> None:
    """Add pictures that share a lens to the database; `focal`: focal length over the longer side, where it is known."""
    import pycolmap

    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    if focal is not None:
        width, height = image_size(folder / files[0])
        reader.camera_params = f"{focal * max(width, height)},{width / 2},{height / 2},0"
    pycolmap.Database.open(database).close()  # makes the file
    pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE, sorted(files), reader)


def _match(database: Path, folder: Path, seed: int) -> None:
    """SIFT features of the registered pictures, and matches of all pairs; the same for any number of threads."""
    import pycolmap

    threads, cpu = torch.get_num_threads(), pycolmap.Device.cpu
    features = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=threads)
    pycolmap.extract_features(database, folder, extraction_options=features, device=cpu)
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=threads)
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = seed  # of each pair
    pycolmap.match_exhaustive(database, matching, verification_options=geometry, device=cpu)


def _reconstruct(database: Path, pictures: Path, work: Path, seed: int):
    """COLMAP's reconstruction with most views; None where it finds none."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, min_model_size=LEAST_VIEWS)
    options.mapper.random_seed = options.triangulation.random_seed = seed
    options.mapper.num_threads = 1  # the order of sums, and so the result, is fixed
    models = pycolmap.incremental_mapping(database, pictures, work, options)
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _is_portrait(size: tuple[int, int]) -> bool:
    return size[1] > size[0]


def _file_of(view: str) -> str:
    """File name of a view's picture in the database; a view may be called by its path."""
    return f"{view}.png"


def _poses_of(model, images: Mapping[str, pycolmap.Image], turned: Collection[str]) -> Poses:
    """Lenses, poses and points of a COLMAP reconstruction.

    Args:
        images: view name -> its image. turned: views whose pictures were turned by 90 degrees counterclockwise.
    """
    back = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)  # x right, y down
    poses, lenses = {}, {}
    for name, image in images.items():
        camera = model.cameras[image.camera_id]
        matrix = np.eye(4)
        matrix[:3] = image.cam_from_world().matrix()
        poses[name] = back @ matrix if name in turned else matrix
        lens = from_colmap(camera.model.name, camera.width, camera.height, tuple(map(float, camera.params)))
        # a radial lens with its axis in the middle stays what it is when it is turned
        across = replace(lens, width=lens.height, height=lens.width, cx=lens.cy, cy=lens.cx)
        lenses[name] = across if name in turned else lens
    points = [model.points3D[k] for k in sorted(model.points3D)]
    return Poses(
        lenses,
        poses,
        np.array([p.xyz for p in points], np.float64).reshape(-1, 3),
        np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        {},
    )


def group_by_lens(photographs: Mapping[str, Path], work: Path) -> list[tuple[list[str], float | None]]:
    """Names of views that share a lens, and its focal length over the longer side where EXIF has it.

    They have the same size, portrait or landscape, and EXIF focal lengths that agree within 1%. `work`: see
    `relative_focal_length`.
    """
    groups: list[tuple[list[str], float | None]] = []
    last: tuple[list[int], float] | None = None
    found = [(sorted(image_size(path)), relative_focal_length(path, work), name) for name, path in photographs.items()]
    for size, focal, name in sorted(found, key=lambda each: (each[0], each[1] or 0.0, each[2])):
        if last is None or size != last[0] or (focal or 0.0) > SAME_FOCAL * last[1]:
            groups.append(([], focal))
            last = size, focal or 0.0
        groups[-1][0].append(name)
    return groups


def relative_focal_length(photograph: Path, work: Path) -> float | None:
    """Focal length over the longer side, from EXIF and COLMAP's table of sensors; None where unknown.

    COLMAP does not read every kind of picture (WebP, HEIC). So it gets a blank JPEG with the photograph's tags, which
    is written to the folder `work`.
    """
    with open_image(photograph) as image:
        exif = image.getexif()
        part = exif.get_ifd(EXIF_PART)
        camera = tuple((tag, exif[tag]) for tag in (MAKER, MODEL) if exif.get(tag))
        focal = tuple((tag, part[tag]) for tag in FOCAL_TAGS if part.get(tag))
        return _focal_of_tags(image.size, camera, focal, work) if focal else None


@lru_cache(maxsize=64)  # most photographs of a capture have the same tags
def _focal_of_tags(size: tuple[int, int], camera: tuple, focal: tuple, work: Path) -> float | None:
    import pycolmap

    tags = Image.Exif()
    tags.update(camera)
    tags.get_ifd(EXIF_PART).update(focal)
    blank = work / "exif.jpg"
    Image.new("L", size).save(blank, exif=tags)
    found = pycolmap.infer_camera_from_image(blank)
    blank.unlink()
    return found.mean_focal_length() / max(found.width, found.height) if found.has_prior_focal_length else None


def bundle_adjust(
    cameras: Mapping[str, Camera],
    sightings: Mapping[str, Sequence[np.ndarray]],
    points: Sequence[tuple[np.ndarray, Sequence[tuple[str, int]]]],
    fixed: Collection[str] = (),
) -> dict[str, Camera]:
    """Adjust poses, and the principal point of each view, to the least robust reprojection error.

    Args:
        cameras: view name -> camera, to start from; a view with fewer than `LEAST_SIGHTINGS` observations stays fixed.
        sightings: view name -> pixels [2] in it.
        points: of each point the position [3] and track: pairs of view name and index of its pixel in `sightings`.
        held: names of views whose principal points stay fixed.

    Returns:
        The cameras, in a frame that is only roughly the given one.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    identities = {name: k + 1 for k, name in enumerate(sorted(cameras))}
    model, config = pycolmap.Reconstruction(), pycolmap.BundleAdjustmentConfig()
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    for name, number in identities.items():
        c = cameras[name]
        lens = [c.fx, c.fy, c.cx, c.cy]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=number, model="PINHOLE", width=c.width, height=c.height, params=lens)
        )
        places = np.array(sightings[name]).reshape(-1, 2)
        image = pycolmap.Image(name=name, camera_id=number, image_id=number, keypoints=places)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(c.world_to_camera[:3, :3]), c.world_to_camera[:3, 3])
        model.add_image_with_trivial_frame(image, pose)
        config.add_image(number)
        underdetermined = len(places) < LEAST_SIGHTINGS
        if name in fixed or underdetermined:
            config.set_constant_cam_intrinsics(number)
        if underdetermined:
            config.set_constant_rig_from_world_pose(model.images[number].frame_id)
    for point, track in points:
        elements = pycolmap.Track()
        for name, index in track:
            elements.add_element(identities[name], index)
        model.add_point3D(point, elements)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length, options.refine_principal_point, options.print_summary = False, True, False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1  # the order of sums, and so the result, is fixed
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return {name: _camera(cameras[name], model.images[k], model.cameras[k]) for name, k in identities.items()}


def _camera(camera: Camera, image, lens) -> Camera:
    pose, (fx, fy, cx, cy) = np.eye(4), (float(value) for value in lens.params)
    pose[:3] = image.cam_from_world().matrix()
    return replace(camera, world_to_camera=pose, fx=fx, fy=fy, cx=cx, cy=cy)

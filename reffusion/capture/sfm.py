"""Structure from motion with COLMAP: SIFT on the CPU, exhaustive matching, incremental mapping; bundle adjustment."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import torch
from PIL import Image

from reffusion.capture.layouts.capture import Poses
from reffusion.capture.lens import from_colmap
from reffusion.capture.undistort import load_resized
from reffusion.io.files import BadInput
from reffusion.io.given_masks import load_united_masks
from reffusion.io.images import image_size, open_image, save_image, save_mask
from reffusion.types import Camera

if TYPE_CHECKING:
    import pycolmap

LEAST_VIEWS = 3  # smallest number of views for which poses must be found
# Photographs without a focal length are mapped from several seeds, at most MAPPINGS, until two mappings agree in their
# number of observations (ratio AGREE): a mapping can end in cameras that explain the matches only in part.
MAPPINGS, AGREE = 3, 0.9
LEAST_SIGHTINGS = 100  # a view with fewer observations is not adjusted
SAME_FOCAL = 1.01  # ratio of EXIF focal lengths up to which photographs count as taken at one zoom
EXIF_PART, MAKER, MODEL = 0x8769, 0x010F, 0x0110  # EXIF tags: camera settings (a part of the tags), maker, model
FOCAL_TAGS = (0x920A, 0xA405, 0xA20E, 0xA210)  # focal length: mm; mm for 35 mm film; sensor pixels per unit; that unit


@dataclass(frozen=True)
class Reconstruction:
    """The result of structure from motion.

    Attributes:
        poses: lenses, poses and sparse points in an arbitrary frame. They include only the placed views, for which
            COLMAP found a pose.
        photographs: number of photographs that were given, placed or not.
        lenses: number of different lenses of the placed views.
        track_length: mean number of views in which a point is observed.
        residual: reprojection error in pixels of the reduced pictures: the mean over the points of each point's mean.
    """

    poses: Poses
    photographs: int
    lenses: int
    track_length: float
    residual: float

    def facts(self) -> dict[str, float | str]:
        """Return the numbers of this reconstruction by name, and under "summary" a sentence with all of them."""
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


def reconstruct(
    photographs: Mapping[str, Path],
    longest: int,
    work: Path,
    seed: int = 0,
    ignore: Mapping[str, Sequence[Path]] = MappingProxyType({}),
) -> Reconstruction:
    """Estimate lenses, poses and sparse points of photographs. Their EXIF orientation tags are obeyed.

    Photographs of equal size and about equal EXIF focal length share one SIMPLE_RADIAL lens (`group_by_lens`). So that
    portrait and landscape pictures can share a lens, portrait pictures are turned by 90 degrees; the results are turned
    back. The result is reproducible: the order of pictures and the random seeds are fixed, and the mapping uses a
    single thread.

    Args:
        photographs: view name -> file; sizes may differ.
        longest: longer side in pixels to which the pictures are reduced; smaller pictures keep their size.
        work: temporary folder for pictures and the database. The folder is emptied first, and deleted after success.
        seed: random seed of COLMAP. If photographs lack an EXIF focal length, it is that of the first mapping
            (`_reconstruct_repeatedly`).
        ignore: view name -> files of masks of pixels in which no features are searched.

    Returns:
        The reconstruction, with lenses for the reduced, upright pictures. Photographs for which COLMAP finds no pose
        are not in `poses`.

    Raises:
        BadInput: COLMAP finds poses for fewer than 3 views; the message names the views without a pose.
    """
    import pycolmap

    shutil.rmtree(work, ignore_errors=True)
    pictures, masks, database = work / "images", work / "masks", work / "database.db"
    pictures.mkdir(parents=True)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.set_random_seed(seed)
    turned = {name for name, path in photographs.items() if _is_portrait(image_size(path, upright=True))}
    groups = group_by_lens(photographs, work)
    for group, focal in groups:
        for name in group:
            image = load_resized(photographs[name], longest, upright=True)
            save_image(pictures / _file_of(name), np.rot90(image) if name in turned else image)
            if name in ignore:
                mask = ~load_united_masks(ignore[name], image.shape[:2])
                save_mask(masks / f"{_file_of(name)}.png", np.rot90(mask) if name in turned else mask)
        _register(database, pictures, [_file_of(name) for name in group], focal)
    _match(database, pictures, masks if ignore else None, seed)
    map_views = _reconstruct if all(focal for _, focal in groups) else _reconstruct_repeatedly
    model = map_views(database, pictures, work, seed)
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
    poses = _read_poses(model, placed, turned)
    shutil.rmtree(work)
    return Reconstruction(
        poses, len(photographs), lenses, model.compute_mean_track_length(), model.compute_mean_reprojection_error()
    )


def _register(database: Path, folder: Path, files: Sequence[str], focal: float | None) -> None:
    """Add pictures of one lens to COLMAP's database; `focal` is relative to their longer side, None if unknown."""
    import pycolmap

    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    if focal is not None:
        width, height = image_size(folder / files[0])
        reader.camera_params = f"{focal * max(width, height)},{width / 2},{height / 2},0"
    pycolmap.Database.open(database).close()  # makes the file
    pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE, sorted(files), reader)


def _match(database: Path, folder: Path, masks: Path | None, seed: int) -> None:
    """Write SIFT features, none where masks are black, and matches of all pairs to the database, reproducibly."""
    import pycolmap

    threads, cpu = torch.get_num_threads(), pycolmap.Device.cpu
    features = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=threads)
    reader = pycolmap.ImageReaderOptions() if masks is None else pycolmap.ImageReaderOptions(mask_path=masks)
    pycolmap.extract_features(database, folder, reader_options=reader, extraction_options=features, device=cpu)
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=threads)
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = seed  # of the RANSAC of each pair
    pycolmap.match_exhaustive(database, matching, verification_options=geometry, device=cpu)


def _reconstruct(database: Path, pictures: Path, work: Path, seed: int, is_rig: bool = False):
    """Return the `pycolmap.Reconstruction` with most views, or None; `is_rig`: lenses and poses in the rig stay."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, min_model_size=LEAST_VIEWS)
    options.mapper.random_seed = options.triangulation.random_seed = seed
    options.ba_refine_focal_length = options.ba_refine_extra_params = options.ba_refine_sensor_from_rig = not is_rig
    options.mapper.num_threads = 1  # fixes the order of sums, and so the result
    models = pycolmap.incremental_mapping(database, pictures, work, options)
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _reconstruct_repeatedly(database: Path, pictures: Path, work: Path, seed: int):
    """Return the `pycolmap.Reconstruction` with most observations of up to `MAPPINGS` seeds, or None."""
    models, observations = [], lambda model: model.compute_num_observations() if model else 0
    for k in range(MAPPINGS):
        models.append(_reconstruct(database, pictures, work, seed + k))
        best, *others = sorted(map(observations, models), reverse=True)
        if others and others[0] >= AGREE * best > 0:
            break
    return max(models, key=observations)


def _is_portrait(size: tuple[int, int]) -> bool:
    return size[1] > size[0]


def _file_of(view: str) -> str:
    """Return the file name of a view's picture in the database. The view's name may be a path."""
    return f"{view}.png"


def _read_poses(model, images: Mapping[str, pycolmap.Image], turned: Collection[str]) -> Poses:
    """Return the lenses and poses of `images`, and the points; views in `turned` are turned back by 90 degrees."""
    # turns by 90 degrees clockwise (x right, y down), as the pictures were turned counterclockwise
    back = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)
    poses, lenses = {}, {}
    for name, image in images.items():
        camera = model.cameras[image.camera_id]
        matrix = np.eye(4)
        matrix[:3] = image.cam_from_world().matrix()
        poses[name] = back @ matrix if name in turned else matrix
        lens = from_colmap(camera.model.name, camera.width, camera.height, tuple(map(float, camera.params)))
        # a radial lens with its principal point in the middle keeps its focal length and k1 when turned
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
    """Group photographs that were taken with one lens at one zoom.

    Photographs of a group have equal sizes, apart from portrait or landscape, and EXIF focal lengths that agree within
    1%. Photographs of equal size without an EXIF focal length are one group.

    Args:
        photographs: view name -> file.
        work: an existing folder for a temporary file, see `relative_focal_length`.

    Returns:
        For each group the names of its views, and the smallest focal length in the group divided by the picture's
        longer side; None if EXIF does not tell.
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
    """Return a photograph's focal length divided by its longer side, or None if unknown.

    COLMAP computes the focal length from the EXIF tags and its table of sensors. COLMAP cannot read every picture
    format (not WebP or HEIC). So a blank JPEG with the photograph's tags is written to the existing folder `work` for
    COLMAP to read, and deleted.
    """
    with open_image(photograph) as image:
        exif = image.getexif()
        part = exif.get_ifd(EXIF_PART)
        camera = tuple((tag, exif[tag]) for tag in (MAKER, MODEL) if exif.get(tag))
        focal = tuple((tag, part[tag]) for tag in FOCAL_TAGS if part.get(tag))
        return _focal_of_tags(image.size, camera, focal, work) if focal else None


@lru_cache(maxsize=64)  # most photographs of a capture have the same tags
def _focal_of_tags(size: tuple[int, int], camera: tuple, focal: tuple, work: Path) -> float | None:
    """Return `relative_focal_length` from EXIF (tag, value) pairs: `camera` has maker and model, `focal` the rest."""
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
    """Return cameras with poses and principal points adjusted by bundle adjustment. Focal lengths stay fixed.

    The sum of a robust loss (soft L1) of the reprojection errors is minimized over poses, principal points and points.

    Args:
        cameras: view name -> camera to start from. A view with fewer than `LEAST_SIGHTINGS` observations keeps its
            pose and principal point.
        sightings: name of each view in `cameras` -> the pixels [2] in which it observes points.
        points: initial position [3] and track of each point. A track is a list of observations: pairs of a view name
            and the index of the pixel in `sightings` of this view.
        fixed: names of views whose principal points stay fixed.

    Returns:
        View name -> camera, for all views in `cameras`. The adjusted points are not returned. The frame agrees
        only roughly with the given one, since reprojection errors do not change under a similarity.
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
    options.ceres.solver_options.num_threads = 1  # fixes the order of sums, and so the result
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return {name: _camera(cameras[name], model.images[k], model.cameras[k]) for name, k in identities.items()}


def _camera(camera: Camera, image, lens) -> Camera:
    """Return `camera` with the pose of `image`, a `pycolmap.Image`, and the intrinsics of `lens`, a PINHOLE camera."""
    pose, (fx, fy, cx, cy) = np.eye(4), (float(value) for value in lens.params)
    pose[:3] = image.cam_from_world().matrix()
    return replace(camera, world_to_camera=pose, fx=fx, fy=fy, cx=cx, cy=cy)


def reconstruct_rigs(pictures: Path, cameras: Sequence[Camera], model: Path, work: Path, seed: int = 0) -> int:
    """Place pictures that several cameras of one rig took at the same moments, and write a COLMAP model.

    Lenses, and the cameras' poses in the rig, are known and stay as they are. The result is reproducible.

    Args:
        pictures: folder with a folder of each camera, which holds its pictures; those of one moment have one name.
        cameras: the cameras, in the rig's frame; their names are those of the folders.
        model: folder of the COLMAP model to write; it must not exist.
        work: temporary folder. The folder is emptied first, and deleted after success.

    Returns:
        The number of moments that were placed.

    Raises:
        BadInput: fewer than 3 moments can be placed.
    """
    import pycolmap

    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.set_random_seed(seed)
    database = work / "database.db"
    pycolmap.Database.open(database).close()  # makes the file
    rig, first = [], cameras[0].world_to_camera
    for camera in cameras:
        lens = {"model": "PINHOLE", "params": [camera.fx, camera.fy, camera.cx, camera.cy]}
        reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE", camera_params=",".join(map(str, lens["params"])))
        files = sorted(path.relative_to(pictures).as_posix() for path in (pictures / camera.name).iterdir())
        pycolmap.import_images(database, pictures, pycolmap.CameraMode.SINGLE, files, reader)
        to_first = camera.world_to_camera @ np.linalg.inv(first)
        rig.append(
            pycolmap.RigConfigCamera(
                ref_sensor=camera is cameras[0],
                image_prefix=f"{camera.name}/",
                cam_from_rig=None if camera is cameras[0] else pycolmap.Rigid3d(to_first[:3]),
            )
        )
    with pycolmap.Database.open(database) as opened:
        pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=rig)], opened)
    _match(database, pictures, None, seed)
    found = _reconstruct(database, pictures, work, seed, is_rig=True)
    placed = 0 if found is None else found.num_reg_frames()
    if placed < LEAST_VIEWS:
        count = len(list((pictures / cameras[0].name).iterdir()))
        raise BadInput(
            f"{pictures}: {placed} of {count} panoramas were placed; take more, a step apart from each other"
        )
    model.mkdir(parents=True)
    found.write(model)
    shutil.rmtree(work)
    return placed

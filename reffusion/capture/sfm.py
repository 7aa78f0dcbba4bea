"""Structure from motion through COLMAP: SIFT on the CPU, exhaustive matching, incremental mapping, adjustment."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from reffusion.capture.layouts.capture import Poses
from reffusion.capture.lens import from_colmap
from reffusion.io.files import BadInput
from reffusion.io.images import HEIC, focal_of_heic
from reffusion.types import Camera

LEAST_VIEWS = 3
LEAST_SIGHTINGS = 100


def solve(pictures: Mapping[str, Path], originals: Mapping[str, Path], work: Path, seed: int = 0) -> Poses:
    """Find lenses, poses and sparse points of photographs of one size.

    All views share one SIMPLE_RADIAL lens, unless the originals' EXIF focal lengths differ by more than 1%. The
    arithmetic order is fixed (one thread where it matters, seeded), so the same pictures give the same poses.

    Args:
        pictures: view name -> upright picture file, all in one folder and of one size.
        originals: view name -> the photograph as taken, of which only the EXIF focal length is read.
        work: a folder for the database; made, and removed at the end.

    Returns:
        Poses of the views that were placed, in an arbitrary frame; fewer than `pictures` where some were not.

    Raises:
        BadInput: naming the views that were not placed, where fewer than 3 were.
    """
    import pycolmap

    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value if hasattr(pycolmap.logging, "ERROR") else 2
    pycolmap.set_random_seed(seed)
    names = {path.name: name for name, path in pictures.items()}
    folder = next(iter(pictures.values())).parent
    database = work / "database.db"
    _extract(pycolmap, database, folder, pictures, originals)
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=1)
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = seed
    pycolmap.match_exhaustive(database, matching, verification_options=geometry, device=pycolmap.Device.cpu)
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, min_model_size=LEAST_VIEWS)
    options.mapper.random_seed = options.triangulation.random_seed = seed
    options.mapper.num_threads = 1
    models = pycolmap.incremental_mapping(database, folder, work, options)
    best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    placed = [] if best is None else [image for image in best.images.values() if image.has_pose]
    if len(placed) < LEAST_VIEWS:
        lost = sorted(set(pictures) - {names[image.name] for image in placed})
        raise BadInput(
            f"structure from motion placed {len(placed)} of {len(pictures)} views in {folder}; not {', '.join(lost)}. "
            "Take more photos that overlap by two thirds, sharp and of things that do not move, or bring poses"
        )
    poses, lenses = {}, {}
    for image in sorted(placed, key=lambda image: image.name):
        name, camera = names[image.name], best.cameras[image.camera_id]
        matrix = np.eye(4)
        matrix[:3] = image.cam_from_world().matrix()
        poses[name] = matrix
        lenses[name] = from_colmap(camera.model.name, camera.width, camera.height, tuple(map(float, camera.params)))
    points = [best.points3D[k] for k in sorted(best.points3D)]
    shutil.rmtree(work)
    return Poses(
        lenses,
        poses,
        np.array([p.xyz for p in points], np.float64).reshape(-1, 3),
        np.array([p.color for p in points], np.uint8).reshape(-1, 3),
        {},
    )


def _extract(pycolmap, database: Path, folder: Path, pictures: Mapping[str, Path], originals: Mapping[str, Path]):
    """SIFT into the database, one camera for all views or, where they were zoomed differently, one each."""
    focals = {name: focal_of(path) for name, path in originals.items()}
    given = [focal for focal in focals.values() if focal is not None]
    zoomed = bool(given) and (max(given) > 1.01 * min(given) or len(given) < len(focals))
    mode = pycolmap.CameraMode.PER_IMAGE if zoomed else pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(
        database,
        folder,
        image_names=sorted(path.name for path in pictures.values()),
        camera_mode=mode,
        reader_options=pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL"),
        extraction_options=pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1),
        device=pycolmap.Device.cpu,
    )
    if not given:
        return
    names = {path.name: name for name, path in pictures.items()}
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            focal, camera = focals[names[image.name]], opened.read_camera(image.camera_id)
            if focal is not None:
                camera.params = [focal * max(camera.width, camera.height), *camera.params[1:]]
                camera.has_prior_focal_length = True
                opened.update_camera(camera)


def focal_of(photograph: Path) -> float | None:
    """Focal length over the longer side, from EXIF and COLMAP's table of sensors; None where unknown."""
    import pycolmap

    if photograph.suffix.lower() in HEIC:  # which COLMAP does not read
        return focal_of_heic(photograph)
    camera = pycolmap.infer_camera_from_image(photograph)
    return camera.mean_focal_length() / max(camera.width, camera.height) if camera.has_prior_focal_length else None


def bundle_adjusted(
    cameras: Mapping[str, Camera],
    sightings: Mapping[str, Sequence[np.ndarray]],
    points: Sequence[tuple[np.ndarray, Sequence[tuple[str, int]]]],
    held: Collection[str] = (),
) -> dict[str, Camera]:
    """Poses, and each view's own principal point, at the points' least robust reprojection error.

    Args:
        cameras: view name -> camera, to start from; a view of fewer than `LEAST_SIGHTINGS` sightings stays as it is.
        sightings: view name -> pixels [2] in it.
        points: position [3] and track of each, (view name, index of sighting)s.
        held: names of views whose principal points stay.

    Returns:
        The cameras in a frame that is near the given one's, but no more than that.
    """
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    numbers = {name: k + 1 for k, name in enumerate(sorted(cameras))}
    model, config = pycolmap.Reconstruction(), pycolmap.BundleAdjustmentConfig()
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    for name, number in numbers.items():
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
        lonely = len(places) < LEAST_SIGHTINGS
        if name in held or lonely:
            config.set_constant_cam_intrinsics(number)
        if lonely:
            config.set_constant_rig_from_world_pose(model.images[number].frame_id)
    for point, track in points:
        elements = pycolmap.Track()
        for name, index in track:
            elements.add_element(numbers[name], index)
        model.add_point3D(point, elements)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length, options.refine_principal_point, options.print_summary = False, True, False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1  # the order of sums, and so the result, is fixed
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return {name: _camera(cameras[name], model.images[k], model.cameras[k]) for name, k in numbers.items()}


def _camera(camera: Camera, image, lens) -> Camera:
    pose, (fx, fy, cx, cy) = np.eye(4), (float(value) for value in lens.params)
    pose[:3] = image.cam_from_world().matrix()
    return replace(camera, world_to_camera=pose, fx=fx, fy=fy, cx=cx, cy=cy)

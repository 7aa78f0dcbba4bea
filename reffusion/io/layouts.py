"""The layouts in which captures come: SPIn-NeRF/LLFF, COLMAP, nerfstudio's transforms.json, or photos only.

Every reader gives the same: pictures by view name and, where the folder brings them, lenses and poses in the
scene's own frame. Nothing but headers of pictures is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reffusion.frame import depths_in_view
from reffusion.lens import Lens, from_colmap

from .arrays import load_json
from .colmap import is_model, load_cameras, load_images, load_model_points, model_file
from .images import image_size
from .ply import load_points

LAYOUTS = ("llff", "colmap", "transforms", "photos")
ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap", ".")


@dataclass(frozen=True)
class Poses:
    """Cameras in the scene's own frame.

    Attributes:
        lenses: view name -> lens at the size of the view's picture file.
        world_to_camera: view name -> [4, 4] float64, rigid; the camera looks along +z, x right, y down.
        points, colors: [P, 3] float64 and uint8; P may be 0.
        bounds: view name -> (near, far) depths; empty where the layout has none.
    """

    lenses: dict[str, Lens]
    world_to_camera: dict[str, np.ndarray]
    points: np.ndarray
    colors: np.ndarray
    bounds: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Capture:
    """What a folder holds.

    Attributes:
        layout: one of LAYOUTS.
        pictures: view name -> picture file, sorted by name; all of them have poses, if any has.
        poses: None where they must be found by structure from motion.
        brought_by: the file the poses come from, for messages; None without poses.
        image_folder: where the pictures lie (masks are looked for beside them).
        left_out: names of views that have a picture but no pose, or a pose but no picture.
        warnings: what the user should know, each one sentence.
    """

    layout: str
    pictures: dict[str, Path]
    poses: Poses | None
    brought_by: Path | None
    image_folder: Path
    left_out: frozenset[str]
    warnings: tuple[str, ...]

    @property
    def upright(self) -> bool:
        """Whether the camera's orientation tag is obeyed: given poses refer to the stored pixels instead."""
        return self.layout == "photos"


def load_capture(folder: Path, layout: str | None = None, images: str | None = None) -> Capture:
    """Read a scene folder, recognising its layout unless it is named.

    Args:
        layout: one of LAYOUTS, or None.
        images: the folder of pictures, relative to the scene, where it is not the usual one.

    Raises:
        ValueError: naming the file and the remedy, where the folder is no capture, two pictures share a view name,
            a picture is unreadable, a pose is not finite or no rotation, or the files contradict each other.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    layout = layout or recognise(folder)
    if layout not in _READERS:
        raise ValueError(f"{folder}: unknown layout '{layout}'; one of {', '.join(LAYOUTS)}")
    if images is not None and not (folder / images).is_dir():
        raise ValueError(f"{folder / images}: no such folder; correct `images` in scene.yaml")
    return _READERS[layout](folder, images)


def recognise(folder: Path) -> str:
    """The layout by the files that are there: poses_bounds.npy, transforms.json, a COLMAP model, else photos."""
    if (folder / "poses_bounds.npy").is_file():
        return "llff"
    if (folder / "transforms.json").is_file():
        return "transforms"
    return "colmap" if _model_folder(folder) is not None else "photos"


def _model_folder(folder: Path) -> Path | None:
    return next((folder / name for name in MODEL_FOLDERS if is_model(folder / name)), None)


# ---------------------------------------------------------------------------------------------- pictures


def pictures_in(folder: Path) -> dict[str, Path]:
    """View name (file name without ending) -> picture, sorted by name. ValueError where two share a name."""
    files = [p for p in sorted(folder.iterdir()) if p.suffix.lower() in ENDINGS and not p.name.startswith(".")]
    return unique((p.stem, p) for p in files)


def unique(named: Iterable[tuple[str, Path]]) -> dict[str, Path]:
    """A dictionary sorted by name; ValueError where a name comes twice."""
    result: dict[str, Path] = {}
    for name, path in named:
        if name in result:
            raise ValueError(f"{path}: the view name '{name}' is also that of {result[name]}; rename one of them")
        result[name] = path
    return dict(sorted(result.items()))


def _image_folder(folder: Path, images: str | None, usual: tuple[str, ...]) -> Path:
    """The named folder; or the first usual one that holds pictures, one with a `label` folder inside first."""
    if images is not None:
        return folder / images
    there = [folder / name for name in usual if (folder / name).is_dir() and pictures_in(folder / name)]
    if not there:
        raise ValueError(f"{folder}: no pictures in {', '.join(usual)}; name their folder as `images` in scene.yaml")
    return next((path for path in there if (path / "label").is_dir()), there[0])


def fitted(lens: Lens, picture: Path) -> Lens:
    """The lens at the size of the picture file; ValueError where the two have different proportions."""
    width, height = image_size(picture)
    if abs(width * lens.height - height * lens.width) > 0.02 * width * lens.height:
        raise ValueError(
            f"{picture}: {width}x{height} px, but its camera is for {lens.width}x{lens.height}; "
            "other proportions: the picture was cropped or turned after its pose was found"
        )
    return lens.resized(width, height)


def rigid(matrix: np.ndarray, name: str, source: Path) -> np.ndarray:
    """[4, 4] with the nearest rotation; ValueError where it is not finite, mirrored, sheared or a scaling."""
    if not np.isfinite(matrix).all():
        raise ValueError(f"{source}: the pose of '{name}' is not finite; remove the view or solve its pose again")
    u, stretch, v = np.linalg.svd(matrix[:3, :3])
    if np.linalg.det(u @ v) < 0 or stretch[0] > 1.02 * stretch[2]:
        raise ValueError(f"{source}: the pose of '{name}' is no rotation; solve its pose again")
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = u @ v, matrix[:3, 3]
    return result


def _inverse(pose: np.ndarray) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
    return result


NO_POINTS = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


# ---------------------------------------------------------------------------------------------- COLMAP


def _read_colmap(folder: Path, images: str | None) -> Capture:
    model = _model_folder(folder)
    if model is None:
        raise ValueError(f"{folder}: no COLMAP model (cameras and images, .bin or .txt) in {', '.join(MODEL_FOLDERS)}")
    return _from_model(folder, model, _image_folder(folder, images, ("images", "images_2", "images_4", ".")), "colmap")


def _from_model(folder: Path, model: Path, image_folder: Path, layout: str) -> Capture:
    """Pictures matched to the model's images by name without ending; failing that, by order where the counts agree."""
    source = model_file(model, "images")
    registered = sorted(load_images(source).values(), key=lambda image: image.name)
    by_name = dict(unique((Path(image.name).stem, Path(image.name)) for image in registered))
    images = {Path(image.name).stem: image for image in registered}
    found = _pictures_of_model(image_folder, by_name)
    if not found.keys() & images.keys() and len(found) == len(images):
        # LLFF's downscaled copies are renamed image000.png, image001.png, ...: the order is all that is left.
        images = dict(zip(found, (images[name] for name in sorted(images)), strict=True))
    pictures = {name: path for name, path in found.items() if name in images}
    if not pictures:
        raise ValueError(f"{source}: none of its images is in {image_folder}; name their folder as `images`")
    cameras = load_cameras(model_file(model, "cameras"))
    lenses, poses = {}, {}
    for name, path in pictures.items():
        camera = cameras.get(images[name].camera_id)
        if camera is None:
            raise ValueError(f"{source}: the camera {images[name].camera_id} of '{name}' is missing in the model")
        lenses[name] = fitted(from_colmap(camera.model, camera.width, camera.height, camera.params), path)
        poses[name] = images[name].world_to_camera
    file = model_file(model, "points3D")
    points = load_model_points(file) if file else None
    brought = (points.positions, points.colors) if points else NO_POINTS
    warnings = (
        _named("images of the model have no picture", sorted(images.keys() - found.keys())),
        _named("pictures are not in the model and are left out", sorted(found.keys() - images.keys())),
    )
    return Capture(
        layout,
        pictures,
        Poses(lenses, poses, *brought, {}),
        source,
        image_folder,
        frozenset(images.keys() ^ found.keys()),
        tuple(filter(None, warnings)),
    )


def _pictures_of_model(image_folder: Path, by_name: dict[str, Path]) -> dict[str, Path]:
    """Pictures of the folder; those that the model names in sub-folders are found there."""
    if all(len(path.parts) == 1 for path in by_name.values()):
        return pictures_in(image_folder)
    return {name: image_folder / path for name, path in by_name.items() if (image_folder / path).is_file()}


def _named(what: str, names: list[str]) -> str | None:
    """`17 of the ... : a, b, c`, or None for no names."""
    return f"{len(names)} {what}: {', '.join(names)}" if names else None


# ---------------------------------------------------------------------------------------------- LLFF


def _read_llff(folder: Path, images: str | None) -> Capture:
    source = folder / "poses_bounds.npy"
    usual = ("images_4", "images_2", "images_8", "images")
    image_folder = _image_folder(folder, images, usual)
    model = _model_folder(folder)
    if model is not None:  # exact poses, the lens's distortion and the points
        return _from_model(folder, model, image_folder, "llff")
    if not source.is_file():
        raise ValueError(f"{source}: missing, and there is no complete COLMAP model in {folder / 'sparse/0'}")
    pictures = pictures_in(image_folder)
    rows = _poses_bounds(source)
    if len(rows) != len(pictures):
        raise ValueError(
            f"{source}: {len(rows)} poses, but {image_folder} holds {len(pictures)} pictures; "
            "one pose a picture is needed, in order of the sorted names"
        )
    lenses, poses, bounds = {}, {}, {}
    for row, (name, path) in zip(rows, pictures.items(), strict=True):
        columns, (height, width, focal) = row[:15].reshape(3, 5), row[[4, 9, 14]]
        lens = Lens(
            round(width), round(height), float(focal), float(focal), width / 2, height / 2, model="SIMPLE_PINHOLE"
        )
        lenses[name] = fitted(lens, path)
        camera_to_world = np.eye(4)
        # LLFF's columns are down, right, backwards.
        camera_to_world[:3] = np.stack([columns[:, 1], columns[:, 0], -columns[:, 2], columns[:, 3]], axis=1)
        poses[name] = _inverse(rigid(camera_to_world, name, source))
        bounds[name] = float(row[15]), float(row[16])
    warnings, partial = [], folder / "sparse" / "0"
    lenses = _lens_of_partial_model(partial, lenses, pictures, warnings)
    points = _points_of_partial_model(partial, lenses, poses, bounds, warnings)
    brought = Poses(lenses, poses, *points, bounds)
    return Capture("llff", pictures, brought, source, image_folder, frozenset(), tuple(warnings))


def _poses_bounds(source: Path) -> np.ndarray:
    """[V, 17] float64, checked."""
    try:
        rows = np.load(source, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"{source}: not a readable array ({error})") from error
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise ValueError(f"{source}: {list(rows.shape)}, expected [views, 17] as LLFF writes it")
    rows = rows.astype(np.float64)
    if not np.isfinite(rows).all():
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        raise ValueError(f"{source}: rows {bad.tolist()} are not finite; solve these poses again")
    if (rows[:, [4, 9, 14, 15]] <= 0).any() or (rows[:, 16] <= rows[:, 15]).any():
        raise ValueError(f"{source}: sizes, focal lengths and bounds must be positive, and far greater than near")
    return rows


def _lens_of_partial_model(
    model: Path, lenses: dict[str, Lens], pictures: dict[str, Path], warnings: list[str]
) -> dict[str, Lens]:
    """The lens of a model that lacks its images, where it holds one camera that agrees with poses_bounds.npy."""
    file = model_file(model, "cameras") if model.is_dir() else None
    cameras = list(load_cameras(file).values()) if file else []
    if len(cameras) != 1:
        return lenses
    exact = from_colmap(cameras[0].model, cameras[0].width, cameras[0].height, cameras[0].params)
    replaced = {name: fitted(exact, path) for name, path in pictures.items()}
    ratio = np.median([replaced[name].fx / lens.fx for name, lens in lenses.items()])
    if abs(ratio - 1) > 0.02:
        warnings.append(f"{file}: its focal length is {ratio:.3f} times that of poses_bounds.npy and is not used")
        return lenses
    return replaced


def _points_of_partial_model(
    model: Path,
    lenses: dict[str, Lens],
    poses: dict[str, np.ndarray],
    bounds: dict[str, tuple[float, float]],
    warnings: list[str],
) -> tuple[np.ndarray, np.ndarray]:
    """Its points where they are in the frame of the poses, else none.

    By tracks, where as many images are seen in them as there are poses: of the observations, 95% must lie in front
    of and inside the view that made them, its views taken in order of their ids. Without: in the median view at
    least a fifth of the points must lie inside the picture and, half of those, between near and far.
    """
    file = model_file(model, "points3D") if model.is_dir() else None
    if file is None:
        return NO_POINTS
    found = load_model_points(file)
    identities = np.unique(found.track_images)
    shares, needed = [], 0.2
    if len(identities) == len(poses):
        needed = 0.95
        for identity, name in zip(identities, sorted(poses), strict=True):
            seen = found.positions[found.track_points[found.track_images == identity]]
            shares.append(len(depths_in_view(seen, poses[name], lenses[name])) / len(seen))
    else:
        for name, (near, far) in bounds.items():
            z = depths_in_view(found.positions, poses[name], lenses[name])
            inside = ((z > 0.8 * near) & (z < 1.25 * far)).sum()
            shares.append(len(z) / max(len(found.positions), 1) if 2 * inside >= max(len(z), 1) else 0.0)
    if np.median(shares) < needed:
        warnings.append(f"{file}: its points are not in the frame of poses_bounds.npy and are not used")
        return NO_POINTS
    return found.positions, found.colors


# ---------------------------------------------------------------------------------------------- transforms.json


def _read_transforms(folder: Path, images: str | None) -> Capture:
    source = folder / "transforms.json"
    record = load_json(source)
    frames = record.get("frames") if isinstance(record, dict) else None
    if not isinstance(frames, list) or not frames:
        raise ValueError(f"{source}: it has no list `frames`")
    placed, missing = [], []
    for frame in frames:
        if not isinstance(frame, dict) or "file_path" not in frame or "transform_matrix" not in frame:
            raise ValueError(f"{source}: a frame without file_path or transform_matrix")
        path = _frame_file(folder, images, frame["file_path"])
        if path is None:
            missing.append(frame["file_path"])
        else:
            placed.append((frame, path))
    warnings = [_named(f"of the {len(frames)} frames in {source.name} have no picture", sorted(missing))]
    if not placed:
        raise ValueError(f"{source}: none of its {len(frames)} frames has a picture; name their folder as `images`")
    pictures = unique((path.stem, path) for _, path in placed)
    lenses, poses = {}, {}
    for frame, path in placed:
        lenses[path.stem] = _frame_lens({**record, **frame}, path, source)
        poses[path.stem] = _frame_pose(frame, path.stem, source)
    points, warning = _points_of_transforms(folder, record, lenses, poses)
    warnings.append(warning)
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


def _frame_file(folder: Path, images: str | None, listed: str) -> Path | None:
    """The frame's picture: as listed, or by its name in the folder `images`; usual endings are tried."""
    listed_path = Path(listed.replace("\\", "/"))
    base = folder / listed_path if images is None else folder / images / listed_path.name
    candidates = [base, *(base.with_name(base.name + end) for e in ENDINGS for end in (e, e.upper()))]
    if images is not None:
        candidates += [base.with_suffix(end) for e in ENDINGS for end in (e, e.upper())]
    return next((path for path in candidates if path.is_file()), None)


def _frame_pose(frame: dict, name: str, source: Path) -> np.ndarray:
    """OpenGL camera-to-world (y up, looking along -z) -> [4, 4] world-to-camera of ours."""
    try:
        matrix = np.array(frame["transform_matrix"], np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{source}: the transform_matrix of '{name}' is no 4x4 matrix")
    camera_to_world = np.eye(4)
    camera_to_world[:3] = matrix[:3] * (1.0, -1.0, -1.0, 1.0)
    return _inverse(rigid(camera_to_world, name, source))


def _frame_lens(values: dict, picture: Path, source: Path) -> Lens:
    """Lens from the frame's keys over the file's: focal length in pixels, or else angle of view."""
    try:
        number = lambda key, default=0.0: float(values.get(key, default))
        size = image_size(picture)
        width, height = number("w", size[0]), number("h", size[1])
        if "fl_x" in values:
            fx = number("fl_x")
        elif "camera_angle_x" in values:
            fx = 0.5 * width / np.tan(0.5 * number("camera_angle_x"))
        else:
            raise ValueError(f"{source}: neither fl_x nor camera_angle_x for '{picture.name}'; one of them is needed")
        if "fl_y" in values:
            fy = number("fl_y")
        elif "camera_angle_y" in values:
            fy = 0.5 * height / np.tan(0.5 * number("camera_angle_y"))
        else:
            fy = fx
        model = str(values.get("camera_model", "OPENCV")).upper()
        fisheye = "FISHEYE" in model or bool(values.get("is_fisheye", False))
        if model not in _TRANSFORMS_MODELS:
            understood = ", ".join(_TRANSFORMS_MODELS)
            raise ValueError(f"{source}: camera_model {model} is not understood; one of {understood}")
        k = [number(f"k{i}") for i in range(1, 7)]
        rational = model == "FULL_OPENCV"
        lens = Lens(
            round(width),
            round(height),
            fx,
            fy,
            number("cx", width / 2),
            number("cy", height / 2),
            radial=_trimmed(k[:3] if rational else k[:4]),
            denominator=_trimmed(k[3:]) if rational else (),
            tangential=(0.0, 0.0) if fisheye else (number("p1"), number("p2")),
            fisheye=fisheye,
            model=model,
        )
    except TypeError as error:
        raise ValueError(f"{source}: the intrinsics of '{picture.name}' are no numbers ({error})") from error
    if not np.isfinite([lens.fx, lens.fy, lens.cx, lens.cy, *lens.radial, *lens.tangential]).all() or lens.fx <= 0:
        raise ValueError(f"{source}: the intrinsics of '{picture.name}' are not finite and positive")
    return fitted(lens, picture)


_TRANSFORMS_MODELS = (
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


def _trimmed(coefficients: list[float]) -> tuple[float, ...]:
    """Without the zeros at the end."""
    while coefficients and coefficients[-1] == 0.0:
        coefficients = coefficients[:-1]
    return tuple(coefficients)


def _points_of_transforms(
    folder: Path, record: dict, lenses: dict[str, Lens], poses: dict[str, np.ndarray]
) -> tuple[tuple[np.ndarray, np.ndarray], str | None]:
    """The points of `ply_file_path` (or sparse_pc.ply), in the frame of the poses; and a warning, or None.

    `applied_transform` and `applied_scale` say what was done to poses and points alike: there is nothing to undo.
    """
    listed = record.get("ply_file_path")
    path = folder / (listed or "sparse_pc.ply")
    if not path.is_file():
        return NO_POINTS, f"{path}: named by transforms.json, but missing" if listed else None
    points, colors = load_points(path)
    finite = np.isfinite(points).all(axis=1)
    points, colors = points[finite], colors[finite]
    shares = [len(depths_in_view(points, poses[name], lens)) for name, lens in lenses.items()]
    if len(points) == 0 or np.median(shares) < 0.02 * len(points):
        return NO_POINTS, f"{path}: its points are not in the frame of the poses and are not used"
    return (points, colors), None


# ---------------------------------------------------------------------------------------------- photos


def _read_photos(folder: Path, images: str | None) -> Capture:
    image_folder = _image_folder(folder, images, ("images", "photos", "input", "."))
    pictures = pictures_in(image_folder)
    sizes: dict[tuple[int, int], list[str]] = {}
    for name, path in pictures.items():
        sizes.setdefault(image_size(path, upright=True), []).append(name)
    if len(sizes) > 1:
        shown = "; ".join(f"{w}x{h}: {', '.join(names[:3])}" for (w, h), names in sizes.items())
        raise ValueError(
            f"{image_folder}: pictures of {len(sizes)} sizes and no intrinsics ({shown}); "
            "bring poses and intrinsics (COLMAP or transforms.json), or photos of one size"
        )
    return Capture("photos", pictures, None, None, image_folder, frozenset(), ())


_READERS: dict[str, Callable[[Path, str | None], Capture]] = {
    "llff": _read_llff,
    "colmap": _read_colmap,
    "transforms": _read_transforms,
    "photos": _read_photos,
}

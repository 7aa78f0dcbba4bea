"""Reference pictures as other tools write them, and captures of a wall with a square before it, which they complete."""

import io
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from reffusion.io.arrays import save_json, save_labels
from reffusion.io.images import save_image, save_mask
from reffusion.io.scene import load_references, load_scene, save_mask_sets
from reffusion.types import MaskSet, Reference
from scenes import wall_scene
from scenes.capture import PINHOLE, Truth, write_transforms
from scenes.images import paint_red
from stages import reference

SIZE = (160, 120)
COMMON = {"inpainter": "exemplar"}


def resize_and_compress(image: np.ndarray, scale=0.97, crop=5, quality=80, gain=0.92) -> np.ndarray:
    """Return the picture resized, cropped by `crop` px at the top and the left, darkened, and compressed as JPEG."""
    size = tuple(round(side * scale) for side in image.shape[1::-1])
    small_one = cv2.resize(image, size, interpolation=cv2.INTER_AREA)[crop:, crop:]
    file = io.BytesIO()
    Image.fromarray((small_one * gain).astype(np.uint8)).save(file, "JPEG", quality=quality)
    return np.array(Image.open(file).convert("RGB"))


def reference_entry(view, image="ref.png", **more):
    return {"reference": {"view": view, "image": image, **more}}


def write_wall_stages(folder: Path) -> dict[str, Path]:
    """Write the input folders of the stage `reference`; return input name -> folder.

    The views show a wall with a red square before it. View a2 is the best reference.
    """
    made_poses, fitted, labels = wall_scene.write_poses_and_fit(folder, 1.6)
    wall_scene.write_capture_photos(folder / "scene", made_poses, wall_scene.CAMERAS)
    sets = {}
    for name, camera in wall_scene.CAMERAS.items():
        mask, unseen = wall_scene.true_mask(camera, 1.6), wall_scene.true_unobserved(camera, 1.6)
        sets[name] = MaskSet(mask, mask, unseen, unseen)
        save_image(made_poses / "images" / f"{name}.png", paint_red(wall_scene.photo(camera), mask))
    save_mask_sets(folder / "masks", sets)
    save_labels(folder / "masks" / "labels.npy", labels)
    save_json(folder / "masks" / "facts.json", {"best_reference": "a2"})
    wall_scene.write_background(made_poses, fitted, folder / "masks")
    return {"scene": folder / "scene", "poses": made_poses, "fit": fitted, "masks": folder / "masks"}


def run_reference_stage(wall: dict[str, Path], out: Path, **params) -> dict[str, Reference]:
    """Run the stage `reference` into the folder `out`; return view name -> reference."""
    out.mkdir()
    reference.run(reference.Params(**COMMON, **params), out, **wall)
    return {r.camera.name: r for r in load_references(out, load_scene(wall["poses"]))}


def write_wall_capture(folder: Path) -> Path:
    """Write a capture of the wall with a red square before it, and masks of the square."""
    cameras = {name: wall_scene.CAMERAS[name] for name in wall_scene.TRAIN}
    points = np.stack([*(a.ravel() for a in np.meshgrid(np.linspace(-1, 1, 20), np.linspace(-0.7, 0.7, 14))),
                       np.full(280, wall_scene.WALL)], -1)  # fmt: skip
    folder.mkdir()
    write_transforms(folder, Truth({n: c.world_to_camera for n, c in cameras.items()}, points, PINHOLE))
    for name, camera in cameras.items():
        mask = wall_scene.true_mask(camera, 1.4)
        save_image(folder / f"images/{name}.png", paint_red(wall_scene.photo(camera), mask))
        save_mask(folder / f"masks/{name}.png", mask)
    return folder

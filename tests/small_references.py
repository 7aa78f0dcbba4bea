"""References for tests: pictures as other tools write them, and a wall with a square before it whose hole they fill."""

import io
from pathlib import Path

import cv2
import numpy as np
import small_scene as small
from PIL import Image

from reffusion.io.arrays import save_json, save_labels
from reffusion.io.images import save_image
from reffusion.io.scene import load_references, load_scene, save_mask_sets
from reffusion.types import MaskSet, Reference
from stages import reference

SIZE = (160, 120)
COMMON = {"inpainter": "exemplar"}


def pattern(seed: int, size=SIZE) -> np.ndarray:
    """uint8 [H, W, 3] with as much energy in each octave, as photographs have."""
    rng, (width, height) = np.random.default_rng(seed), size
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]).clip(1 / width)
    fields = [np.fft.ifft2(np.fft.fft2(rng.normal(size=(height, width))) / frequency).real for _ in range(3)]
    mixed = [fields[0] + 0.3 * field for field in fields]  # mostly grey, as photographs are
    return np.stack([np.clip(128 + 40 * f / f.std(), 0, 255) for f in mixed], -1).astype(np.uint8)


def from_another_tool(image: np.ndarray, scale=0.97, crop=5, quality=80, gain=0.92) -> np.ndarray:
    """Resized, cropped at its upper left, darker, and saved as JPEG."""
    size = tuple(round(side * scale) for side in image.shape[1::-1])
    small_one = cv2.resize(image, size, interpolation=cv2.INTER_AREA)[crop:, crop:]
    file = io.BytesIO()
    Image.fromarray((small_one * gain).astype(np.uint8)).save(file, "JPEG", quality=quality)
    return np.array(Image.open(file).convert("RGB"))


def psnr(a: np.ndarray, b: np.ndarray, where: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(((a.astype(float) - b)[where] ** 2).mean(), 1e-3)))


def named(view, image="ref.png", **more):
    return {"reference": {"view": view, "image": image, **more}}


def write_wall(folder: Path) -> dict[str, Path]:
    """The folders that the stage is handed, of the wall with a square before it; a2's hole is to be invented."""
    made_poses, fitted, labels = small.write(folder, 1.6)
    small.write_photos(folder / "scene", made_poses, small.CAMERAS)
    sets = {}
    for name, camera in small.CAMERAS.items():
        mask, unseen = small.true_mask(camera, 1.6), small.true_never_seen(camera, 1.6)
        sets[name] = MaskSet(mask, mask, unseen, unseen)
        photo = np.where(mask[..., None], np.uint8([230, 26, 26]), small.photo(camera))
        save_image(made_poses / "images" / f"{name}.png", photo)
    save_mask_sets(folder / "masks", sets)
    save_labels(folder / "masks" / "labels.npy", labels)
    save_json(folder / "masks" / "facts.json", {"best_reference": "a2"})
    small.write_background(made_poses, fitted, folder / "masks")
    return {"scene": folder / "scene", "poses": made_poses, "fit": fitted, "masks": folder / "masks"}


def completed(wall: dict[str, Path], out: Path, **params) -> dict[str, Reference]:
    """View name -> reference, as the stage writes it."""
    out.mkdir()
    reference.run(reference.Params(**COMMON, **params), out, **wall)
    return {r.camera.name: r for r in load_references(out, load_scene(wall["poses"]))}

"""What a render is compared with: the view's own picture, and the mask of the object in it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io.images import load_image, load_mask
from reffusion.io.scene import load_raw_masks

if TYPE_CHECKING:
    from reffusion.types import Camera, Scene


def load_ground_truth(camera: Camera, poses: Path) -> np.ndarray | None:
    """uint8 [H, W, 3], the view's own picture; None where the scene has none.

    Raises:
        ValueError: the picture and its camera differ in size.
    """
    path = poses / "images" / f"{camera.name}.png"
    if not path.exists():
        return None
    image = load_image(path)
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(
            f"{path}: {image.shape[1]}x{image.shape[0]} px, its camera {camera.width}x{camera.height}; run poses again"
        )
    return image


def load_object_mask(camera: Camera, raw_masks: Path, masks: Path | None) -> np.ndarray:
    """bool [H, W]: the object in a view.

    The first of these that exists: the view's test mask, its consistent mask, its raw mask (a variant may leave out
    the stage `masks`), an empty mask. So wherever there are test masks, all variants are scored in the same box.
    """
    size, file = (camera.height, camera.width), f"{camera.name}.png"
    paths = [raw_masks / "test_masks" / file, *([masks / "consistent" / file] if masks else [])]
    existing = [path for path in paths if path.exists()]
    if existing:
        return load_mask(existing[0], size)
    return load_raw_masks(raw_masks, [camera.name]).get(camera.name, np.zeros(size, bool))


def load_training_object_masks(scene: Scene, raw_masks: Path, masks: Path | None) -> dict[str, np.ndarray]:
    """View name -> bool [H, W], the object in each training view that may show it (not `clean`)."""
    names = [name for name in scene.train if name not in scene.clean]
    return {name: load_object_mask(scene.cameras[name], raw_masks, masks) for name in names}

"""Ground truth with which the render of a view is compared: the view's own picture, and the object's mask in it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io.images import load_image, load_mask
from reffusion.io.scene import load_raw_masks

if TYPE_CHECKING:
    from reffusion.types import Camera, Scene


def load_ground_truth(camera: Camera, poses: Path) -> np.ndarray | None:
    """Read a view's own undistorted picture as uint8 [H, W, 3]; None if the view has no picture.

    Args:
        poses: folder of the stage `poses`.

    Raises:
        ValueError: the picture is unreadable, or it and the camera differ in size.
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
    """Read the object's mask in a view as bool [H, W], True = the object.

    The mask is the first of the following that exists: the view's test mask; its consistent mask C (the rendered labels
    of the object's Gaussians); its raw mask (the union over all objects, if each has one), as a variant may skip the
    stage `masks`; an empty mask. The test mask comes first, so that all variants of a scene with test masks are scored
    in the same box.

    Args:
        raw_masks, masks: folders of the stages of these names; `masks` is None if that stage was skipped.
    """
    size, file = (camera.height, camera.width), f"{camera.name}.png"
    paths = [raw_masks / "test_masks" / file, *([masks / "consistent" / file] if masks else [])]
    existing = [path for path in paths if path.exists()]
    if existing:
        return load_mask(existing[0], size)
    return load_raw_masks(raw_masks, [camera.name]).get(camera.name, np.zeros(size, bool))


def load_training_object_masks(scene: Scene, raw_masks: Path, masks: Path | None) -> dict[str, np.ndarray]:
    """Read the object's mask in each training view, as a dict view name -> bool [H, W], True = the object.

    Views that the scene declares clean (without the object) are left out. For the arguments see `load_object_mask`.
    """
    names = [name for name in scene.train if name not in scene.clean]
    return {name: load_object_mask(scene.cameras[name], raw_masks, masks) for name in names}

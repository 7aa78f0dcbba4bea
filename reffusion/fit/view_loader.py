"""Iteration over the views of a fit in random order; a thread prepares each view while the previous step runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch
from torch import Tensor

from reffusion import seeding
from reffusion.types import Camera


def iterate_views(
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    weights: Mapping[str, np.ndarray],
    steps: range,
    seed: int,
    coarse: int = 0,
    device: torch.device | str = "cpu",
) -> Iterator[tuple[Camera, Tensor, Tensor | None]]:
    """Yield the view of each step, as camera, image and weights; a thread prepares it while the previous step runs.

    In each epoch every view appears once, in a new random order. The view of a step depends only on its number and the
    seed, so that a resumed fit continues the same sequence.

    Args:
        cameras: the views.
        images: view name -> uint8 [H, W, 3].
        weights: view name -> [H, W], weights of the pixels; a view without an entry has none.
        steps: the numbers of the steps, with stride 1; a resumed fit does not begin at 0.
        seed: seed of the order of the views.
        coarse: number of the first step that gets full views; all steps before it get views of half the size.
        device: the device of the tensors.

    Yields:
        The camera that fits the image, the image [H, W, 3] float32 in [0, 1], and the weights [H, W] float32 or None.
    """

    def prepare(i: int) -> tuple[Camera, Tensor, Tensor | None]:
        camera = cameras[seeding.epoch_index(i, len(cameras), seed, "views")]
        view = camera, images[camera.name], weights.get(camera.name)
        if i < coarse:
            return to_tensors(*downsample(*view), device)
        return to_tensors(*view, device)

    with ThreadPoolExecutor(1, thread_name_prefix="fit") as executor:
        pending = executor.submit(prepare, steps.start)
        for i in steps:
            ready = pending.result()
            pending = executor.submit(prepare, min(i + 1, steps.stop - 1))
            yield ready


def to_tensors(
    camera: Camera, image: np.ndarray, weights: np.ndarray | None, device: torch.device | str
) -> tuple[Camera, Tensor, Tensor | None]:
    """Convert a view to tensors on the device. An image is copied to a GPU as bytes, and converted there.

    Args:
        image: uint8 [H, W, 3].
        weights: [H, W] or None.

    Returns:
        The camera, the image [H, W, 3] float32 in [0, 1], and the weights [H, W] float32 or None.
    """
    counts = None if weights is None else torch.from_numpy(np.asarray(weights, np.float32)).to(device)
    return camera, torch.from_numpy(image).to(device).float() / 255, counts


def downsample(
    camera: Camera, image: np.ndarray, weights: np.ndarray | None
) -> tuple[Camera, np.ndarray, np.ndarray | None]:
    """Return the view (camera, image and weights) at half its size, rounded up.

    A pixel of the small view gets the lowest weight around the upper left pixel of its area: among 3 x 3 pixels, or
    5 x 5 in views of odd size, whose areas overlap three pixels. So a color to which a pixel of weight 0 contributes
    has weight 0.
    """
    size = (camera.width + 1) // 2, (camera.height + 1) // 2
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if weights is not None:
        side = 5 if camera.width % 2 or camera.height % 2 else 3
        lowest = cv2.erode(np.asarray(weights, np.float32), np.ones((side, side), np.uint8))
        weights = cv2.resize(lowest, size, interpolation=cv2.INTER_NEAREST)
    return camera.resized(*size), small, weights


def check_sizes(cameras: Sequence[Camera], images: Mapping[str, np.ndarray], weights: Mapping[str, np.ndarray]) -> None:
    """Check that every view has an image, and that images and weights have the size of their camera.

    Raises:
        ValueError: an image is missing, or an image or the weights (called mask in the message) have another size. The
            message names the view.
    """
    for camera in cameras:
        for kind, array in (("image", images.get(camera.name)), ("mask", weights.get(camera.name))):
            if array is None and kind == "image":
                raise ValueError(f"view '{camera.name}': no image was given")
            if array is not None and array.shape[:2] != (camera.height, camera.width):
                size = f"{array.shape[1]}x{array.shape[0]}"
                raise ValueError(f"view '{camera.name}': {kind} is {size}, camera is {camera.width}x{camera.height}")

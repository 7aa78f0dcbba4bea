"""Feeds views to a fit in random order, each prepared in a thread while the previous step runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch
from torch import Tensor

from reffusion import seeding
from reffusion.types import Camera

MIN_SPARSE_PIXELS = 200_000  # views with fewer pixels are never subsampled


def iterate_views(
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    weights: Mapping[str, np.ndarray],
    steps: range,
    seed: int,
    coarse: int = 0,
    sparse: range = range(0),
    device: torch.device | str = "cpu",
) -> Iterator[tuple[Camera, Tensor, Tensor | None]]:
    """Yields for each step (camera, image, weights), on `device`, prepared by a thread while the previous step runs.

    Steps before `coarse` get views of half the size. The steps `sparse` get every second pixel each way of views that
    are large enough, so that four visits cover all pixels.
    """

    def prepare(i: int) -> tuple[Camera, Tensor, Tensor | None]:
        camera = cameras[seeding.epoch_index(i, len(cameras), seed, "views")]
        view = camera, images[camera.name], weights.get(camera.name)
        if i < coarse:
            return to_tensors(*downsample(*view), device)
        if i in sparse and camera.width * camera.height >= MIN_SPARSE_PIXELS:
            phase = seeding.epoch_index(i // len(cameras), 4, seed, "pixels", camera.name)
            return to_tensors(*subsample(*view, phase % 2, phase // 2), device)
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
    """Camera, image [H, W, 3] in [0, 1] and weights on the device. Images are copied to a GPU as bytes."""
    counts = None if weights is None else torch.from_numpy(np.asarray(weights, np.float32)).to(device)
    return camera, torch.from_numpy(image).to(device).float() / 255, counts


def downsample(
    camera: Camera, image: np.ndarray, weights: np.ndarray | None
) -> tuple[Camera, np.ndarray, np.ndarray | None]:
    """The view at half its size, rounded up; a pixel's weight is the lowest of those it covers."""
    size = (camera.width + 1) // 2, (camera.height + 1) // 2
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if weights is not None:
        lowest = cv2.erode(np.asarray(weights, np.float32), np.ones((3, 3), np.uint8))
        weights = cv2.resize(lowest, size, interpolation=cv2.INTER_NEAREST)
    return camera.resized(*size), small, weights


def subsample(
    camera: Camera, image: np.ndarray, weights: np.ndarray | None, left: int, top: int
) -> tuple[Camera, np.ndarray, np.ndarray | None]:
    """Every second pixel of the view each way, from (left, top) on: a quarter of the work at full sharpness."""
    weights = None if weights is None else weights[top::2, left::2]
    return camera.sampled(2, left, top), np.ascontiguousarray(image[top::2, left::2]), weights


def check_sizes(cameras: Sequence[Camera], images: Mapping[str, np.ndarray], weights: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError naming a view without an image, or whose image or mask differs in size from its camera."""
    for camera in cameras:
        for kind, array in (("image", images.get(camera.name)), ("mask", weights.get(camera.name))):
            if array is None and kind == "image":
                raise ValueError(f"view '{camera.name}': no image was given")
            if array is not None and array.shape[:2] != (camera.height, camera.width):
                size = f"{array.shape[1]}x{array.shape[0]}"
                raise ValueError(f"view '{camera.name}': {kind} is {size}, camera is {camera.width}x{camera.height}")

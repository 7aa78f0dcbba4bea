"""The views in the order in which a fit takes them, each prepared while the step before it runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import torch
from torch import Tensor

from reffusion import seeding
from reffusion.types import Camera

SPARED = 200_000  # pixels of a view from which on a step can do without most of them


def samples(
    cameras: Sequence[Camera],
    images: Mapping[str, np.ndarray],
    weights: Mapping[str, np.ndarray],
    steps: range,
    seed: int,
    coarse: int = 0,
    sparse: range = range(0),
    device: torch.device | str = "cpu",
) -> Iterator[tuple[Camera, Tensor, Tensor | None]]:
    """What each of the steps sees, on `device`, prepared by a thread of its own while the step before it runs: before
    step `coarse` at half the size; in the steps `sparse` every second pixel each way, where there are enough, in four
    turns all."""

    def prepared(i: int) -> tuple[Camera, Tensor, Tensor | None]:
        camera = cameras[seeding.in_epochs(i, len(cameras), seed, "views")]
        view = camera, images[camera.name], weights.get(camera.name)
        if i < coarse:
            return sample(*halved(*view), device)
        if i in sparse and camera.width * camera.height >= SPARED:
            turn = seeding.in_epochs(i // len(cameras), 4, seed, "pixels", camera.name)
            return sample(*every_second(*view, turn % 2, turn // 2), device)
        return sample(*view, device)

    with ThreadPoolExecutor(1, thread_name_prefix="fit") as ahead:
        coming = ahead.submit(prepared, steps.start)
        for i in steps:
            ready = coming.result()
            coming = ahead.submit(prepared, min(i + 1, steps.stop - 1))
            yield ready


def sample(
    camera: Camera, image: np.ndarray, weights: np.ndarray | None, device: torch.device | str
) -> tuple[Camera, Tensor, Tensor | None]:
    """The view as the step sees it: camera, image in [0, 1], weights. Bytes go to a card, a quarter of the floats."""
    counts = None if weights is None else torch.from_numpy(np.asarray(weights, np.float32)).to(device)
    return camera, torch.from_numpy(image).to(device).float() / 255, counts


def halved(
    camera: Camera, image: np.ndarray, weights: np.ndarray | None
) -> tuple[Camera, np.ndarray, np.ndarray | None]:
    """The view at half its size, rounded up; a pixel counts as the least that it holds."""
    size = (camera.width + 1) // 2, (camera.height + 1) // 2
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if weights is not None:
        lowest = cv2.erode(np.asarray(weights, np.float32), np.ones((3, 3), np.uint8))
        weights = cv2.resize(lowest, size, interpolation=cv2.INTER_NEAREST)
    return camera.resized(*size), small, weights


def every_second(
    camera: Camera, image: np.ndarray, weights: np.ndarray | None, left: int, top: int
) -> tuple[Camera, np.ndarray, np.ndarray | None]:
    """Every second pixel of the view each way, from (left, top) on: a quarter of the work, all of the sharpness."""
    weights = None if weights is None else weights[top::2, left::2]
    return camera.sampled(2, left, top), np.ascontiguousarray(image[top::2, left::2]), weights


def check_sizes(cameras: Sequence[Camera], images: Mapping[str, np.ndarray], weights: Mapping[str, np.ndarray]) -> None:
    """ValueError naming a view without an image, or whose image or mask is not of its camera's size."""
    for camera in cameras:
        for kind, array in (("image", images.get(camera.name)), ("mask", weights.get(camera.name))):
            if array is None and kind == "image":
                raise ValueError(f"view '{camera.name}': no image was given")
            if array is not None and array.shape[:2] != (camera.height, camera.width):
                size = f"{array.shape[1]}x{array.shape[0]}"
                raise ValueError(f"view '{camera.name}': {kind} is {size}, camera is {camera.width}x{camera.height}")

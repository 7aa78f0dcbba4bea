"""Exposure compensation: an affine colour map for each view, optimised with the scene (as in the code of 3DGS).

A phone changes its exposure while it moves around a scene. Without compensation Gaussians learn the mean, or colours
that change with the direction. With it they have one exposure, and later stages use photographs normalised to it.
Views without a photograph take the exposure of the nearest photographs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from reffusion.fit.gains import BRIGHT, DARK
from reffusion.io.arrays import load_json, save_json
from reffusion.io.images import to_uint8
from reffusion.io.ply import load_ply
from reffusion.io.scene import has_photograph, load_scene, load_views
from reffusion.splat import rasterizer
from reffusion.types import Camera

FILE = "exposures.json"
LEARNING_RATE, FINAL_LEARNING_RATE = 1e-2, 1e-3  # Adam's step size at the start and at the end
MIN_DETERMINANT = 1e-5  # determinant of an exposure below which the picture is practically black
BRIGHTNESS_DEVIATION = 0.05  # standard deviation of the photographs' log brightness, from which exposures are fitted
# Of the kernel that interpolates exposures, in mean distances to the nearest photograph.
BANDWIDTHS = (0.5, 1.0, 2.0, 4.0, 16.0)
BLUR = 0.01  # of the width: blur under which a view is compared with its photograph
MIN_COVERAGE, MIN_PIXELS = 0.5, 100  # share of usable pixels around a compared pixel, and number of such pixels
ERROR_SCALE, REWEIGHTINGS = 0.03, 8  # difference above which a pixel gets a lower weight, and number of reweightings
# Of a gain; and deviation of colours above which gain and offset can be separated.
GAIN_BOUNDS, MIN_SPREAD = (0.4, 2.5), 0.02
PROTOCOL = (
    "the photographs differ in brightness: each channel of a test view is as bright as its photograph is outside the "
    "mask (gain and offset, by the fit, blurred); of one without a photograph, as those next to it are"
)
_IDENTITY = torch.eye(3, 4)


class Exposures:
    """A [3, 4] matrix for each view: photo = matrix[:, :3] @ colour + matrix[:, 3].

    Multiplying all matrices by one matrix, and all colours by its inverse, leaves the pictures unchanged. So the mean
    of the matrices is kept at the identity. PAPER leaves open: any exposure.
    """

    def __init__(self, names: Iterable[str], device: torch.device | str = "cpu", gains: np.ndarray | None = None):
        """Args: gains: [V, 3], initial brightness of each view's red, green and blue; None: all equal."""
        names = list(names)
        first = np.ones((len(names), 3)) if gains is None else gains / gains.mean(0)
        initial = lambda gain: torch.diag(torch.from_numpy(gain).float()) @ _IDENTITY
        self._matrices = {
            name: initial(gain).to(device).requires_grad_() for name, gain in zip(names, first, strict=True)
        }
        # One parameter per view: Adam skips those without a gradient, and counts the steps of each.
        self._adam = torch.optim.Adam(list(self._matrices.values()), lr=LEARNING_RATE, eps=1e-15)

    def apply(self, color: Tensor, name: str) -> Tensor:
        """[H, W, 3] with the exposure of the view; differentiable in the colours and in the exposure."""
        matrix = self._matrices[name]
        return color @ matrix[:, :3].T + matrix[:, 3]

    @torch.no_grad()
    def step(self, progress: float) -> None:
        """Update the exposures that have a gradient; `progress` of the run in [0, 1] sets the learning rate."""
        for group in self._adam.param_groups:
            group["lr"] = LEARNING_RATE ** (1 - progress) * FINAL_LEARNING_RATE**progress
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)
        shift = torch.stack(list(self._matrices.values())).mean(0)
        shift -= _IDENTITY.to(shift)
        for matrix in self._matrices.values():
            matrix -= shift

    def state_dict(self) -> dict:
        """State from which `load_state_dict` continues bit for bit."""
        return {"matrices": {n: m.detach().clone() for n, m in self._matrices.items()}, "adam": self._adam.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        with torch.no_grad():
            for name, matrix in self._matrices.items():
                matrix.copy_(state["matrices"][name])
        self._adam.load_state_dict(state["adam"])

    def save(self, folder: Path) -> None:
        save_json(folder / FILE, {name: matrix.detach().cpu().tolist() for name, matrix in self._matrices.items()})


def view_exposures(fit: Path, cameras: Sequence[Camera]) -> dict[str, np.ndarray]:
    """View name -> exposure [3, 4]: as fitted, or interpolated from nearby photographs for other views.

    Empty where no exposures were fitted.

    Args:
        cameras: of all views, including the fitted ones.
    """
    path = Path(fit) / FILE
    fitted = {name: np.array(matrix) for name, matrix in load_json(path).items()} if path.exists() else {}
    fitted_cameras = [camera for camera in cameras if camera.name in fitted]
    if not fitted_cameras:
        return {}
    distances = _pose_distances(fitted_cameras, fitted_cameras)
    matrices = np.stack([fitted[camera.name] for camera in fitted_cameras])
    np.fill_diagonal(distances, np.inf)
    mean_spacing = float(np.mean(distances.min(1))) if len(fitted_cameras) > 1 else 1.0
    interpolate = lambda distances, bandwidth: np.einsum(
        "vk,kij->vij", _kernel_weights(distances / (bandwidth * mean_spacing)), matrices
    )
    # Choose the bandwidth that predicts each photograph's exposure best from the others.
    leave_one_out_error = lambda bandwidth: float(np.square(interpolate(distances, bandwidth) - matrices).sum())
    bandwidth = min(BANDWIDTHS, key=leave_one_out_error) if len(fitted_cameras) > 2 else BANDWIDTHS[0]
    other_cameras = [camera for camera in cameras if camera.name not in fitted]
    interpolated = interpolate(_pose_distances(other_cameras, fitted_cameras), bandwidth) if other_cameras else []
    return fitted | {camera.name: matrix for camera, matrix in zip(other_cameras, interpolated, strict=True)}


def _pose_distances(views: Sequence[Camera], fitted_cameras: Sequence[Camera]) -> np.ndarray:
    """[V, K]: distances between poses, where a difference of viewing directions counts like one of the centres."""
    features = lambda cameras: np.array([[*camera.center, *camera.world_to_camera[2, :3]] for camera in cameras])
    return np.linalg.norm(features(views)[:, None] - features(fitted_cameras)[None], axis=-1)


def _kernel_weights(distances: np.ndarray) -> np.ndarray:
    """[V, K]: Gaussian kernel weights for distances [V, K]; they sum to 1 over K."""
    weights = np.exp(-(distances**2 - np.square(distances.min(1, keepdims=True))) / 2)
    return weights / weights.sum(1, keepdims=True)


def apply_exposure(color: Tensor, matrix: np.ndarray | None) -> Tensor:
    """[H, W, 3]: colours of the Gaussians with an exposure [3, 4] applied."""
    if matrix is None:
        return color
    exposure = torch.from_numpy(matrix).to(color)
    return color @ exposure[:, :3].T + exposure[:, 3]


def match_exposure(matrix: np.ndarray, color: np.ndarray, photo: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """[3, 4]: an exposure adjusted to a photograph by a gain and an offset per channel.

    It is returned unchanged where too few pixels can be compared. Both pictures are blurred first: where one is less
    sharp, the other's contrast would seem higher.

    Args:
        color: [H, W, 3] in [0, 1], the rendering with this exposure.
        photo: uint8 [H, W, 3].
        pixels: bool [H, W], the pixels to compare.
    """
    result = np.array(matrix, np.float64)
    usable = pixels & (photo > DARK).all(-1) & (photo < BRIGHT).all(-1)
    blur = lambda image: cv2.GaussianBlur(image.astype(np.float64), (0, 0), max(1.0, BLUR * usable.shape[1]))
    coverage = blur(usable)
    rows, columns = np.nonzero(usable & (coverage > MIN_COVERAGE))
    if len(rows) < MIN_PIXELS:
        return result
    compared = lambda image: (blur(image * usable) / np.maximum(coverage, 1e-6))[rows, columns]
    for channel in range(3):
        gain, offset = _fit_line(compared(color[..., channel]), compared(photo[..., channel] / 255.0))
        result[channel] *= gain
        result[channel, 3] += offset
    return result


def _fit_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Gain and offset of the robust line y = gain * x + offset, with the gain bounded."""
    weight, gain, offset = np.ones_like(x), 1.0, 0.0
    for _ in range(REWEIGHTINGS):
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        spread = np.average((x - mean_x) ** 2, weights=weight)
        gain = np.average((x - mean_x) * (y - mean_y), weights=weight) / max(spread, 1e-9)
        gain = float(np.clip(gain, *GAIN_BOUNDS)) if spread > MIN_SPREAD**2 else mean_y / max(mean_x, 1e-3)
        offset = mean_y - gain * mean_x
        weight = 1 / np.maximum(np.abs(y - gain * x - offset) / ERROR_SCALE, 1.0)
    return float(gain), float(offset)


def load_normalized_views(poses: Path, fit: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """View name -> uint8 [H, W, 3]: the photographs, `normalize_exposure`.

    Views without a photograph are rendered from the Gaussians in the folder `fit`, object included.
    """
    names = list(names)
    photographed = [name for name in names if has_photograph(poses, name)]
    photos = {name: normalize_exposure(image, fit, name) for name, image in load_views(poses, photographed).items()}
    renderings = render_views(poses, fit, [name for name in names if name not in photos])
    return {name: (photos | renderings)[name] for name in names}


@torch.no_grad()
def render_views(poses: Path, fit: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """View name -> uint8 [H, W, 3], rendered from the Gaussians in the folder `fit`."""
    if not names:
        return {}
    gaussians, cameras = load_ply(fit / "gaussians.ply"), load_scene(poses).cameras
    return {name: to_uint8(rasterizer.render(gaussians, cameras[name]).color.numpy()) for name in names}


def normalize_exposure(image: np.ndarray, fit: Path, name: str) -> np.ndarray:
    """uint8 [H, W, 3] in the exposure of the Gaussians in the folder `fit`: the view's fitted exposure is undone.

    Values are clipped to [0, 255]. The image is returned unchanged where no exposure was fitted, as for test views.

    Raises:
        ValueError: the exposure cannot be inverted.
    """
    path = Path(fit) / FILE
    matrices = load_json(path) if path.exists() else {}
    if name not in matrices:
        return image
    matrix = np.array(matrices[name])
    if abs(np.linalg.det(matrix[:, :3])) < MIN_DETERMINANT:
        raise ValueError(f"{path}: view '{name}' is too dark to undo its exposure; leave it out, or fit.exposure=never")
    return to_uint8(undo_exposure(image / 255.0, matrix))


def undo_exposure(color: np.ndarray, matrix: np.ndarray | None) -> np.ndarray:
    """[H, W, 3], the inverse of `apply_exposure`."""
    return color if matrix is None else (color - matrix[:, 3]) @ np.linalg.inv(matrix[:, :3]).T

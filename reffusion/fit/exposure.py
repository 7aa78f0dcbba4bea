"""Exposure compensation: an affine color map for each view, optimized with the scene (as in the code of 3DGS).

A phone changes its exposure while it moves around a scene. Without compensation Gaussians learn the mean of the
exposures, or colors that change with the viewing direction. With compensation all Gaussians have one exposure, and
later stages use photographs normalized to this exposure. A view without a photograph takes an average of the exposures
of nearby photographs.

The *exposure* of a view is an affine map [3, 4] from the colors of the Gaussians to the colors of the photograph:
photo = exposure[:, :3] @ color + exposure[:, 3], with colors in [0, 1].
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
from reffusion.io.scene import has_photograph, load_ignored, load_scene, load_views
from reffusion.splat import rasterizer
from reffusion.types import Camera

FILE = "exposures.json"
LEARNING_RATE, FINAL_LEARNING_RATE = 1e-2, 1e-3  # Adam's step size at the start and at the end
MIN_DETERMINANT = 1e-5  # determinant of an exposure below which the picture is practically black
BRIGHTNESS_DEVIATION = 0.05  # standard deviation of the photographs' log brightness, from which exposures are fitted
# Candidate bandwidths of the kernel that interpolates exposures, in units of the mean distance from a photograph to the
# nearest other one.
BANDWIDTHS = (0.5, 1.0, 2.0, 4.0, 16.0)
BLUR = 0.01  # share of the image's width: standard deviation of the blur before a view and its photograph are compared
MIN_COVERAGE, MIN_PIXELS = 0.5, 100  # share of usable pixels around a compared pixel, and number of such pixels
ERROR_SCALE, REWEIGHTINGS = 0.03, 8  # difference above which a pixel gets a lower weight, and number of reweightings
# Bounds of a fitted gain; standard deviation of the colors above which gain and offset can be separated.
GAIN_BOUNDS, MIN_SPREAD = (0.4, 2.5), 0.02
PROTOCOL = (
    "the photographs differ in brightness: each channel of a test view is as bright as its photograph is outside the "
    "mask (gain and offset, by the fit, blurred); of one without a photograph, as those next to it are"
)
_IDENTITY = torch.eye(3, 4)


class Exposures:
    """The exposures of V views, and the Adam optimizer that fits them together with the Gaussians.

    Each view has a matrix [3, 4]: photo = matrix[:, :3] @ color + matrix[:, 3]. Multiplying all matrices by one
    matrix, and all colors by the inverse of this matrix, leaves the pictures unchanged. So the mean of the matrices is
    kept at the identity. PAPER leaves open: exposure compensation, which it does not mention.
    """

    def __init__(self, names: Iterable[str], device: torch.device | str = "cpu", gains: np.ndarray | None = None):
        """Start from the given brightness of the views.

        Args:
            names: names of the V views.
            gains: [V, 3], relative brightness of each view's red, green and blue, for the initial matrices. None: all
                views are equally bright.
        """
        names = list(names)
        first = np.ones((len(names), 3)) if gains is None else gains / gains.mean(0)
        initial = lambda gain: torch.diag(torch.from_numpy(gain).float()) @ _IDENTITY
        self._matrices = {
            name: initial(gain).to(device).requires_grad_() for name, gain in zip(names, first, strict=True)
        }
        # One parameter per view: Adam skips those without a gradient, and counts the steps of each.
        self._adam = torch.optim.Adam(list(self._matrices.values()), lr=LEARNING_RATE, eps=1e-15)

    def apply(self, color: Tensor, name: str) -> Tensor:
        """Return colors [H, W, 3] with the exposure of view `name` applied, not clamped; differentiable in both."""
        matrix = self._matrices[name]
        return color @ matrix[:, :3].T + matrix[:, 3]

    @torch.no_grad()
    def step(self, progress: float) -> None:
        """Take one Adam step for the exposures that have a gradient, then shift all so that their mean is the identity.

        The gradients are cleared.

        Args:
            progress: share of the run in [0, 1] that is done; the learning rate decays exponentially with it, from
                `LEARNING_RATE` to `FINAL_LEARNING_RATE`.
        """
        for group in self._adam.param_groups:
            group["lr"] = LEARNING_RATE ** (1 - progress) * FINAL_LEARNING_RATE**progress
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)
        shift = torch.stack(list(self._matrices.values())).mean(0)
        shift -= _IDENTITY.to(shift)
        for matrix in self._matrices.values():
            matrix -= shift

    def state_dict(self) -> dict:
        """Return the state from which `load_state_dict` continues bit for bit."""
        return {"matrices": {n: m.detach().clone() for n, m in self._matrices.items()}, "adam": self._adam.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        """Restore a state returned by `state_dict`; the views must be the same."""
        with torch.no_grad():
            for name, matrix in self._matrices.items():
                matrix.copy_(state["matrices"][name])
        self._adam.load_state_dict(state["adam"])

    def save(self, folder: Path) -> None:
        """Write `folder`/exposures.json: view name -> matrix [3, 4]."""
        save_json(folder / FILE, {name: matrix.detach().cpu().tolist() for name, matrix in self._matrices.items()})


def view_exposures(fit: Path, cameras: Sequence[Camera]) -> dict[str, np.ndarray]:
    """Return the exposure of every view: as fitted, or for a view without a fit interpolated from nearby photographs.

    The interpolation averages the fitted exposures with Gaussian kernel weights of the distances between poses. All
    views have one bandwidth: the one of `BANDWIDTHS` with the least sum of squared errors when each fitted exposure is
    predicted from all other fitted exposures (the smallest one if fewer than three exposures were fitted).

    Args:
        fit: folder of the stage `fit`, which holds exposures.json if exposures were fitted.
        cameras: the cameras of all views, including the views with a fitted exposure.

    Returns:
        View name -> exposure [3, 4] float64. Empty if no exposures were fitted for any of `cameras`.
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
    # The diagonal of `distances` is infinite, so no photograph takes part in its own prediction.
    leave_one_out_error = lambda bandwidth: float(np.square(interpolate(distances, bandwidth) - matrices).sum())
    bandwidth = min(BANDWIDTHS, key=leave_one_out_error) if len(fitted_cameras) > 2 else BANDWIDTHS[0]
    other_cameras = [camera for camera in cameras if camera.name not in fitted]
    interpolated = interpolate(_pose_distances(other_cameras, fitted_cameras), bandwidth) if other_cameras else []
    return fitted | {camera.name: matrix for camera, matrix in zip(other_cameras, interpolated, strict=True)}


def _pose_distances(views: Sequence[Camera], fitted_cameras: Sequence[Camera]) -> np.ndarray:
    """Return the distances [V, K] between the poses of V views and of K fitted cameras."""
    # The distance is the length of a vector of six numbers: the difference of the two camera centers (normalized frame)
    # and the difference of the two unit viewing directions, with equal weight.
    features = lambda cameras: np.array([[*camera.center, *camera.world_to_camera[2, :3]] for camera in cameras])
    return np.linalg.norm(features(views)[:, None] - features(fitted_cameras)[None], axis=-1)


def _kernel_weights(distances: np.ndarray) -> np.ndarray:
    """Return Gaussian kernel weights [V, K] for distances [V, K] in units of the bandwidth; they sum to 1 over K."""
    # Subtracting the smallest square changes no normalized weight, and keeps the weights from all becoming 0.
    weights = np.exp(-(distances**2 - np.square(distances.min(1, keepdims=True))) / 2)
    return weights / weights.sum(1, keepdims=True)


def apply_exposure(color: Tensor, matrix: np.ndarray | None) -> Tensor:
    """Return the colors of rendered Gaussians with an exposure applied, [H, W, 3], not clamped.

    Args:
        color: [H, W, 3] in [0, 1].
        matrix: [3, 4]; None returns the colors unchanged.
    """
    if matrix is None:
        return color
    exposure = torch.from_numpy(matrix).to(color)
    return color @ exposure[:, :3].T + exposure[:, 3]


def match_exposure(matrix: np.ndarray, color: np.ndarray, photo: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return an exposure adjusted to a photograph: `matrix`, followed by a fitted gain and offset per channel.

    Both pictures are blurred before the comparison, because in a less sharp rendering contrast would seem lower, and
    the gain would compensate for sharpness instead of exposure. Pixels that are too dark or clipped in the photograph
    are left out.

    Args:
        matrix: [3, 4], the exposure to adjust.
        color: [H, W, 3] in [0, 1], the rendering, to which `matrix` is already applied.
        photo: uint8 [H, W, 3], the photograph of the same view.
        pixels: bool [H, W], True for the pixels to compare.

    Returns:
        [3, 4] float64; a copy of `matrix` if fewer than `MIN_PIXELS` pixels can be compared.
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
    """Fit y = gain * x + offset, [K] values in [0, 1], by reweighted least squares; return the gain and the offset."""
    weight, gain, offset = np.ones_like(x), 1.0, 0.0
    for _ in range(REWEIGHTINGS):
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        spread = np.average((x - mean_x) ** 2, weights=weight)
        gain = np.average((x - mean_x) * (y - mean_y), weights=weight) / max(spread, 1e-9)
        # The gain is bounded by `GAIN_BOUNDS`. If x varies too little to separate gain and offset, the gain is
        # mean(y) / mean(x), without bounds, and the offset is 0.
        gain = float(np.clip(gain, *GAIN_BOUNDS)) if spread > MIN_SPREAD**2 else mean_y / max(mean_x, 1e-3)
        offset = mean_y - gain * mean_x
        weight = 1 / np.maximum(np.abs(y - gain * x - offset) / ERROR_SCALE, 1.0)
    return float(gain), float(offset)


def load_photos_in_scene_exposure(poses: Path, fit: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Load the photographs of the named views, with the exposure of the Gaussians (see `normalize_exposure`).

    A photograph without a fitted exposure, as a test view's, is loaded as it is. A view without a photograph gets a
    rendering of the fitted Gaussians, object included, and so do the pixels that the scene ignores (`load_ignored`).

    Args:
        poses, fit: folders of the stages of these names.
        names: names of the views.

    Returns:
        View name -> uint8 [H, W, 3], in the order of `names`.

    Raises:
        ValueError: as `normalize_exposure`.
    """
    names = list(names)
    photographed = [name for name in names if has_photograph(poses, name)]
    photos = {name: normalize_exposure(image, fit, name) for name, image in load_views(poses, photographed).items()}
    ignored = {name: each for name, each in load_ignored(poses, photos).items() if each.any()}
    renderings = render_views(poses, fit, [name for name in names if name not in photos or name in ignored])
    mixed = {name: np.where(each[..., None], renderings[name], photos[name]) for name, each in ignored.items()}
    return {name: (renderings | photos | mixed)[name] for name in names}


@torch.no_grad()
def render_views(poses: Path, fit: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Render the named views from the Gaussians that the stage `fit` wrote, object included, on the CPU.

    The exposures of the views are not applied. Without names no file is read.

    Args:
        poses, fit: folders of the stages of these names.

    Returns:
        View name -> uint8 [H, W, 3].
    """
    if not names:
        return {}
    gaussians, cameras = load_ply(fit / "gaussians.ply"), load_scene(poses).cameras
    return {name: to_uint8(rasterizer.render(gaussians, cameras[name]).color.numpy()) for name in names}


def normalize_exposure(image: np.ndarray, fit: Path, name: str) -> np.ndarray:
    """Return a photograph with the exposure of the fitted Gaussians: the view's own fitted exposure is undone.

    Args:
        image: uint8 [H, W, 3], the photograph.
        fit: folder of the stage `fit`.
        name: the view's name.

    Returns:
        uint8 [H, W, 3], clipped to [0, 255]. `image` itself if the view has no fitted exposure, as test views.

    Raises:
        ValueError: the exposure cannot be inverted, because the photograph is almost black.
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
    """Return the colors of the Gaussians for the colors [H, W, 3] of a photograph; the inverse of `apply_exposure`.

    The result is not clamped.

    Args:
        color: [H, W, 3] in [0, 1].
        matrix: [3, 4], whose first three columns are invertible; None returns the colors unchanged.
    """
    return color if matrix is None else (color - matrix[:, 3]) @ np.linalg.inv(matrix[:, :3]).T

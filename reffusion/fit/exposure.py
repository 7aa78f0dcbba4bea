"""Exposure compensation: each view's own affine map of colours, fitted with the scene (as 3DGS's code does).

A phone re-exposes while it walks round. Without compensation Gaussians take the mean, or colours that change with the
direction; with it they have one exposure, and the photographs are brought to that one wherever they are used later.
Views that were not photographed are drawn as the nearest photographs are exposed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from reffusion.fit.gains import BRIGHT, DARK
from reffusion.io.images import to_uint8
from reffusion.splat import rasterizer
from reffusion.types import Camera

FILE = "exposures.json"
RATE, RATE_LAST = 1e-2, 1e-3  # Adam's step size at the start and at the end
SINGULAR = 1e-5  # determinant of an exposure under which it is a black picture
UNEVEN = 0.05  # deviation of the log of the photographs' brightness from which their exposures are fitted, too
REACHES = (0.5, 1.0, 2.0, 4.0, 16.0)  # of the mean way to the nearest photograph: how far exposures tell
BLUR = 0.01  # of the width, under which a view is compared with its photograph
WITHIN, ENOUGH = 0.5, 100  # share of a pixel's surroundings that must be compared, and how many such pixels
OFF, ROUNDS = 0.03, 8  # difference from which a pixel counts less, and rounds of reweighting
GAINS, LEAST_SPREAD = (0.4, 2.5), 0.02  # bounds of a gain, and deviation of the colours that tell one beside an offset
PROTOCOL = (
    "the photographs differ in brightness: each channel of a test view is as bright as its photograph is outside the "
    "mask (gain and offset, by the fit, blurred); of one without a photograph, as those next to it are"
)
_IDENTITY = torch.eye(3, 4)


class Exposures:
    """A [3, 4] matrix for each view: photo = matrix[:, :3] @ colour + matrix[:, 3].

    All matrices times one, and all colours times its inverse, would be the same pictures; so their mean is kept at the
    identity. PAPER leaves open: any exposure.
    """

    def __init__(self, names: Iterable[str], device: torch.device | str = "cpu", gains: np.ndarray | None = None):
        """Args: gains: [V, 3], how bright each view's red, green and blue are, to start from; None: all alike."""
        names = list(names)
        first = np.ones((len(names), 3)) if gains is None else gains / gains.mean(0)
        start = lambda gain: torch.diag(torch.from_numpy(gain).float()) @ _IDENTITY
        self._matrices = {
            name: start(gain).to(device).requires_grad_() for name, gain in zip(names, first, strict=True)
        }
        # a parameter for each view: Adam leaves those alone that got no gradient, and counts each one's steps
        self._adam = torch.optim.Adam(list(self._matrices.values()), lr=RATE, eps=1e-15)

    def apply(self, color: Tensor, name: str) -> Tensor:
        """[H, W, 3] as the view's camera exposed it; differentiable in the colours and in the exposure."""
        matrix = self._matrices[name]
        return color @ matrix[:, :3].T + matrix[:, 3]

    @torch.no_grad()
    def step(self, progress: float) -> None:
        """Move the exposures that got a gradient; `progress` in [0, 1] of the run sets the step size."""
        for group in self._adam.param_groups:
            group["lr"] = RATE ** (1 - progress) * RATE_LAST**progress
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)
        shift = torch.stack(list(self._matrices.values())).mean(0)
        shift -= _IDENTITY.to(shift)
        for matrix in self._matrices.values():
            matrix -= shift

    def state_dict(self) -> dict:
        """What `load_state_dict` continues from, bit for bit."""
        return {"matrices": {n: m.detach().clone() for n, m in self._matrices.items()}, "adam": self._adam.state_dict()}

    def load_state_dict(self, state: dict) -> None:
        with torch.no_grad():
            for name, matrix in self._matrices.items():
                matrix.copy_(state["matrices"][name])
        self._adam.load_state_dict(state["adam"])

    def save(self, folder: Path) -> None:
        from reffusion.io.arrays import save_json

        save_json(folder / FILE, {name: matrix.detach().cpu().tolist() for name, matrix in self._matrices.items()})


def of_views(fit: Path, cameras: Sequence[Camera]) -> dict[str, np.ndarray]:
    """View name -> [3, 4], how a view is exposed: as was fitted, and other views as the photographs next to them; none
    where no exposures were fitted.

    Args:
        cameras: of all views, the fitted ones among them.
    """
    from reffusion.io.arrays import load_json

    path = Path(fit) / FILE
    fitted = {name: np.array(matrix) for name, matrix in load_json(path).items()} if path.exists() else {}
    known = [camera for camera in cameras if camera.name in fitted]
    if not known:
        return {}
    away, matrices = _apart(known, known), np.stack([fitted[camera.name] for camera in known])
    np.fill_diagonal(away, np.inf)
    unit = float(np.mean(away.min(1))) if len(known) > 1 else 1.0
    blended = lambda away, reach: np.einsum("vk,kij->vij", _shares(away / (reach * unit)), matrices)
    # How far photographs tell of each other is what tells each of them best by the others.
    misses = lambda reach: float(np.square(blended(away, reach) - matrices).sum())
    reach = min(REACHES, key=misses) if len(known) > 2 else REACHES[0]
    others = [camera for camera in cameras if camera.name not in fitted]
    told = blended(_apart(others, known), reach) if others else []
    return fitted | {camera.name: matrix for camera, matrix in zip(others, told, strict=True)}


def _apart(views: Sequence[Camera], known: Sequence[Camera]) -> np.ndarray:
    """[V, K]: how far views stand from others, and, in the same unit of the normalised frame, how unlike they look."""
    placed = lambda cameras: np.array([[*camera.center, *camera.world_to_camera[2, :3]] for camera in cameras])
    return np.linalg.norm(placed(views)[:, None] - placed(known)[None], axis=-1)


def _shares(away: np.ndarray) -> np.ndarray:
    """[V, K]: what each of K has to say, falling with its distance [V, K]; sums to 1."""
    weight = np.exp(-(away**2 - np.square(away.min(1, keepdims=True))) / 2)
    return weight / weight.sum(1, keepdims=True)


def exposed(color: Tensor, matrix: np.ndarray | None) -> Tensor:
    """[H, W, 3], colours of the Gaussians as a view of this exposure, [3, 4], shows them."""
    if matrix is None:
        return color
    of = torch.from_numpy(matrix).to(color)
    return color @ of[:, :3].T + of[:, 3]


def matched(matrix: np.ndarray, color: np.ndarray, photo: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """[3, 4], an exposure brought to that of a photograph, each channel by a factor and an offset; as it is where too
    little can be compared.

    Both are blurred first: what one of them does not show sharply would make the other's contrast seem higher.

    Args:
        color: [H, W, 3] in [0, 1], the view so exposed. photo: uint8 [H, W, 3]. pixels: bool [H, W], those compared.
    """
    found = np.array(matrix, np.float64)
    told = pixels & (photo > DARK).all(-1) & (photo < BRIGHT).all(-1)
    soft = lambda image: cv2.GaussianBlur(image.astype(np.float64), (0, 0), max(1.0, BLUR * told.shape[1]))
    mass = soft(told)
    rows, columns = np.nonzero(told & (mass > WITHIN))
    if len(rows) < ENOUGH:
        return found
    at = lambda image: (soft(image * told) / np.maximum(mass, 1e-6))[rows, columns]
    for channel in range(3):
        gain, offset = _line(at(color[..., channel]), at(photo[..., channel] / 255.0))
        found[channel] *= gain
        found[channel, 3] += offset
    return found


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Gain and offset of y by x, robust; the gain within what an exposure may be."""
    weight, gain, offset = np.ones_like(x), 1.0, 0.0
    for _ in range(ROUNDS):
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        spread = np.average((x - mean_x) ** 2, weights=weight)
        gain = np.average((x - mean_x) * (y - mean_y), weights=weight) / max(spread, 1e-9)
        gain = float(np.clip(gain, *GAINS)) if spread > LEAST_SPREAD**2 else mean_y / max(mean_x, 1e-3)
        offset = mean_y - gain * mean_x
        weight = 1 / np.maximum(np.abs(y - gain * x - offset) / OFF, 1.0)
    return float(gain), float(offset)


def load_views(poses: Path, fit: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """View name -> uint8 [H, W, 3], `normalised`; of a scene without photographs what the Gaussians of the folder `fit`
    show, the object too."""
    from reffusion.io import scene

    names = list(names)
    there = [name for name in names if scene.has_photograph(poses, name)]
    photos = {name: normalised(image, fit, name) for name, image in scene.load_views(poses, there).items()}
    drawn = rendered(poses, fit, [name for name in names if name not in photos])
    return {name: (photos | drawn)[name] for name in names}


@torch.no_grad()
def rendered(poses: Path, fit: Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """View name -> uint8 [H, W, 3], as the Gaussians of the folder `fit` show it."""
    from reffusion.io.ply import load_ply
    from reffusion.io.scene import load_scene

    if not names:
        return {}
    gaussians, cameras = load_ply(fit / "gaussians.ply"), load_scene(poses).cameras
    return {name: to_uint8(rasterizer.render(gaussians, cameras[name]).color.numpy()) for name in names}


def normalised(image: np.ndarray, fit: Path, name: str) -> np.ndarray:
    """uint8 [H, W, 3] as the Gaussians of the folder `fit` are exposed: with the exposure that was fitted to the view
    `name` taken out, and clipped to [0, 255]; as it is where none was fitted (always so for test views).

    Raises:
        ValueError: the exposure cannot be inverted.
    """
    from reffusion.io.arrays import load_json

    path = Path(fit) / FILE
    matrices = load_json(path) if path.exists() else {}
    if name not in matrices:
        return image
    matrix = np.array(matrices[name])
    if abs(np.linalg.det(matrix[:, :3])) < SINGULAR:
        raise ValueError(f"{path}: view '{name}' is too dark to undo its exposure; leave it out, or fit.exposure=never")
    return to_uint8(undone(image / 255.0, matrix))


def undone(color: np.ndarray, matrix: np.ndarray | None) -> np.ndarray:
    """[H, W, 3], the inverse of `exposed`."""
    return color if matrix is None else (color - matrix[:, 3]) @ np.linalg.inv(matrix[:, :3]).T

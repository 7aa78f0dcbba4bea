"""The background: what the photographs show around the removed object, and how its surfaces continue behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from reffusion import geometry
from reffusion.background.continuation import find_planes
from reffusion.background.mirrors import Mirror
from reffusion.background.plane import Plane, remove_reflected_depth
from reffusion.background.symmetry import find_mirrors
from reffusion.background.visibility import DepthView, count_views, with_photographed_depth
from reffusion.types import PARAMETERS, Camera, Gaussians

_PLANE_ARRAYS = (
    "normal",
    "offset",
    "origin",
    "axes",
    "cell_size",
    "continued",
    "enclosed",
    "free",
    "seen",
    "reflective",
)


@dataclass(frozen=True)
class Background:
    """What the photographs show around the removed object.

    Attributes:
        views: the training views' depth, with the object; a view without a photograph may be among them.
        photos: view name -> uint8 [H, W, 3], in the exposure of the Gaussians.
        masks: view name -> bool [H, W], C.
        planes, mirrors: surfaces and symmetric things around the object, which continue behind it.
        center: [3], the middle of the object. radius: the radius of most of it; infinite where nothing is removed.
        points: [P, 3], the scene's sparse points.
        unobserved: view name -> bool [H, W], pixels of C that no photograph shows.
        without_photo: names of the views without a photograph.
        completed: views completed before, as depth views without the object, and their pictures, uint8 [H, W, 3].
    """

    views: Sequence[DepthView]
    photos: Mapping[str, np.ndarray]
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)
    planes: Sequence[Plane] = ()
    mirrors: Sequence[Mirror] = ()
    center: np.ndarray = field(default_factory=lambda: np.zeros(3))
    radius: float = np.inf
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    unobserved: Mapping[str, np.ndarray] = field(default_factory=dict)
    without_photo: frozenset[str] = frozenset()
    completed: Sequence[tuple[DepthView, np.ndarray]] = ()

    @property
    def cameras(self) -> list[Camera]:
        return [view.camera for view in self.views]

    def photographed_depth(self, camera: Camera) -> np.ndarray:
        """[H, W] depth that a training view shows outside its mask, a mirror's that of its plane; 0 elsewhere."""
        nothing = np.zeros((camera.height, camera.width))
        depth = with_photographed_depth(nothing, camera, self.views)
        return remove_reflected_depth(depth, camera, self.planes)

    def is_empty(self, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """bool [H, W]: pixels at which other views see past a surface of this depth, [H, W], and few show it."""
        points = geometry.unproject(depth, camera).reshape(-1, 3)
        return count_views(points, self.views).is_empty.reshape(depth.shape)

    def with_planes(self, gaussians: Gaussians, labels: Tensor, seed: int = 0) -> Background:
        """The background with the planes around the labelled Gaussians, bool [N]; none where nothing is labelled."""
        if not labels.any():
            return self
        center, radius = robust_extent(gaussians.means[labels])
        planes = find_planes(center, radius, self.views, self.points, seed)
        return replace(self, planes=planes, center=center, radius=radius)

    def with_mirrors(self, remaining: Gaussians) -> Background:
        """The background with the mirrors of the things that the remaining Gaussians show around the object."""
        mirrors = find_mirrors(remaining, self.center, self.radius, self.views, self.planes, self.photos)
        return replace(self, mirrors=mirrors)


def robust_extent(means: Tensor) -> tuple[np.ndarray, float]:
    """Middle [3] and radius of most of the points [N, 3], N at least 1, float64.

    From medians: a tenth of the labels may be wrong, and as far away as the sky.
    """
    points = means.detach().double().cpu().numpy()
    center = np.median(points, 0)
    return center, 1.5 * float(np.median(np.linalg.norm(points - center, axis=1)))


def surfaces_to_arrays(background: Background) -> dict[str, np.ndarray]:
    """The planes and mirrors as arrays, which `surfaces_from_arrays` reads: finding them takes seconds."""
    arrays: dict[str, Any] = {"center": background.center, "radius": np.float64(background.radius)}
    for name in _PLANE_ARRAYS if background.planes else ():
        arrays[f"plane_{name}"] = np.stack([np.asarray(getattr(plane, name)) for plane in background.planes])
    for k, mirror in enumerate(background.mirrors):
        arrays |= {f"mirror{k}_{name}": getattr(mirror.thing, name).cpu().numpy() for name in PARAMETERS}
        arrays |= {f"mirror{k}_normal": mirror.normal, f"mirror{k}_offset": np.float64(mirror.offset)}
        arrays[f"mirror{k}_antialiased"] = np.bool_(mirror.thing.antialiased)
    return arrays


def surfaces_from_arrays(background: Background, arrays: Mapping[str, np.ndarray], device: str) -> Background:
    """The background with the planes and mirrors of `surfaces_to_arrays`."""
    columns = [arrays[f"plane_{name}"] for name in _PLANE_ARRAYS] if "plane_normal" in arrays else []
    fields: list[dict[str, Any]] = [
        {name: float(each) if each.ndim == 0 else each for name, each in zip(_PLANE_ARRAYS, row, strict=True)}
        for row in zip(*columns, strict=True)
    ]
    planes = [Plane(**each) for each in fields]
    mirrors, k = [], 0
    while f"mirror{k}_normal" in arrays:
        tensors = {name: torch.from_numpy(arrays[f"mirror{k}_{name}"]).to(device) for name in PARAMETERS}
        thing = Gaussians(**tensors, antialiased=bool(arrays[f"mirror{k}_antialiased"]))
        mirrors.append(Mirror(thing, arrays[f"mirror{k}_normal"], float(arrays[f"mirror{k}_offset"])))
        k += 1
    center, radius = arrays["center"], float(arrays["radius"])
    return replace(background, planes=planes, mirrors=mirrors, center=center, radius=radius)

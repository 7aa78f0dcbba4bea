"""The background: the surfaces that photographs show around the removed object, and their continuation behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
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
from reffusion.types import PARAMETERS, Camera, Gaussians, MaskSet, Scene

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
    """The surroundings of the removed object, as the photographs show them.

    Attributes:
        views: depth of the training views, rendered with the object. Camera-only views may be among them.
        photos: view name -> uint8 [H, W, 3], the photographs in the exposure of the Gaussians.
        masks: view name -> bool [H, W], the consistent masks C, True at pixels that show the object.
        planes: planes around the object, with the cells in which they continue behind the object.
        mirrors: things beside the object, with their planes of mirror symmetry.
        center: [3], the middle of the object.
        radius: radius around the center that contains most of the object; infinite if nothing is removed.
        points: [P, 3], the scene's sparse points.
        unobserved: view name -> bool [H, W], True at pixels of C whose background too few photographs show.
        camera_only: names of the camera-only views, which have no photograph.
        completed: the views that were completed earlier. For each, its depth without the object, and its picture, uint8
            [H, W, 3].
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
    camera_only: frozenset[str] = frozenset()
    completed: Sequence[tuple[DepthView, np.ndarray]] = ()

    @property
    def cameras(self) -> list[Camera]:
        """The cameras of `views`, in the same order."""
        return [view.camera for view in self.views]

    def photographed_depth(self, camera: Camera) -> np.ndarray:
        """Return the depth that a view shows outside its mask, [H, W] float64.

        Where the view shows a reflection, e.g. in a polished table, this is the depth of the reflecting plane
        (`plane.remove_reflected_depth`). Inside the mask and its margin, and where nothing is visible, the depth is 0.

        Args:
            camera: one of `cameras`; for another view the depth is 0 everywhere.
        """
        nothing = np.zeros((camera.height, camera.width))
        depth = with_photographed_depth(nothing, camera, self.views)
        return remove_reflected_depth(depth, camera, self.planes)

    def is_empty(self, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """Return bool [H, W], the pixels at which a surface of the given depth would contradict the views.

        At such a pixel at least two views see past the surface, and more views see past it than show a surface at the
        same place (`Visibility.is_empty`).

        Args:
            camera: the view of the surface.
            depth: [H, W], camera z of the surface.
        """
        points = geometry.unproject(depth, camera).reshape(-1, 3)
        return count_views(points, self.views).is_empty.reshape(depth.shape)

    def with_surfaces(self, object_means: Tensor, remaining: Gaussians) -> Background:
        """Return the background with newly found planes and mirrors, and the center and radius of the object.

        Mirrors are symmetric things around the object, with their mirror planes.

        Args:
            object_means: [N, 3], the centers of the removed Gaussians. If N is 0, the background stays as it is.
            remaining: the Gaussians of the scene without the removed ones.
        """
        if not len(object_means):
            return self
        center, radius = robust_extent(object_means)
        planes = find_planes(center, radius, self.views, self.points)
        mirrors = find_mirrors(remaining, center, radius, self.views, planes, self.photos)
        return replace(self, planes=planes, mirrors=mirrors, center=center, radius=radius)


def build_background(
    scene: Scene,
    views: Sequence[DepthView],
    photos: Mapping[str, np.ndarray],
    sets: Mapping[str, MaskSet] = MappingProxyType({}),
) -> Background:
    """Return the background before planes, mirrors and the extent of the object are known.

    `center` and `radius` have their defaults (the origin, and infinity).

    Args:
        scene: its sparse points, and the views without a photograph.
        views: depth of the training views, rendered with the object. Camera-only views may be among them.
        photos: view name -> uint8 [H, W, 3], the photographs in the exposure of the Gaussians.
        sets: view name -> pixel classes; empty before they are known.
    """
    return Background(
        views,
        photos,
        {name: each.consistent for name, each in sets.items()},
        points=scene.points,
        unobserved={name: each.unobserved for name, each in sets.items()},
        camera_only=frozenset(scene.camera_only),
    )


def robust_extent(means: Tensor) -> tuple[np.ndarray, float]:
    """Return the middle [3] and the radius of most of the points, float64.

    The middle is the median of the coordinates; the radius is 1.5 times the median distance from the middle. Medians
    are used because a tenth of the labels may be wrong, and such points may be as far away as the sky.

    Args:
        means: [N, 3], N at least 1.
    """
    points = means.detach().double().cpu().numpy()
    center = np.median(points, 0)
    return center, 1.5 * float(np.median(np.linalg.norm(points - center, axis=1)))


def surfaces_to_arrays(background: Background) -> dict[str, np.ndarray]:
    """Return planes, mirrors, center and radius as named arrays, for a file that `surfaces_from_arrays` reads.

    The surfaces are stored because finding them takes seconds.
    """
    arrays: dict[str, Any] = {"center": background.center, "radius": np.float64(background.radius)}
    for name in _PLANE_ARRAYS if background.planes else ():
        arrays[f"plane_{name}"] = np.stack([np.asarray(getattr(plane, name)) for plane in background.planes])
    for k, mirror in enumerate(background.mirrors):
        arrays |= {f"mirror{k}_{name}": getattr(mirror.thing, name).cpu().numpy() for name in PARAMETERS}
        arrays |= {f"mirror{k}_normal": mirror.normal, f"mirror{k}_offset": np.float64(mirror.offset)}
        arrays[f"mirror{k}_antialiased"] = np.bool_(mirror.thing.antialiased)
    return arrays


def surfaces_from_arrays(background: Background, arrays: Mapping[str, np.ndarray], device: str) -> Background:
    """Return the background with the planes, mirrors, center and radius that `surfaces_to_arrays` stored.

    Args:
        device: the torch device for the Gaussians of the mirrors.
    """
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

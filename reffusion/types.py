"""The data that moves between the parts of the method: frozen, without inheritance, without IO.

Axes, units and names are those of docs/architecture.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole view. Pixel (column i, row j) covers [i, i+1) x [j, j+1); its centre is (i+0.5, j+0.5).

    Attributes:
        name: the view's name, unique in the scene, without a file ending.
        width, height: image size in pixels.
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        world_to_camera: [4, 4] float64 rigid transform; the camera looks along +z, x right, y down.
        every: 1; for a view `sampled` from another, the distance of its pixels in pixels of that view.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray
    every: int = 1

    @cached_property
    def intrinsics(self) -> np.ndarray:
        """[3, 3] float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def center(self) -> np.ndarray:
        """[3] float64, the optical centre in the world."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def sampled(self, every: int, left: int, top: int) -> Camera:
        """Every `every`-th pixel of this view in both directions, from (left, top) on. A rendering has the same values
        at these pixels, since Gaussians keep the width that they have in this view."""
        sparse = lambda at, first: (at - first - 0.5) / every + 0.5  # the centre of the first pixel stays at 0.5
        return replace(
            self,
            width=-(-(self.width - left) // every),
            height=-(-(self.height - top) // every),
            fx=self.fx / every,
            fy=self.fy / every,
            cx=sparse(self.cx, left),
            cy=sparse(self.cy, top),
            every=self.every * every,
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """The window of this view whose upper left pixel is (left, top); it may extend beyond the image."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)


@dataclass(frozen=True)
class Similarity:
    """x_normalised = scale * (x_scene - offset). No rotation, so spherical harmonics pass unchanged.

    Attributes:
        scale: float64, positive.
        offset: [3] float64.
    """

    scale: float
    offset: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """[..., 3] in the scene's own frame -> normalised frame, in float64."""
        return (np.asarray(points, np.float64) - self.offset) * self.scale

    def invert(self, points: np.ndarray) -> np.ndarray:
        """[..., 3] in the normalised frame -> the scene's own frame, in float64."""
        return np.asarray(points, np.float64) / self.scale + self.offset


@dataclass(frozen=True)
class Scene:
    """The result of the `poses` stage: pinhole cameras and sparse points in the normalised frame.

    Attributes:
        cameras: view name -> Camera, sorted by name.
        train, test: names of the training and test views.
        clean: names of the training views in which the object is absent (their masked pixels may supervise).
        points: [P, 3] float64 sparse points.
        point_colors: [P, 3] uint8.
        similarity: from the scene's own frame to this one.
        blank: names of further views, without pixels: they are distilled, and supervise nothing.
        suspects: names of views that stay although their photographs contradict their poses.
        outliers: names of the views that were left out for that reason; they have no camera here.
    """

    cameras: dict[str, Camera]
    train: tuple[str, ...]
    test: tuple[str, ...]
    clean: frozenset[str]
    points: np.ndarray
    point_colors: np.ndarray
    similarity: Similarity
    blank: tuple[str, ...] = ()
    suspects: tuple[str, ...] = ()
    outliers: tuple[str, ...] = ()


@dataclass(frozen=True)
class Gaussians:
    """N anisotropic 3D Gaussians, parametrised as in 3DGS.

    Attributes:
        means: [N, 3], normalised frame.
        quaternions: [N, 4], wxyz, any length (a zero quaternion is the identity).
        log_scales: [N, 3], natural logarithm of the standard deviations.
        opacity_logits: [N].
        sh: [N, K, 3] spherical harmonics, K = (degree + 1)^2 in {1, 4, 9, 16}; colour = 0.5 + sum_k Y_k sh_k, clamped
            from below at 0.
        antialiased: they are meant for rendering with Mip-Splatting's 2D filter: what the low-pass widens loses opacity
            in proportion, so that a Gaussian adds up to the same from any distance. 3DGS: no.
    """

    means: Tensor
    quaternions: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor
    antialiased: bool = field(default=False, kw_only=True)

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        return round(self.sh.shape[1] ** 0.5) - 1

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """`function` applied to each parameter, e.g. `g.map(lambda p: p[keep])`."""
        return Gaussians(*(function(getattr(self, name)) for name in PARAMETERS), antialiased=self.antialiased)

    def zip_map(self, other: Gaussians, function: Callable[[Tensor, Tensor], Tensor]) -> Gaussians:
        """`function` applied to each pair of parameters, e.g. concatenation; `antialiased` is that of `self`."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in PARAMETERS)
        return Gaussians(*(function(*pair) for pair in pairs), antialiased=self.antialiased)


PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


class Rendering(NamedTuple):
    """The result of `splat.render`; every tensor is differentiable in the Gaussians unless stated otherwise.

    Attributes:
        color: [H, W, 3], background included.
        depth: [H, W] expected camera-z divided by alpha; 0 where alpha is 0.
        alpha: [H, W] in [0, 1).
        features: [H, W, C] blended features (not divided by alpha), or None.
        radii: [N] int32, pixel radius of the footprint, 0 where culled. Not differentiable.
    """

    color: Tensor
    depth: Tensor
    alpha: Tensor
    features: Tensor | None
    radii: Tensor


@dataclass(frozen=True)
class MaskSet:
    """The pixel classes of one view, bool [H, W] each.

    Attributes:
        raw: the given 2D mask (all False where none was given).
        consistent: C, rendered back from the labelled Gaussians; it must not supervise.
        unobserved: U, inside C: no other photograph shows what is visible there without the object.
        invent: I, the pixels to be invented: U (all of C with `masks.invent: consistent`), and the region to fill.
    """

    raw: np.ndarray
    consistent: np.ndarray
    unobserved: np.ndarray
    invent: np.ndarray


@dataclass(frozen=True)
class Reference:
    """A view completed in 2D.

    Attributes:
        camera: the view.
        image: [H, W, 3] uint8.
        mask: [H, W] bool, the pixels the reference stands for (the view's invent mask).
        depth: [H, W] float32, depth or disparity of any scale and offset, in the unit of the normalised frame where the
            scene's was its own, NaN where unknown (`alignment.align_either` aligns it with the scene); None where the
            scene brings none.
    """

    camera: Camera
    image: np.ndarray
    mask: np.ndarray
    depth: np.ndarray | None = None

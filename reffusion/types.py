"""The data types that the parts of the method exchange. They are frozen, use no inheritance, and do no IO.

docs/architecture.md defines axes, units and names. The *normalized frame* is the scene's frame, scaled to an extent of
about 1 and shifted, see `Similarity`.
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
    """A pinhole camera of one view. Pixel (column i, row j) covers [i, i+1) x [j, j+1); its center is (i+0.5, j+0.5).

    Attributes:
        name: the view's name, unique in the scene, without a file ending.
        width, height: image size in pixels.
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        world_to_camera: [4, 4] float64 rigid transform. In the camera's axes z points forward, x right, y down.
    """

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray

    @cached_property
    def intrinsics(self) -> np.ndarray:
        """[3, 3] float64, the matrix of focal lengths and principal point."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @cached_property
    def center(self) -> np.ndarray:
        """[3] float64, the optical center in world coordinates."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def resized(self, width: int, height: int) -> Camera:
        """Return the same view at another resolution: the whole field of view on an image of the given size in pixels.

        Width and height are scaled independently of each other.
        """
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    def shrunk(self, longest: int) -> Camera:
        """Return the view at a reduced resolution, with no side above `longest` px; small views stay the same."""
        share = min(1.0, longest / max(self.width, self.height))
        return self.resized(max(1, round(self.width * share)), max(1, round(self.height * share)))

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """Return the view that shows a window of this view.

        Args:
            left, top: column and row of the window's upper left pixel. The window may extend beyond the image.
            width, height: size of the window in pixels.
        """
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)


@dataclass(frozen=True)
class Similarity:
    """The map from the scene's own frame to the normalized frame: x_normalized = scale * (x_scene - offset).

    It has no rotation, so spherical harmonics stay the same.

    Attributes:
        scale: float64, positive.
        offset: [3] float64.
    """

    scale: float
    offset: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Map points [..., 3] from the scene's own frame to the normalized frame, in float64."""
        return (np.asarray(points, np.float64) - self.offset) * self.scale

    def invert(self, points: np.ndarray) -> np.ndarray:
        """Map points [..., 3] from the normalized frame to the scene's own frame, in float64."""
        return np.asarray(points, np.float64) / self.scale + self.offset


@dataclass(frozen=True)
class Scene:
    """The result of the `poses` stage: pinhole cameras and sparse points in the normalized frame.

    Attributes:
        cameras: view name -> Camera, sorted by name; all views except the outliers.
        train, test: names of the training and test views.
        clean: names of the training views that were photographed without the object. Their photographs may supervise
            masked pixels, too.
        points: [P, 3] float64 sparse points.
        point_colors: [P, 3] uint8.
        similarity: the map from the scene's own frame to the normalized frame.
        camera_only: names of views that are neither training nor test views and have no photograph. They supervise
            nothing, but are completed and distilled.
        suspects: names of the views that are kept although their photographs contradict their poses.
        outliers: names of the views that were left out because their photographs contradict their poses. `cameras` has
            no entry for them.
    """

    cameras: dict[str, Camera]
    train: tuple[str, ...]
    test: tuple[str, ...]
    clean: frozenset[str]
    points: np.ndarray
    point_colors: np.ndarray
    similarity: Similarity
    camera_only: tuple[str, ...] = ()
    suspects: tuple[str, ...] = ()
    outliers: tuple[str, ...] = ()


@dataclass(frozen=True)
class Gaussians:
    """N anisotropic 3D Gaussians, parametrized as in 3DGS.

    Attributes:
        means: [N, 3], in the normalized frame.
        quaternions: [N, 4], wxyz, of any length (a zero quaternion is the identity).
        log_scales: [N, 3], natural logarithm of the standard deviations.
        opacity_logits: [N].
        sh: [N, K, 3] spherical harmonics, K = (degree + 1)^2 in {1, 4, 9, 16}; color = 0.5 + sum_k Y_k sh_k, clamped
            from below at 0.
        antialiased: True if the Gaussians are rendered with the 2D filter of Mip-Splatting. The low-pass widens the
            footprint of a Gaussian; this filter lowers its opacity in proportion, so that the footprint's total
            contribution stays the same at any distance. 3DGS has no such filter.
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
        """Degree of the spherical harmonics that `sh` stores, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """Return the Gaussians with `function` applied to each parameter tensor, e.g. `g.map(lambda p: p[keep])`."""
        return Gaussians(*(function(getattr(self, name)) for name in PARAMETERS), antialiased=self.antialiased)

    def zip_map(self, other: Gaussians, function: Callable[[Tensor, Tensor], Tensor]) -> Gaussians:
        """Return the Gaussians with `function` applied to each pair of parameter tensors of `self` and `other`.

        An example of `function` is concatenation. `antialiased` is taken from `self`.
        """
        pairs = ((getattr(self, name), getattr(other, name)) for name in PARAMETERS)
        return Gaussians(*(function(*pair) for pair in pairs), antialiased=self.antialiased)


PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


class Rendering(NamedTuple):
    """The result of `splat.rasterizer.render`. All tensors but `radii` are differentiable in the Gaussians.

    Attributes:
        color: [H, W, 3], the blended colors over the background color.
        depth: [H, W], the blended camera z, divided by alpha; 0 where alpha is 0.
        alpha: [H, W] in [0, 1).
        features: [H, W, C], the blended features, not divided by alpha; None if no features were rendered.
        radii: [N] int32, radius of each Gaussian's footprint in pixels; 0 for a culled Gaussian.
    """

    color: Tensor
    depth: Tensor
    alpha: Tensor
    features: Tensor | None
    radii: Tensor


@dataclass(frozen=True)
class MaskSet:
    """The pixel classes of one view, bool [H, W] each; a pixel may be in several classes.

    Attributes:
        raw: True at the pixels of the object in the given 2D mask; all False if the view has no mask.
        consistent: C, True at pixels that show the object, rendered from the Gaussians that are labeled as the object.
            The photograph must not supervise these pixels, unless the view is clean (`Scene.clean`): its photograph
            does not show the object there. In a view without a photograph, C also holds the pixels that no photograph
            of another view shows.
        unobserved: U, True at those pixels of C where too few other photographs show the background, i.e. what is
            visible there once the object is removed. With `masks.invent: consistent` this is not examined, and U is C.
        invent: I, True at the pixels whose content is invented by reference and prior. These are the pixels of U (of C
            with `masks.invent: consistent`), and the pixels that the scene asks to fill. All are False if U is
            negligible in all views together (`masks.consolidation.drop_negligible`).
    """

    raw: np.ndarray
    consistent: np.ndarray
    unobserved: np.ndarray
    invent: np.ndarray


@dataclass(frozen=True)
class Reference:
    """A view that was completed in 2D: its picture shows the scene without the object, with the hole filled.

    Attributes:
        camera: the camera of the view.
        image: [H, W, 3] uint8, the completed picture.
        mask: [H, W] bool, True at the pixels that this picture fills. These are the view's invent mask I or a part of
            it, and in `initialize` also the object's shadow.
        depth: [H, W] float32, the depth map that the scene provides for this picture, NaN where unknown; None if it
            provides none. The values are depths or disparities with any scale and offset; `alignment.align_either`
            aligns them with the scene. Values that were depths in the unit of the scene are in the unit of the
            normalized frame here.
    """

    camera: Camera
    image: np.ndarray
    mask: np.ndarray
    depth: np.ndarray | None = None

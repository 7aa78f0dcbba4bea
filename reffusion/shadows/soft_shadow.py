"""The object's soft shadow on a plane, and its removal from photographs and Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from scipy import ndimage

from reffusion import geometry
from reffusion.shadows.light import DARK_OFFSET, relight
from reffusion.splat.conventions import SH0
from reffusion.types import Camera, Gaussians


@dataclass(frozen=True)
class SoftShadow:
    """The light that a soft shadow leaves on a plane.

    Attributes:
        normal: [3], unit normal of the plane.
        center: [3], the point of the plane below the middle of the map.
        axes: [2, 3], unit vectors of the map's rows and columns.
        cell_size: side of a cell, in world units.
        fade: [2] distances from the plane in world units; up to the first the shadow is complete, from the second none.
        log_light: [K, K], the map: logarithm of the brightness relative to that without the shadow, at most 0.
        tint: [3], the log light of each color channel divided by `log_light`.
    """

    normal: np.ndarray
    center: np.ndarray
    axes: np.ndarray
    cell_size: float
    fade: np.ndarray
    log_light: np.ndarray
    tint: np.ndarray

    @property
    def strength(self) -> float:
        """Share of the light that the shadow takes where it is darkest, in [0, 1)."""
        return float(1 - np.exp(self.log_light.min()))

    def log_light_at(self, points: np.ndarray) -> np.ndarray:
        """Return [P, 3], the log light of each color channel at world points [P, 3]; 0 outside the shadow."""
        offset = points - self.center
        at = offset @ self.axes.T / self.cell_size + (len(self.log_light) - 1) / 2
        on_plane = ndimage.map_coordinates(self.log_light, at.T, order=1, mode="constant", cval=0.0)
        low, high = self.fade
        share = np.clip((high - np.abs(offset @ self.normal)) / (high - low), 0, 1)
        return (on_plane * share)[:, None] * self.tint

    def remove_from_photo(self, photo: np.ndarray, camera: Camera, depth: np.ndarray) -> np.ndarray:
        """Return a photograph, uint8 [H, W, 3], without the shadow.

        Args:
            photo: uint8 [H, W, 3].
            camera: the view of the photograph.
            depth: [H, W], camera z of what the photograph shows; 0 where unknown, and there the photograph stays.
        """
        known = depth > 0
        light = np.zeros((*depth.shape, 3))
        light[known] = -self.log_light_at(geometry.unproject(np.where(known, depth, 1.0), camera)[known])
        return relight(photo, light)

    def remove_from_gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with the colors that they have without the shadow."""
        light = self.log_light_at(gaussians.means.detach().double().cpu().numpy())
        gain = torch.from_numpy(np.exp(-light)).to(gaussians.sh)[:, None, :]
        offset = DARK_OFFSET / 255
        sh = gaussians.sh * gain
        sh[:, 0] += (gain[:, 0] - 1) * (0.5 + offset) / SH0
        return replace(gaussians, sh=sh)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the attributes as arrays, for a file that `from_arrays` reads."""
        return {f"shadow_{each.name}": np.asarray(getattr(self, each.name)) for each in fields(self)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Self | None:
        """Return the shadow that `to_arrays` stored among `arrays`; None if `arrays` holds no shadow."""
        if "shadow_normal" not in arrays:
            return None
        values: dict[str, Any] = {each.name: arrays[f"shadow_{each.name}"] for each in fields(cls)}
        return cls(**values)

"""The results of the stages `poses`, `fit` and `masks`, which later stages load when they first use them.

C is the consistent mask of a view: the pixels that show the object, rendered from the object's Gaussians. The
*remaining Gaussians* are the Gaussians of the scene without those that are removed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from reffusion.background.model import Background, build_background, surfaces_from_arrays
from reffusion.background.visibility import DepthView, render_depth_views
from reffusion.fit import exposure
from reffusion.io.arrays import load_arrays, load_json, load_labels
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_ignored, load_mask_sets, load_object_labels, load_scene
from reffusion.prior import inpaint
from reffusion.shadows.soft_shadow import SoftShadow
from reffusion.types import Gaussians, MaskSet, Scene

SURFACES = "background.npz"  # file in the folder of `masks`: planes, mirrors and the object's shadow


@dataclass(frozen=True)
class Workspace:
    """The scene, its Gaussians, its masks and its background, read from the folders of finished stages.

    Each property is loaded or computed when it is first used.

    Attributes:
        poses, fit, masks: folders of the finished stages of these names.
        device: the torch device on which the Gaussians and labels are.
    """

    poses: Path
    fit: Path
    masks: Path
    device: str = "cpu"

    @cached_property
    def scene(self) -> Scene:
        """Cameras and sparse points in the normalized frame."""
        return load_scene(self.poses)

    @cached_property
    def gaussians(self) -> Gaussians:
        """The N Gaussians of the whole scene, with the object."""
        return load_ply(self.fit / "gaussians.ply", device=self.device)

    @cached_property
    def labels(self) -> Tensor:
        """bool [N], True for the Gaussians to remove: those of the object, and debris.

        Debris are Gaussians that the object hides and that no photograph supports (`masks/debris.py`).

        Raises:
            ValueError: the number of labels is not the number of Gaussians, so the labels belong to another fit.
        """
        labels = load_labels(self.masks / "labels.npy").to(self.device)
        if len(labels) != len(self.gaussians):
            count = len(self.gaussians)
            raise ValueError(f"{self.masks}: {len(labels)} labels for {count} Gaussians of {self.fit}: run masks again")
        return labels

    @cached_property
    def object_labels(self) -> Tensor:
        """bool [N], True for the Gaussians of the object, False for debris, which `labels` contains, too."""
        return load_object_labels(self.masks).to(self.device)

    @cached_property
    def remaining(self) -> Gaussians:
        """The remaining Gaussians: those of the scene without the object, its shadow, and debris."""
        return self.shadowless_gaussians.map(lambda p: p[~self.labels])

    @cached_property
    def shadowless_gaussians(self) -> Gaussians:
        """The N Gaussians of the whole scene, with the colors that they have without the object's soft shadow."""
        return self.shadow.remove_from_gaussians(self.gaussians) if self.shadow else self.gaussians

    @cached_property
    def shadow(self) -> SoftShadow | None:
        """The object's soft shadow, which no mask contains; None if the stage `masks` found none."""
        path = self.masks / SURFACES
        return SoftShadow.from_arrays(load_arrays(path)) if path.exists() else None

    @cached_property
    def mask_sets(self) -> dict[str, MaskSet]:
        """View name -> pixel classes, for every view of the scene."""
        return load_mask_sets(self.masks, self.scene.cameras)

    @cached_property
    def facts(self) -> dict[str, Any]:
        """The facts.json of the stage `masks`: numbers and names such as "best_reference"."""
        return load_json(self.masks / "facts.json")

    def load_photos(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        """Return the photographs of some views in the exposure of the Gaussians, without the object's soft shadow.

        Returns:
            View name -> uint8 [H, W, 3]. A view without a photograph gets a rendering of the Gaussians with the object.
        """
        photos = exposure.load_photos_in_scene_exposure(self.poses, self.fit, list(names))
        if shadow := self.shadow:
            for name in photos.keys() - self.scene.clean:
                view = self.depth_view(name)
                photos[name] = shadow.remove_from_photo(photos[name], view.camera, view.depth)
        return photos

    def depth_view(self, name: str) -> DepthView:
        """Return the depth of a view with the object, rendered when it is first asked for."""
        if name not in self._depth_views:
            hidden = {name: self.hidden(name)}
            [self._depth_views[name]] = render_depth_views(self.gaussians, [self.scene.cameras[name]], hidden)
        return self._depth_views[name]

    @cached_property
    def _depth_views(self) -> dict[str, DepthView]:
        """View name -> what `depth_view` has rendered."""
        return {}

    def hidden(self, name: str) -> np.ndarray:
        """Return bool [H, W], the pixels where a view's photograph shows the object, or what the scene ignores.

        The object is at the pixels of C. A clean view (photographed without the object) does not show it.
        """
        hidden = self.mask_sets[name].consistent & (name not in self.scene.clean)
        return hidden | self.ignored[name] if name in self.ignored else hidden

    @cached_property
    def ignored(self) -> dict[str, np.ndarray]:
        """Training view -> bool [H, W], pixels that neither train nor are filled; only views that have such pixels."""
        return load_ignored(self.poses, self.scene.train)

    def remove_object(self, name: str) -> np.ndarray:
        """Return a view without the object, uint8 [H, W, 3].

        Outside C this is the photograph without the object's soft shadow, inside C a rendering of the remaining
        Gaussians.
        """
        photo = self.load_photos([name])[name]
        return inpaint.composite_background(
            self.remaining, self.scene.cameras[name], photo, self.mask_sets[name].consistent
        )

    @cached_property
    def background(self) -> Background:
        """The surroundings of the object as the photographs show them, with planes and mirrors.

        The result also has the object's center and radius. A mirror is a plane of mirror symmetry of a thing beside the
        object (`background/mirrors.py`). Planes and mirrors are searched here if the stage `masks` did not save them.
        """
        arrays = load_arrays(self.masks / SURFACES)
        if "center" not in arrays:
            return self.background_views.with_surfaces(self.gaussians.means[self.labels], self.remaining)
        return surfaces_from_arrays(self.background_views, arrays, self.device)

    @cached_property
    def background_views(self) -> Background:
        """The background before its surfaces are known (`background.model.build_background`).

        For a camera-only view, a rendering of the Gaussians takes the place of the photograph. The pixels of
        this view that no photograph shows are in its mask C, so they count as hidden.
        """
        scene = self.scene
        photos = self.load_photos(scene.train)
        for name in scene.camera_only:
            everything = np.ones_like(self.hidden(name))
            nothing = np.zeros((1, 1, 3), np.uint8)
            photos[name] = inpaint.composite_background(
                self.shadowless_gaussians, scene.cameras[name], nothing, everything
            )
        views = [self.depth_view(name) for name in (*scene.train, *scene.camera_only)]
        return build_background(scene, views, photos, self.mask_sets)

"""What the stages `poses`, `fit` and `masks` leave to later stages, loaded when it is first asked for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from reffusion.background.model import Background, surfaces_from_arrays
from reffusion.background.visibility import render_depth_views
from reffusion.fit import exposure
from reffusion.io.arrays import load_arrays, load_json, load_labels
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_mask_sets, load_object_labels, load_scene
from reffusion.prior import inpaint
from reffusion.types import Gaussians, MaskSet, Scene

SURFACES = "background.npz"  # in the folder of `masks`: the planes and mirrors that were found there


@dataclass(frozen=True)
class Workspace:
    """The scene, its Gaussians and its masks.

    Attributes:
        poses, fit, masks: folders of finished stages.
        device: where Gaussians are.
    """

    poses: Path
    fit: Path
    masks: Path
    device: str = "cpu"

    @cached_property
    def scene(self) -> Scene:
        return load_scene(self.poses)

    @cached_property
    def gaussians(self) -> Gaussians:
        """N Gaussians of the whole scene, with the object."""
        return load_ply(self.fit / "gaussians.ply", device=self.device)

    @cached_property
    def labels(self) -> Tensor:
        """bool [N], the Gaussians to remove: the object's, and debris. ValueError where they are of another fit."""
        labels = load_labels(self.masks / "labels.npy").to(self.device)
        if len(labels) != len(self.gaussians):
            count = len(self.gaussians)
            raise ValueError(f"{self.masks}: {len(labels)} labels for {count} Gaussians of {self.fit}: run masks again")
        return labels

    @cached_property
    def object_labels(self) -> Tensor:
        """bool [N], the object's Gaussians, without debris."""
        return load_object_labels(self.masks).to(self.device)

    @cached_property
    def remaining(self) -> Gaussians:
        """The Gaussians without those to remove."""
        return self.gaussians.map(lambda p: p[~self.labels])

    @cached_property
    def mask_sets(self) -> dict[str, MaskSet]:
        """View name -> its pixel classes, of every view."""
        return load_mask_sets(self.masks, self.scene.cameras)

    @cached_property
    def facts(self) -> dict[str, Any]:
        """What `masks` wrote of itself."""
        return load_json(self.masks / "facts.json")

    def load_photos(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        """View name -> uint8 [H, W, 3], in the exposure of the Gaussians; without photographs their renders."""
        return exposure.load_normalized_views(self.poses, self.fit, list(names))

    def hidden(self, name: str) -> np.ndarray:
        """bool [H, W], where a view's photograph shows the object: C, and nothing in a clean view."""
        return self.mask_sets[name].consistent & (name not in self.scene.clean)

    def remove_object(self, name: str) -> np.ndarray:
        """uint8 [H, W, 3]: the photograph outside C, the remaining Gaussians' render in it."""
        photo = self.load_photos([name])[name]
        return inpaint.composite_background(
            self.remaining, self.scene.cameras[name], photo, self.mask_sets[name].consistent
        )

    @cached_property
    def background(self) -> Background:
        """What the photographs show around the object, with the planes and mirrors that `masks` found."""
        return surfaces_from_arrays(self.background_views, load_arrays(self.masks / SURFACES), self.device)

    @cached_property
    def background_views(self) -> Background:
        """The background without planes and mirrors. A view without a photograph is rendered instead, and what no
        photograph shows of it is hidden."""
        scene = self.scene
        names = (*scene.train, *scene.blank)
        hidden = {name: self.hidden(name) for name in names}
        photos = self.load_photos(scene.train)
        for name in scene.blank:
            everything = np.ones_like(hidden[name])
            nothing = np.zeros((1, 1, 3), np.uint8)
            photos[name] = inpaint.composite_background(self.gaussians, scene.cameras[name], nothing, everything)
        return Background(
            render_depth_views(self.gaussians, [scene.cameras[name] for name in names], hidden),
            photos,
            {name: each.consistent for name, each in self.mask_sets.items()},
            points=scene.points,
            unobserved={name: each.unobserved for name, each in self.mask_sets.items()},
            without_photo=frozenset(scene.blank),
        )

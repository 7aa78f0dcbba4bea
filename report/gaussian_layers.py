"""Gaussians of a finished scene that were kept, added and removed, from the initialization to the result."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from reffusion.io.arrays import load_json, load_labels
from reffusion.io.ply import load_ply
from reffusion.types import Gaussians, Similarity
from report.sheet import stage_folder

SAME_DISTANCE = 1e-5  # in units of the extent (1): nearer Gaussians of two files are the same one


@dataclass(frozen=True)
class GaussianLayers:
    """Gaussians of a finished scene.

    Attributes:
        states: title -> (kept, added) Gaussians, from the initialization to the result.
        removed: Gaussians that were removed; may be empty.
    """

    states: dict[str, tuple[Gaussians, Gaussians]]
    removed: Gaussians

    def select(self, state: str, kept: bool, added: bool, removed: bool) -> Gaussians:
        """The chosen parts of a state, as one scene."""
        parts = zip((*self.states[state], self.removed), (kept, added, removed), strict=True)
        chosen = [part if include else part.map(lambda p: p[:0]) for part, include in parts]
        return reduce(lambda one, other: one.zip_map(other, lambda a, b: torch.cat([a, b])), chosen)


def load_layers(home: Path, similarity: Similarity) -> GaussianLayers:
    """Load the layers of runs/<scene> or runs/<scene>@<variant>; `similarity` is the scene's.

    Raises:
        ValueError: the stage `evaluate` has not run.
    """
    finished = home / "evaluate"
    if not (finished / "scene.ply").exists():
        raise ValueError(f"{finished / 'scene.ply'} is missing; {finish_command(home)} makes it")
    used = {stage for stage, key in load_json(finished / "receipt.json")["needs"].items() if key}
    result = load_ply(finished / "scene.ply", similarity)
    none, states = result.map(lambda p: p[:0]), {}
    stages = [stage_folder(home, stage) for stage in ("initialize", "distill") if stage in used]
    added = find_added(result, stages[-1]) if stages else torch.zeros(len(result), dtype=torch.bool)
    kept, new = result.map(lambda p: p[~added]), result.map(lambda p: p[added])
    if "distill" in used:
        states["initialization"] = split_new(stages[0]) if "initialize" in used else (kept, none)
        states |= {f"step {path.stem}": (kept, load_ply(path)) for path in list_snapshots(stages[-1])}
    states["result"] = kept, new
    return GaussianLayers(states, load_removed(home, used, none))


def list_snapshots(distill: Path) -> list[Path]:
    """Snapshots of the added Gaussians that `distill` saved, in the order of their steps."""
    return sorted((distill / "snapshots").glob("*.ply"), key=lambda path: int(path.stem))


def split_new(folder: Path) -> tuple[Gaussians, Gaussians]:
    """A stage's Gaussians, as (kept, new)."""
    gaussians, new = load_ply(folder / "gaussians.ply"), load_labels(folder / "labels.npy")
    return gaussians.map(lambda p: p[~new]), gaussians.map(lambda p: p[new])


def find_added(result: Gaussians, folder: Path) -> Tensor:
    """bool [N]: Gaussians of the finished scene that a stage labelled as new.

    They are matched by position, since `finish` removes and adds Gaussians; what it adds around the capture counts as
    kept.
    """
    from scipy.spatial import cKDTree

    _, new = split_new(folder)
    if not len(new):
        return torch.zeros(len(result), dtype=torch.bool)
    distance, _ = cKDTree(new.means.numpy()).query(result.means.numpy(), distance_upper_bound=SAME_DISTANCE)
    return torch.from_numpy(np.isfinite(distance))


def load_removed(home: Path, used: set[str], none: Gaussians) -> Gaussians:
    """Gaussians of the fit that the stage `masks` labelled; `none`, an empty scene, if they are unknown."""
    masks, fit = stage_folder(home, "masks") / "labels.npy", stage_folder(home, "fit") / "gaussians.ply"
    if not {"masks", "fit"} <= used or not masks.exists() or not fit.exists():
        return none
    gaussians, labels = load_ply(fit), load_labels(masks)
    return gaussians.map(lambda p: p[labels]) if len(labels) == len(gaussians) else none


def finish_command(home: Path) -> str:
    """The command that finishes a scene."""
    scene, _, variant = home.name.partition("@")
    return f"`make scene={scene}{f' variant={variant}' if variant else ''} all`"

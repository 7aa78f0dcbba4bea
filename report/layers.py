"""What of a finished scene was kept, added and removed, from the initialization to the result."""

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

SAME = 1e-5  # of the scene's extent 1: Gaussians so near to one another are one, read from two files


@dataclass(frozen=True)
class Layers:
    """Gaussians of a finished scene.

    Attributes:
        states: title -> what was kept and what was added by then, in the order in which they came to be.
        removed: what was there and went; empty where nothing did.
    """

    states: dict[str, tuple[Gaussians, Gaussians]]
    removed: Gaussians

    def shown(self, state: str, kept: bool, added: bool, removed: bool) -> Gaussians:
        """The asked parts of a state."""
        parts = zip((*self.states[state], self.removed), (kept, added, removed), strict=True)
        chosen = [part if asked else part.map(lambda p: p[:0]) for part, asked in parts]
        return reduce(lambda one, other: one.zipped(other, lambda a, b: torch.cat([a, b])), chosen)


def load_layers(home: Path, similarity: Similarity) -> Layers:
    """Of runs/<scene> or runs/<scene>@<variant>, with the scene's similarity.

    Raises:
        ValueError: the stage `evaluate` has not run.
    """
    finished = home / "evaluate"
    if not (finished / "scene.ply").exists():
        raise ValueError(f"{finished / 'scene.ply'} is missing; {how(home)} makes it")
    used = {stage for stage, key in load_json(finished / "receipt.json")["needs"].items() if key}
    result = load_ply(finished / "scene.ply", similarity)
    none, states = result.map(lambda p: p[:0]), {}
    made = [stage_folder(home, stage) for stage in ("initialize", "distill") if stage in used]
    added = added_in(result, made[-1]) if made else torch.zeros(len(result), dtype=torch.bool)
    kept, new = result.map(lambda p: p[~added]), result.map(lambda p: p[added])
    if "distill" in used:
        states["initialization"] = apart(made[0]) if "initialize" in used else (kept, none)
        states |= {f"step {path.stem}": (kept, load_ply(path)) for path in snapshots(made[-1])}
    states["result"] = kept, new
    return Layers(states, removed_by(home, used, none))


def snapshots(distill: Path) -> list[Path]:
    """The Gaussians that were added, as they were after so many steps."""
    return sorted((distill / "snapshots").glob("*.ply"), key=lambda path: int(path.stem))


def apart(folder: Path) -> tuple[Gaussians, Gaussians]:
    """A stage's Gaussians: those that were kept, and those that are new."""
    gaussians, new = load_ply(folder / "gaussians.ply"), load_labels(folder / "labels.npy")
    return gaussians.map(lambda p: p[~new]), gaussians.map(lambda p: p[new])


def added_in(result: Gaussians, folder: Path) -> Tensor:
    """bool [N]: those of the finished scene that a stage labelled as new. `finish` leaves out and adds Gaussians, so
    they are told by where they are; what it adds beyond the capture counts as kept."""
    from scipy.spatial import cKDTree

    _, new = apart(folder)
    if not len(new):
        return torch.zeros(len(result), dtype=torch.bool)
    distance, _ = cKDTree(new.means.numpy()).query(result.means.numpy(), distance_upper_bound=SAME)
    return torch.from_numpy(np.isfinite(distance))


def removed_by(home: Path, used: set[str], none: Gaussians) -> Gaussians:
    """Of the fit, what the stage masks labelled."""
    masks, fit = stage_folder(home, "masks") / "labels.npy", stage_folder(home, "fit") / "gaussians.ply"
    if not {"masks", "fit"} <= used or not masks.exists() or not fit.exists():
        return none
    gaussians, labels = load_ply(fit), load_labels(masks)
    return gaussians.map(lambda p: p[labels]) if len(labels) == len(gaussians) else none


def how(home: Path) -> str:
    """The command that finishes a scene."""
    scene, _, variant = home.name.partition("@")
    return f"`make scene={scene}{f' variant={variant}' if variant else ''} all`"

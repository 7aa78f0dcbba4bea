"""Gaussians of a finished scene in three layers: kept, added and removed.

*Kept* Gaussians belong to the fit and remain in the result. *Added* Gaussians fill the hole. *Removed* Gaussians are
those that the stage `masks` labeled: the object, and debris that the object had hidden. The *states* of a scene are
the initialization, snapshots during the distillation, and the result. Without distillation the result is the only
state.
"""

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

SAME_DISTANCE = 1e-5  # in units of the scene's extent (1): Gaussians of two files closer than this are the same one


@dataclass(frozen=True)
class GaussianLayers:
    """Kept, added and removed Gaussians of a finished scene, in the normalized frame.

    Attributes:
        states: title of a state -> (kept Gaussians, added Gaussians), in order from the initialization to the result.
            Snapshots have the kept Gaussians of the result.
        removed: Gaussians of the object, and debris; may be empty.
    """

    states: dict[str, tuple[Gaussians, Gaussians]]
    removed: Gaussians

    def select(self, state: str, kept: bool, added: bool, removed: bool) -> Gaussians:
        """Return the chosen layers of a state as one set of Gaussians, in the order kept, added, removed.

        Args:
            state: title of the state, a key of `states`.
            kept: True includes the kept Gaussians.
            added: True includes the added Gaussians.
            removed: True includes the removed Gaussians, which are the same in all states.
        """
        parts = zip((*self.states[state], self.removed), (kept, added, removed), strict=True)
        chosen = [part if include else part.map(lambda p: p[:0]) for part, include in parts]
        return reduce(lambda one, other: one.zip_map(other, lambda a, b: torch.cat([a, b])), chosen)


def load_layers(home: Path, similarity: Similarity) -> GaussianLayers:
    """Load the layers of runs/<scene> or runs/<scene>@<variant>.

    Args:
        home: the folder.
        similarity: transform from the scene's own frame to the normalized frame.

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
    """Return the files of the added Gaussians that the stage `distill` saved, in the order of the steps."""
    return sorted((distill / "snapshots").glob("*.ply"), key=lambda path: int(path.stem))


def split_new(folder: Path) -> tuple[Gaussians, Gaussians]:
    """Load a stage's Gaussians and split them by their labels into (kept Gaussians, new Gaussians).

    Args:
        folder: folder of the stage `initialize` or `distill`, where True labels mean new Gaussians.
    """
    gaussians, new = load_ply(folder / "gaussians.ply"), load_labels(folder / "labels.npy")
    return gaussians.map(lambda p: p[~new]), gaussians.map(lambda p: p[new])


def find_added(result: Gaussians, folder: Path) -> Tensor:
    """Return bool [N], True for the Gaussians of the finished scene that a stage labeled as new.

    Gaussians are matched by position, up to `SAME_DISTANCE`, because the stage `finish` removes and adds Gaussians.
    Those that `finish` adds around the capture (the backdrop) count as kept, i.e. are False.

    Args:
        result: the N Gaussians of the finished scene, in the normalized frame.
        folder: folder of the stage `distill` or `initialize`.
    """
    from scipy.spatial import cKDTree

    _, new = split_new(folder)
    if not len(new):
        return torch.zeros(len(result), dtype=torch.bool)
    distance, _ = cKDTree(new.means.numpy()).query(result.means.numpy(), distance_upper_bound=SAME_DISTANCE)
    return torch.from_numpy(np.isfinite(distance))


def load_removed(home: Path, used: set[str], none: Gaussians) -> Gaussians:
    """Load the removed Gaussians: those of the fit that the stage `masks` labeled.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>.
        used: names of the stages that the result depends on.
        none: an empty set of Gaussians, which is returned if the removed ones are unknown.
    """
    masks, fit = stage_folder(home, "masks") / "labels.npy", stage_folder(home, "fit") / "gaussians.ply"
    if not {"masks", "fit"} <= used or not masks.exists() or not fit.exists():
        return none
    gaussians, labels = load_ply(fit), load_labels(masks)
    return gaussians.map(lambda p: p[labels]) if len(labels) == len(gaussians) else none


def finish_command(home: Path) -> str:
    """Return the command that runs all stages of a scene, in backticks."""
    scene, _, variant = home.name.partition("@")
    return f"`make scene={scene}{f' variant={variant}' if variant else ''} all`"

"""The result of a scene from which something was deleted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from reffusion.io.arrays import load_labels
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from report.results import load_receipts
from report.sheet import stage_folder

if TYPE_CHECKING:
    from torch import Tensor

    from reffusion.types import Gaussians


@dataclass(frozen=True)
class PatchResult:
    """A filled scene.

    Attributes:
        gaussians: in the normalised frame.
        new: bool [N], the Gaussians that fill the hole.
        poses: folder of the stage `poses`.
    """

    gaussians: Gaussians
    new: Tensor
    poses: Path


def load_result(home: Path) -> PatchResult:
    """Load runs/<scene> or runs/<scene>@<variant>. ValueError if nothing was deleted, or `evaluate` has not run."""
    require_deleted(home)
    poses, result = stage_folder(home, "poses"), home / "evaluate" / "scene.ply"
    if not result.exists():
        raise ValueError(f"{result} is missing; `make scene={home.name.split('@')[0]} patch` makes it")
    return PatchResult(
        load_ply(result, load_scene(poses).similarity), load_labels(result_stage_folder(home) / "labels.npy"), poses
    )


def require_deleted(home: Path) -> None:
    """Raise ValueError if the scene does not say what was deleted, according to its stage `poses`."""
    if not (stage_folder(home, "poses") / "deleted.npy").is_file():
        raise ValueError(
            "scene.yaml: nothing says what was deleted; `gaussians: scene.ply` names the scene before, "
            "`cleaned: cleaned.ply` what an editor left of it"
        )


def result_stage_folder(home: Path) -> Path:
    """Folder of the stage whose Gaussians are the result."""
    used = load_receipts({"evaluate": home / "evaluate"})["evaluate"]["needs"]
    return stage_folder(home, next(stage for stage in ("distill", "initialize") if used.get(stage)))

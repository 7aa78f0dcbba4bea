"""Result of a scene whose object a user deleted in an editor, and whose hole was then filled."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from reffusion.io.arrays import load_labels
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.io.scene_edits import repeat_edit
from report.results import load_receipts
from report.sheet import stage_folder

if TYPE_CHECKING:
    from torch import Tensor

    from reffusion.types import Gaussians, Similarity


MOST_NEW = 100  # new Gaussians for each deleted one, above which a warning is given; an object takes about 30


@dataclass(frozen=True)
class PatchResult:
    """Scene of Gaussians whose hole is filled, where the user left it in the editor.

    Attributes:
        gaussians: all N Gaussians of the result, in the normalized frame, turned as the user turned the scene.
        similarity: from the frame of the user's file to that of `gaussians`.
        new: bool [N], True for the Gaussians that fill the hole.
        deleted: number of Gaussians that the user deleted, without those around the scene, which count as cropped.
        others: number of further Gaussians that were removed.
    """

    gaussians: Gaussians
    similarity: Similarity
    new: Tensor
    deleted: int
    others: int

    def describe(self) -> str:
        """Return how many Gaussians were removed and added, with a warning if suspiciously many were added."""
        deleted, new, more = self.deleted, int(self.new.sum()), self.others
        others = f"and {more} more, haze and floaters inside or behind the hole" if more > 0 else "and no others"
        text = f"removed: the {deleted} splats that you deleted, {others}; added: {new} new splats"
        if new <= MOST_NEW * deleted:
            return text
        return (
            f"{text}\nwarning: that is more than {MOST_NEW} new splats for each deleted one: unless these were large, "
            "the hole reaches far beyond them; look at the result, and delete whole objects only"
        )


def load_result(home: Path) -> PatchResult:
    """Load the result of runs/<scene> or runs/<scene>@<variant>.

    Raises:
        ValueError: the scene does not say what was deleted, or the stage `evaluate` has not run.
    """
    require_deleted(home)
    poses, result = stage_folder(home, "poses"), home / "evaluate" / "scene.ply"
    if not result.exists():
        raise ValueError(f"{result} is missing; `make scene={home.name.split('@')[0]} patch` makes it")
    new, deleted = load_labels(result_stage_folder(home) / "labels.npy"), load_labels(poses / "deleted.npy")
    count = int(deleted.sum())
    others = len(deleted) - count - int((~new).sum())
    gaussians, similarity, new = repeat_edit(poses, load_ply(result, load_scene(poses).similarity), new)
    return PatchResult(gaussians, similarity, new, count, others)


def require_deleted(home: Path) -> None:
    """Check that the scene says what was deleted: that its stage `poses` has written deleted.npy.

    Raises:
        ValueError: the file is missing; the message names the keys of scene.yaml to set.
    """
    if not (stage_folder(home, "poses") / "deleted.npy").is_file():
        raise ValueError(
            "scene.yaml: nothing says what was deleted; `gaussians: scene.ply` names the scene before, "
            "`cleaned: cleaned.ply` what an editor left of it"
        )


def result_stage_folder(home: Path) -> Path:
    """Return the folder of the stage whose Gaussians are the result: `distill`, or `initialize` if that was skipped."""
    used = load_receipts({"evaluate": home / "evaluate"})["evaluate"]["needs"]
    return stage_folder(home, next(stage for stage in ("distill", "initialize") if used.get(stage)))

"""A patched hole as files for an editor: `python -m report.patch --scene X` (`make scene=X patch`)."""

from __future__ import annotations

from pathlib import Path

from reffusion.io.arrays import load_labels
from reffusion.io.ply import load_ply, properties_of, save_ply
from reffusion.io.scene import load_scene
from report import command
from report.results import load_receipts
from report.sheet import stage_folder

WHOLE, NEW = "patched.ply", "new.ply"


def check(home: Path) -> None:
    """ValueError where the scene does not say what was deleted, as far as its stage `poses` knows."""
    if not (stage_folder(home, "poses") / "deleted.npy").is_file():
        raise ValueError(
            "scene.yaml: nothing says what was deleted; `gaussians: scene.ply` names the scene before, "
            "`cleaned: cleaned.ply` what an editor left of it"
        )


def make(home: Path) -> str:
    """Write patch/patched.ply, the whole scene, and patch/new.ply, what was put in: both in the scene's own frame,
    their properties in the order of the file that the scene brought. What to say of them.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>, its stage `evaluate` finished.

    Raises:
        ValueError: nothing was deleted, or that stage has not run.
    """
    check(home)
    poses, finished = stage_folder(home, "poses"), home / "evaluate" / "scene.ply"
    if not finished.exists():
        raise ValueError(f"{finished} is missing; `make scene={home.name.split('@')[0]} patch` makes it")
    similarity, properties = load_scene(poses).similarity, properties_of(poses / "gaussians.ply")
    result, new = load_ply(finished, similarity), load_labels(last_of(home) / "labels.npy")
    out = home / "patch"
    save_ply(out / WHOLE, result, similarity, properties)
    save_ply(out / NEW, result.map(lambda parameter: parameter[new]), similarity, properties)
    kept, stayed = int((~load_labels(poses / "deleted.npy")).sum()), len(result) - int(new.sum())
    more = kept - stayed
    left = f"; {more} more than were deleted are gone: haze, and what the object hid" if more > 0 else ""
    return (
        f"{out / WHOLE}: the whole scene, {len(result)} splats{left}\n"
        f"{out / NEW}: the {int(new.sum())} new ones alone, which the whole holds too"
    )


def last_of(home: Path) -> Path:
    """The folder of the stage whose Gaussians are the result."""
    used = load_receipts({"evaluate": home / "evaluate"})["evaluate"]["needs"]
    return stage_folder(home, next(stage for stage in ("distill", "initialize") if used.get(stage)))


def main() -> None:
    parser = command.parser("patch", __doc__)
    parser.add_argument("--only-check", action="store_true", help="does the scene say what was deleted?")
    arguments = parser.parse_args()
    try:
        if arguments.only_check:
            check(command.home(arguments))
        else:
            print(make(command.home(arguments)))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()

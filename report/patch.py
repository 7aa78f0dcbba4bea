"""Export of a filled hole as splat files for an editor: `python -m report.patch --scene X` (`make scene=X patch`).

The scene must consist of two splat files, from before and after a user deleted something in an editor. Without a scene
folder, the command `reffusion patch before.ply after.ply --out patched.ply` takes the two files and fills the hole.
"""

from __future__ import annotations

from pathlib import Path

from reffusion.io.ply import load_property_names, save_ply
from report import cli, patch_files
from report.patch_result import load_result, require_deleted
from report.sheet import stage_folder

WHOLE, NEW = "patched.ply", "new.ply"


def make(home: Path) -> str:
    """Write patched.ply (the whole scene) and new.ply (the new Gaussians) to `home`/patch/; return a text to print.

    Both files are where the user left the scene in the editor, with properties in the order of the user's .ply file.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>, with a finished stage `evaluate`.

    Raises:
        ValueError: the scene does not say what was deleted, or the stage `evaluate` has not run.
    """
    patch = load_result(home)
    similarity, properties = patch.similarity, load_property_names(stage_folder(home, "poses") / "gaussians.ply")
    result, new, out = patch.gaussians, patch.new, home / "patch"
    save_ply(out / WHOLE, result, similarity, properties)
    save_ply(out / NEW, result.map(lambda parameter: parameter[new]), similarity, properties)
    return (
        f"{out / WHOLE}: the whole scene, {len(result)} splats\n"
        f"{out / NEW}: the {int(new.sum())} new splats alone, which the whole scene contains too\n{patch.describe()}"
    )


@cli.command
def main() -> None:
    """Run `reffusion patch`: fill the hole of a scene or of two files of splats, and print what was written."""
    parser = cli.scene_parser("patch", __doc__, needs_scene=False)
    parser.add_argument("--only-check", action="store_true", help="only check that the scene says what was deleted")
    files = "two files of splats, before and after the object was deleted; the scene may be moved, turned and scaled"
    parser.add_argument("files", type=Path, nargs="*", metavar="BEFORE AFTER", help=f"instead of --scene: {files}")
    parser.add_argument(
        "--out", type=Path, help="for two files: where to write the filled scene; the ending selects the format"
    )
    parser.add_argument("--cameras", type=Path, help="for two files: a folder with cameras, as `export` writes it")
    parser.add_argument("--profile", help="for two files, as for `run` (these three options)")
    parser.add_argument("--budget", help="as for `run`")
    parser.add_argument("--set", default="", help="as for `run`")
    arguments = parser.parse_args()
    if arguments.files:
        print(patch_files.make(arguments))
    elif arguments.scene is None:
        raise ValueError("name a scene (--scene), or two files: reffusion patch before.ply after.ply --out out.ply")
    elif arguments.only_check:
        require_deleted(cli.run_folder(arguments))
    else:
        print(make(cli.run_folder(arguments)))


if __name__ == "__main__":
    main()

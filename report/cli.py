"""What commands share: the arguments of those that make a page of one scene, and how a refusal is told."""

from __future__ import annotations

import argparse
import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from reffusion.command import root, scene_name, scene_path

Result = TypeVar("Result")


def command(main: Callable[[], Result]) -> Callable[[], Result]:
    """Return `main` as a command, which a ValueError ends with its message in one line; a decorator."""

    @functools.wraps(main)
    def run() -> Result:
        try:
            return main()
        except ValueError as error:
            raise SystemExit(f"error: {error}") from None

    return run


def scene_parser(name: str, description: str, needs_scene: bool = True) -> argparse.ArgumentParser:
    """Return an argument parser with the options --scene, --variant and --runs.

    Args:
        name: name of the command, as in `reffusion NAME`.
        description: docstring of the command's module; the help shows the first line.
        needs_scene: True if the command refuses to run without --scene.
    """
    parser = argparse.ArgumentParser(prog=f"reffusion {name}", description=description.split("\n")[0])
    parser.add_argument("--scene", type=Path, required=needs_scene, help="name of the scene, or path of its folder")
    parser.add_argument("--variant", default="", help="variant of the scene")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    return parser


def typed_command(name: str, scene: Path | None) -> str:
    """Return the command that the user typed, by `make` or `reffusion`, without options other than the scene.

    Args:
        name: name of the command, as in `reffusion NAME`.
        scene: the scene as typed; None if none was named.
    """
    if "MAKELEVEL" in os.environ:
        return f"make scene={scene} {name}" if scene else f"make {name}"
    return f"reffusion {name} --scene {scene}" if scene else f"reffusion {name}"


def name_scene(scene: Path) -> str:
    """Return the name of a scene that is given by its name under data/, or by the path of its folder or video."""
    return scene_name(scene_path(str(scene), root()) or scene.expanduser().resolve())


def run_folder(arguments: argparse.Namespace) -> Path:
    """Return the folder of a scene's stages: runs/<scene>, or runs/<scene>@<variant> if a variant is named.

    Args:
        arguments: the result of a parser of `scene_parser`. The scene may be a name under data/, the path of a folder,
            or the name or path of a video, whose name without its ending is then the scene's name.
    """
    name = name_scene(arguments.scene)
    return arguments.runs / (f"{name}@{arguments.variant}" if arguments.variant else name)

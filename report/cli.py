"""What is typed at the makers of one scene's pages."""

from __future__ import annotations

import argparse
from pathlib import Path


def scene_parser(name: str, description: str, needs_scene: bool = True) -> argparse.ArgumentParser:
    found = argparse.ArgumentParser(prog=f"reffusion {name}", description=description.split("\n")[0])
    found.add_argument("--scene", type=Path, required=needs_scene, help="its name, or the path of its folder")
    found.add_argument("--variant", default="", help="of the scene")
    found.add_argument("--runs", type=Path, default=Path("runs"))
    return found


def run_folder(arguments: argparse.Namespace) -> Path:
    """runs/<scene>, or runs/<scene>@<variant>."""
    scene = arguments.scene.expanduser().resolve()
    name = scene.stem if scene.is_file() else scene.name
    return arguments.runs / (f"{name}@{arguments.variant}" if arguments.variant else name)

"""Command-line arguments shared by the commands that make a page of one scene."""

from __future__ import annotations

import argparse
from pathlib import Path


def scene_parser(name: str, description: str, needs_scene: bool = True) -> argparse.ArgumentParser:
    """Parser with --scene, --variant and --runs; the help shows the first line of `description`."""
    parser = argparse.ArgumentParser(prog=f"reffusion {name}", description=description.split("\n")[0])
    parser.add_argument("--scene", type=Path, required=needs_scene, help="name of the scene, or path of its folder")
    parser.add_argument("--variant", default="", help="variant of the scene")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    return parser


def run_folder(arguments: argparse.Namespace) -> Path:
    """runs/<scene>, or runs/<scene>@<variant>."""
    scene = arguments.scene.expanduser().resolve()
    name = scene.stem if scene.is_file() else scene.name
    return arguments.runs / (f"{name}@{arguments.variant}" if arguments.variant else name)

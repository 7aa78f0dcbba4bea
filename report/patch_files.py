"""Filling a hole that two splat files show: `reffusion patch before.ply after.ply --out patched.ply`.

before.ply is a scene of splats, after.ply the same scene after something was deleted in an editor. No scene folder is
needed: the command makes one in runs/patches/<name>/, with links to the two files and to the cameras, if given. A user
may paint a reference and save it in this folder's `painted/`. The same command then continues with the painted
reference and the cached stages in runs/<name>/.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

from reffusion.io.arrays import save_text
from reffusion.io.files import BadInput
from reffusion.io.ply import check_can_save, load_property_names, save_splats
from reffusion.io.splats import summarize_splats
from report.patch_result import load_result

BEFORE, AFTER, PATCHES = "before", "after", "patches"
RESERVED_NAMES = (BEFORE, AFTER, "painted", "scene.yaml")  # a camera file of such a name is not linked into the folder


def check_arguments(arguments: argparse.Namespace) -> None:
    """Check the command's arguments and the headers of its files before any work.

    Raises:
        BadInput: there are not exactly two files, a file is not usable, an option is missing or does not fit, or the
            format of `--out` cannot be written.
    """
    if len(arguments.files) != 2:
        raise BadInput(f"{arguments.files[0]}: name two files, the scene before and after the object was deleted")
    if arguments.scene or arguments.variant:
        raise BadInput("--scene, --variant: a scene's folder names its files in scene.yaml; give it, or two files")
    if arguments.out is None:
        raise BadInput("--out: name the file to write, as --out patched.ply")
    for file in arguments.files:
        summarize_splats(file)
    check_can_save(arguments.out)
    if arguments.cameras is not None and not arguments.cameras.is_dir():
        raise BadInput(f"{arguments.cameras}: no such folder; --cameras names one with transforms.json or sparse/0")


def write_scene_folder(arguments: argparse.Namespace) -> Path:
    """Write scene.yaml and the links into the scene folder, and return this folder.

    Links of an earlier call are replaced. References that the user painted stay.
    """
    files = [file.expanduser().resolve() for file in arguments.files]
    folder, names = find_folder(arguments.runs, *files), {}
    for key, file in zip((BEFORE, AFTER), files, strict=True):
        names[key] = f"{key}/{file.name}"
        _link(folder / names[key], file)
    for path in folder.iterdir():
        if path.is_symlink():
            path.unlink()
    for path in sorted(arguments.cameras.expanduser().resolve().iterdir()) if arguments.cameras else ():
        if path.name not in RESERVED_NAMES and not path.name.startswith("."):
            _link(folder / path.name, path)
    text = f"gaussians: {json.dumps(names[BEFORE])}\ncleaned: {json.dumps(names[AFTER])}\nmasks: none\n"
    scene = folder / "scene.yaml"
    if not scene.is_file() or scene.read_text(encoding="utf-8") != text:
        save_text(scene, text)
    return folder


def find_folder(runs: Path, before: Path, after: Path) -> Path:
    """Return the path of the scene folder for two files, which depends on the files' paths but not on their content."""
    files = [file.expanduser().resolve() for file in (before, after)]
    identity = hashlib.blake2b("\n".join(map(str, files)).encode(), digest_size=3).hexdigest()
    stem = re.sub(r"[^\w.,+'() -]", "_", files[0].name.split(".")[0]) or "scene"
    return runs.resolve() / PATCHES / f"{stem}-patch-{identity}"


def _link(place: Path, file: Path) -> None:
    """Make `place` a symbolic link to a file; a link or file at this place is replaced."""
    place.parent.mkdir(parents=True, exist_ok=True)
    if place.is_symlink() or place.exists():
        place.unlink()
    place.symlink_to(file)


def make(arguments: argparse.Namespace) -> str:
    """Fill the hole, write the filled scene to `arguments.out`, and return a text to print.

    Raises:
        ValueError: the arguments or the files cannot be used.
        SystemExit: a stage was refused, failed or was interrupted.
    """
    check_arguments(arguments)
    folder = write_scene_folder(arguments)
    run_stages(folder, arguments)
    home = arguments.runs / folder.name
    result = load_result(home)
    save_splats(arguments.out, result.gaussians, result.similarity, load_property_names(arguments.files[0]))
    lost = result.gaussians.antialiased and arguments.out.suffix.lower() == ".splat"
    note = "; .splat cannot say that it is antialiased, as the scene before is: set that in the viewer" if lost else ""
    return (
        f"{arguments.out}: the whole scene, {len(result.gaussians)} splats{note}\n{result.describe()}\n"
        f"for another filling, paint one of {home / 'to_paint'}, save it as {folder / 'painted'}/<view>.png, and "
        "repeat the command"
    )


def run_stages(folder: Path, arguments: argparse.Namespace) -> None:
    """Run all stages of the scene folder in a subprocess.

    Raises:
        SystemExit: the runner failed, with the runner's exit status. The runner has printed the reason.
    """
    options = {"--profile": arguments.profile, "--budget": arguments.budget, "--set": arguments.set}
    flags = [word for name, value in options.items() if value for word in (name, value)]
    words = ["run", "all", "--scene", str(folder), "--runs", str(arguments.runs.resolve()), *flags]
    process = subprocess.Popen([sys.executable, "-m", "reffusion.command", *words])
    try:
        status = process.wait()
    except KeyboardInterrupt:  # the runner receives the same signal and prints how to continue
        status = process.wait()
    if status:
        raise SystemExit(status)

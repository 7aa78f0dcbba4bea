"""Conversion of splats by splat-transform, a program of npm: from .sog, .ksplat and .lcc, to .sog and .html.

SOG is PlayCanvas's format for the web. The .html is one file with a viewer and the scene, which needs no network.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import zipfile
from pathlib import Path

from reffusion.io.files import BadInput, reading

PACKAGE = "@playcanvas/splat-transform@2.7.1"  # the last version for Node 18
READ = (".sog", ".ksplat", ".lcc", ".lcc2")  # endings of the files that it converts to .ply
META = "meta.json"  # of a folder with the files of a .sog
# One iteration of the clustering of spherical harmonics: on the demo 51.7 dB to the .ply, ten iterations 53.3 dB.
WEB_OPTIONS = ("--iterations", "1")
FINEST = ("--lod-select", "0")  # the finest of the levels of detail of a .lcc, which otherwise all are read
ON_CPU = ("--gpu", "cpu")


def is_convertible(path: Path) -> bool:
    """Return whether splat-transform is to convert this file to .ply."""
    return path.suffix.lower() in READ or path.name.lower() == META


def check_node(path: Path) -> str:
    """Return the path of npm; raises BadInput, which names `path`, if Node is not installed."""
    if npm := shutil.which("npm"):
        return npm
    raise BadInput(f"{path}: {PACKAGE} converts it, which needs Node; install Node 18 or later with npm")


def save_for_web(path: Path, source: Path, antialiased: bool) -> None:
    """Convert a .ply of 3DGS to a .sog file in the same frame, or to an .html file that shows it.

    At the first use npm downloads the package, 210 MB with what it needs. Spherical harmonics are clustered on a GPU if
    WebGPU finds one, else on one CPU core.

    Args:
        path: the .sog or .html file to write.
        source: the .ply file.
        antialiased: True if its splats are to be rendered with Mip-Splatting's 2D filter; only a .sog says so.

    Raises:
        BadInput: Node is not installed, npm cannot fetch the package, or the conversion failed. The message has one
            line.
    """
    npm = check_node(path)
    try:
        _convert(npm, source, path, WEB_OPTIONS)
    except BadInput:
        _convert(npm, source, path, (*WEB_OPTIONS, *ON_CPU))
    if antialiased and path.suffix == ".sog":
        _mark_antialiased(path)


def convert_to_ply(path: Path, folder: Path) -> Path:
    """Write a file that `is_convertible` as converted.ply in `folder`; return its path. Raises as `save_for_web`."""
    with reading(path, f"a {path.suffix} file"):
        target = folder / "converted.ply"
        _convert(check_node(path), path, target, FINEST if path.suffix.lower().startswith(".lcc") else ())
        return target


def is_antialiased(path: Path) -> bool:
    """Return whether a .sog or its meta.json asks for Mip-Splatting's 2D filter; False for any other file.

    Raises BadInput if the file is unreadable.
    """
    if path.suffix.lower() == ".sog":
        with reading(path, "a .sog file"), zipfile.ZipFile(path) as archive:
            return json.loads(archive.read(META)).get("model") == "antialiased"
    if path.name.lower() == META:
        with reading(path, "a meta.json of SOG"):
            return json.loads(path.read_bytes()).get("model") == "antialiased"
    return False


def _convert(npm: str, source: Path, target: Path, options: tuple[str, ...]) -> None:
    """Run splat-transform on a file; raises BadInput, and leaves no target, if it fails."""
    command = [npm, "exec", "--yes", "--fetch-retries=0", f"--package={PACKAGE}", "--", "splat-transform"]
    command += ["--overwrite", "--quiet", *options, str(source.resolve()), str(target.resolve())]
    result = subprocess.run(command, cwd=target.parent, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if not result.returncode and target.is_file():
        return
    target.unlink(missing_ok=True)
    lines = [line.strip() for line in result.stderr.splitlines() if "error" in line.lower()] or ["no reason is given"]
    hint = "; try again with a network" if result.stderr.startswith("npm ") else ""
    raise BadInput(f"{source}: {PACKAGE} cannot convert it to {target.suffix}: {lines[0]:.200}{hint}")


def _mark_antialiased(path: Path) -> None:
    """Add the entry `model` to the meta.json of a .sog, which is a zip file. `PACKAGE` does not write this entry."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    files[META] = json.dumps(json.loads(files[META]) | {"model": "antialiased"}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)

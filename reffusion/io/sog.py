"""Writing of SOG, PlayCanvas's format for the web, by splat-transform, a package of the npm registry."""

from __future__ import annotations

import json
import shutil
import subprocess
import zipfile
from pathlib import Path

from reffusion.io.files import BadInput
from reffusion.io.splats import summarize_splats

PACKAGE = "@playcanvas/splat-transform@2.7.1"  # the last version for Node 18
# One iteration of the clustering of spherical harmonics: on the demo 51.7 dB to the .ply, ten iterations 53.3 dB.
OPTIONS = ("--overwrite", "--quiet", "--iterations", "1")


def save_sog(path: Path, source: Path) -> None:
    """Convert a .ply of 3DGS to a .sog file, in the same frame. The file also says whether splats are antialiased.

    At the first use npm downloads the package, 210 MB with what it needs. Spherical harmonics are clustered on a GPU if
    WebGPU finds one, else on one CPU core.

    Args:
        path: the .sog file to write.
        source: the .ply file.

    Raises:
        BadInput: Node is not installed, npm cannot fetch the package, or the conversion failed. The message has one
            line.
    """
    if not (npm := shutil.which("npm")):
        raise BadInput(f"{path}: {PACKAGE} writes it, which needs Node; install Node 18 or later with npm")
    command = [npm, "exec", "--yes", "--fetch-retries=0", f"--package={PACKAGE}", "--", "splat-transform", *OPTIONS]
    for device in ((), ("--gpu", "cpu")):
        files = [str(source.resolve()), str(path.resolve())]
        result = subprocess.run(
            [*command, *device, *files], cwd=path.parent, stdin=subprocess.DEVNULL, capture_output=True, text=True
        )
        if not result.returncode:
            if summarize_splats(source).antialiased:
                _mark_antialiased(path)
            return
        path.unlink(missing_ok=True)
        if result.stderr.startswith("npm "):
            break  # the package is not here
    lines = [line.strip() for line in result.stderr.splitlines() if "error" in line.lower()] or ["no reason is given"]
    raise BadInput(f"{path}: {PACKAGE} failed: {lines[0]:.200}; try again with a network")


def _mark_antialiased(path: Path) -> None:
    """Add the entry `model` to the meta.json of a .sog, which is a zip file. `PACKAGE` does not write this entry."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    files["meta.json"] = json.dumps(json.loads(files["meta.json"]) | {"model": "antialiased"}).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)

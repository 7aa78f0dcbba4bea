"""Commands of this project that the page runs besides jobs: the viewer, and the export of the result."""

from __future__ import annotations

import select
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reffusion.io.arrays import load_json
from report.access import Access
from report.app.job_progress import BAR
from report.app.jobs import make_command, make_environment
from report.app.scenes import OpenScene


@dataclass(frozen=True)
class Work:
    """A part of the export.

    Attributes:
        command: a command of `reffusion` and its options.
        files: file in runs/<scene>/ that it makes -> what the file is.
    """

    command: tuple[str, ...]
    files: dict[str, str]


# what is made -> the work, in order: the slowest last
EXPORTS = {
    "files for other programs": Work(
        ("export",),
        {
            "export/scene.compressed.ply": "the same, compressed (PlayCanvas, SuperSplat)",
            "export/scene.spz": "the same as .spz (Niantic)",
            "export/scene.glb": "the same as .glb (glTF)",
            "export/scene.sog": "the same as .sog, small, for the web (PlayCanvas)",
            "export/scene.html": "a page that shows it in a browser, in one file",
            "export/with_object.ply": "the scene with the object, for an editor: reffusion patch fills what you delete "
            "there",
            "export/cameras.zip": "cameras (COLMAP model, transforms.json) and undistorted photographs",
        },
    ),
    "the video of before and after": Work(
        ("turntable", "--before-after"),
        {
            "before_after.webm": "video of before and after: a line moves across",
            "before_after.webp": "the same as a small animated picture, for messages and web pages",
        },
    ),
    "the report": Work(("report",), {"report.html": "report on the job, one page"}),
    "the video around the scene": Work(("turntable",), {"turntable.webm": "video around the scene"}),
}
# file in runs/<scene>/ -> what it is
FILES = {"evaluate/scene.ply": "the scene as Gaussians (.ply), for any 3DGS viewer"}
FILES |= {file: words for work in EXPORTS.values() for file, words in work.files.items()}
VIEWER_PORT, START_SECONDS = 8080, 180
READY = "ready"  # the line that the process of the viewer prints when it listens


class Viewer:
    """The 3D viewer (report/app/viewer_process.py) as a process of its own, for one scene at a time.

    Args:
        runs: folder of all results.

    Attributes:
        port: port of the viewer.
    """

    def __init__(self, runs: Path):
        self.runs, self.port = runs, free_port(VIEWER_PORT)
        self.process: subprocess.Popen | None = None
        self.scene, self.follows = "", False
        self.lock = threading.Lock()

    def show(self, scene: OpenScene, follow: bool, access: Access) -> None:
        """Start the viewer of a scene, unless it runs already, and wait until it listens. Another viewer is stopped.

        Args:
            access: the token of the page, which the viewer asks for, too.
            follow: True shows the latest state of an unfinished job, and reloads when there is a newer one.

        Raises:
            ValueError: the viewer cannot start; the message has the remedy.
        """
        with self.lock:
            alive = self.process is not None and self.process.poll() is None
            if not (alive and (self.scene, self.follows) == (scene.name, follow)):
                self._stop()
                words = (
                    "-m",
                    "report.app.viewer_process",
                    str(scene.home),
                    str(self.port),
                    "latest" if follow else "finished",
                )
                self.process = subprocess.Popen(
                    [sys.executable, *words],
                    env=make_environment(),
                    stdin=subprocess.PIPE,  # closes with this server, and ends the viewer
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                )
                self.process.stdin.write(f"{access.port} {access.token}\n")
                self.process.stdin.flush()
                self.scene, self.follows = scene.name, follow
                self._await_start(self.process)

    def _await_start(self, process: subprocess.Popen) -> None:
        """Wait until the viewer listens. Importing and loading take seconds, on a busy machine minutes."""
        if not select.select([process.stdout], [], [], START_SECONDS)[0]:
            self._stop()
            raise ValueError("the viewer does not answer")
        if process.stdout.readline() != f"{READY}\n":
            lines = process.stderr.read().strip().splitlines()
            raise ValueError(lines[-1].removeprefix("error: ") if lines else "the viewer ended")

    def stop(self) -> None:
        """End the viewer, if it runs."""
        with self.lock:
            self._stop()

    def _stop(self) -> None:
        """End the viewer, if it runs; the caller holds the lock."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait()


class Export:
    """The export of one scene: the commands of `EXPORTS`, one after the other.

    Args:
        runs: folder of all results.

    Attributes:
        work: what is being made now, and which of how many works it is; "" if nothing is.
        share: share of this work that is done; None if it is unknown.
        unfinished: the files of `FILES` that this work and those after it will write.
        error: why a work failed, or "".
    """

    def __init__(self, runs: Path):
        self.runs, self.work, self.error = runs, "", ""
        self.share: float | None = None
        self.unfinished: frozenset[str] = frozenset()

    def start(self, scene: OpenScene, sog: bool) -> None:
        """Start the export in the background, unless it runs already.

        Args:
            sog: True also makes a .sog and an .html file, which takes Node and minutes.
        """
        if not self.work:
            self.work, self.error = "begins", ""
            self.unfinished = frozenset(file for work in EXPORTS.values() for file in work.files)
            threading.Thread(target=self._run, args=(scene, sog), daemon=True).start()

    def describe(self) -> dict[str, Any]:
        """Return "work", "share", "error" (see the class) and "has_npm": whether .sog and .html can be made here."""
        has_npm = shutil.which("npm") is not None
        return {"work": self.work, "share": self.share, "error": self.error, "has_npm": has_npm}

    def _run(self, scene: OpenScene, sog: bool) -> None:
        """Do all works of `EXPORTS`; `work`, `share`, `unfinished` and `error` tell the progress."""
        cameras = scene.home / "export" / "cameras"
        try:
            for k, (words, work) in enumerate(EXPORTS.items(), start=1):
                self.work, self.share = f"{k} of {len(EXPORTS)}: {words}", None
                command, *options = work.command
                more = ["--sog"] if sog and command == "export" else []
                self._do(make_command(command, "--scene", str(scene.source), "--runs", str(self.runs), *options, *more))
                if command == "export" and cameras.is_dir():
                    shutil.make_archive(str(cameras), "zip", cameras)
                self.unfinished -= work.files.keys()
        finally:
            self.work, self.unfinished = "", frozenset()

    def _do(self, command: list[str]) -> None:
        """Run a command, and keep its progress in `share` and, if it fails, its last line in `error`."""
        with subprocess.Popen(
            command, env=make_environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        ) as process:
            last = ""
            for line in process.stderr:  # a carriage return ends a line, too
                last = line.strip() or last
                if bar := BAR.search(line):
                    self.share = int(bar[2]) / int(bar[3])
        if process.returncode:
            self.error = last.removeprefix("error: ") or f"`{' '.join(command[3:])}` failed"


def list_exports(scene: OpenScene, unfinished: Collection[str] = ()) -> dict[str, dict[str, object]]:
    """Return the files to download, as name without folder -> {"words", "bytes"}, without files older than the result.

    Args:
        unfinished: files of `FILES` that are being written, which are left out, too.
    """
    found: dict[str, dict[str, object]] = {}
    for name, words in FILES.items():
        path = scene.home / name
        if name not in unfinished and path.is_file() and path.stat().st_mtime >= _result_time(scene):
            found[path.name] = {"words": words, "bytes": path.stat().st_size}
    return found


def find_export(scene: OpenScene, name: str) -> Path:
    """Return the path of a file of `list_exports`. Raises LookupError if there is no such file."""
    if name not in list_exports(scene):
        raise LookupError(f"{name}: not exported yet")
    return next(scene.home / path for path in FILES if Path(path).name == name)


def _result_time(scene: OpenScene) -> float:
    """Return the time of change of the finished scene; that of its other files may be earlier only by mistake."""
    result = scene.home / "evaluate" / "scene.ply"
    return result.stat().st_mtime if result.is_file() else float("inf")


def has_result(scene: OpenScene) -> bool:
    """Return whether the stage `evaluate` has finished."""
    receipt = scene.home / "evaluate" / "receipt.json"
    return receipt.is_file() and bool(load_json(receipt))


def free_port(first: int) -> int:
    """Return the first port of `first` and the 99 after it on which nothing listens; raises ValueError if none."""
    for port in range(first, first + 100):
        try:
            with socket.socket() as each:
                each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port that was just left is free
                each.bind(("127.0.0.1", port))
            return port
        except OSError:
            continue
    raise ValueError(f"no free port from {first} to {first + 99}; choose another with port=")

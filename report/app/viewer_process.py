"""The 3D viewer of the page, as a process: `python -m report.app.viewer_process HOME PORT latest|finished`.

`finished` shows the finished scene, as `reffusion view` does. `latest` shows the latest state of a job, also of one
that runs, and reloads when there is a newer state. The first line of its standard input has the port and the token of
the page, because other users of the machine can read arguments. It prints `READY` when it listens. The process ends
when its standard input closes.
"""

from __future__ import annotations

import pickle
import sys
import threading
import time
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.types import Camera, Gaussians
from reffusion.workspace import Workspace
from report import camera_path, cli, view
from report.access import Access
from report.app.pictures import OWN_FRAME
from report.app.tasks import READY
from report.viewer_server import start_viewer_server

PERIOD = 4.0  # seconds between two looks for a newer state
LABELS = "labels.npy"  # of the stage `masks`: which Gaussians of the fit are removed
# Files with Gaussians -> their title. `.partial-*` are the folders of stages that run.
STATES = {
    "fit/gaussians.ply": "the scene with the object",
    ".partial-fit-*/checkpoint.pt": "being fitted",
    f"masks/{LABELS}": "without the object, not filled yet",
    ".partial-initialize-*/.refit/checkpoint.pt": "filled, being refitted",
    "initialize/gaussians.ply": "filled, before distillation",
    ".partial-distill-*/checkpoint.pt": "being distilled",
    "distill/gaussians.ply": "distilled",
    "finish/scene.ply": "finished",
}


def find_latest(home: Path) -> tuple[Path, str, int] | None:
    """Return the latest state of a job as (file, title, time of change in ns); None if there is none yet."""
    found = [(path, title, path.stat().st_mtime_ns) for name, title in STATES.items() for path in home.glob(name)]
    return max(found, key=lambda state: state[2], default=None)


class LatestViewer:
    """Viewer of the latest state of a job, on the loopback interface.

    Args:
        home: runs/<scene>, in which the stage `poses` is done.
        port: port to listen on.
        access: the token that requests must bring.

    Raises:
        ValueError: viser is not installed, or the stage `poses` has not run.
    """

    def __init__(self, home: Path, port: int, access: Access):
        self.home, self.scene = home, load_scene(home / "poses")
        self.gaussians: Gaussians | None = None
        self.latest: tuple[Path, str, int] | None = None
        self.server = start_viewer_server(home.name, port, access)
        self.title = self.server.gui.add_markdown("The latest state is being loaded.")
        train = [self.scene.cameras[name] for name in self.scene.train]
        self.server.scene.set_up_direction(-np.mean([camera.world_to_camera[1, :3] for camera in train], 0))
        target = camera_path.focus_point(train, self.scene.points)
        view.move_to_view(self.server.initial_camera, camera_path.find_central_view(train, self.scene.points), target)
        self.visitors = view.Visitors(self.server, self._render)
        threading.Thread(target=self._follow, daemon=True).start()

    def _render(self, camera: Camera, place: Any) -> np.ndarray:
        """Render the latest state, uint8 [H, W, 3]; gray before a state is loaded."""
        if self.gaussians is None:
            return np.full((camera.height, camera.width, 3), 230, np.uint8)
        return view.render_picture(self.gaussians, camera)

    def _follow(self) -> None:
        """Load the latest state whenever it is a new one."""
        while True:
            # A running stage replaces and moves its files: what is not found or not whole is read at the next look.
            with suppress(OSError, ValueError, KeyError, RuntimeError, EOFError, pickle.UnpicklingError):
                found = find_latest(self.home)
                if found and found != self.latest:
                    self.gaussians, self.latest = self._load(found[0]), found
                    self.title.content = f"{found[1]}: {len(self.gaussians):,} Gaussians"
                    self.visitors.refresh()
            time.sleep(PERIOD)

    def _load(self, path: Path) -> Gaussians:
        """Load the Gaussians of a file of `STATES`: a checkpoint, labels, or a .ply file."""
        if path.suffix == ".pt":
            state = torch.load(path, weights_only=True, map_location="cpu")
            return Gaussians(**state["optimizer"]["parameters"])
        if path.name == LABELS:
            return Workspace(self.home / "poses", self.home / "fit", self.home / "masks").remaining
        return load_ply(path, self.scene.similarity) if path.name == OWN_FRAME else load_ply(path)


@cli.command
def main() -> None:
    """Serve the 3D view until standard input closes."""
    home, port, kind = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    page, token = sys.stdin.readline().split()
    access = Access(int(page), token)
    with redirect_stdout(sys.stderr):  # viser prints its address
        viewer = LatestViewer(home, port, access) if kind == "latest" else view.Viewer(home, port, access)
    if viewer.server.get_port() != port:
        raise ValueError(f"port {port}, on which the 3D view is shown, is in use; start this page again")
    print(READY, flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main()

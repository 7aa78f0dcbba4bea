"""The scenes, jobs and processes behind the page."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from reffusion.clicks.local_segmenter import load_local_segmenter
from report.app import tasks
from report.app.jobs import Jobs
from report.app.mask_step import MaskStep
from report.app.scenes import OpenScene, find_scene
from report.app.state import describe
from report.app.uploads import Upload
from report.mask_session import Session, load_capture


class App:
    """The scenes, jobs and processes behind the page.

    Args:
        runs: folder of all results, absolute.
        options: further arguments of the runner.
        command: the command that the user typed, for the page to name when its program has stopped.
    """

    def __init__(self, runs: Path, options: tuple[str, ...] = (), command: str = "reffusion app"):
        self.command = command
        self.jobs, self.viewer = Jobs(runs, options), tasks.Viewer(runs)
        self.scenes: dict[str, OpenScene] = {}
        self.exports: dict[str, tasks.Export] = {}
        self.uploads: dict[str, Upload] = {}
        self.first = ""  # scene that the page shows at first

    def open(self, text: str) -> OpenScene:
        """Open the scene that a name or a path means, and compute its plan in the background.

        Raises:
            ValueError: there is none, or another scene of this name is open.
        """
        found = find_scene(text, self.jobs.runs)
        scene = self.scenes.setdefault(found.name, found)
        if scene.source != found.source:
            raise ValueError(f"another scene named {found.name} is open: {scene.source}; rename one folder")
        self.exports.setdefault(scene.name, tasks.Export(self.jobs.runs))
        self.jobs.renew_plan(scene)
        return scene

    def add(self, scene: OpenScene) -> None:
        """Add a scene that is ready to be shown."""
        self.scenes[scene.name], self.exports[scene.name] = scene, tasks.Export(self.jobs.runs)

    def scene(self, name: str) -> OpenScene:
        """Return an open scene. Raises LookupError if there is none of this name."""
        if name not in self.scenes:
            raise LookupError(f"the scene {name!r} is not open; go back to the start and choose it")
        return self.scenes[name]

    def mask_step(self, name: str) -> MaskStep:
        """Return the mask step of an open scene. Raises LookupError if it was not begun."""
        step = self.scene(name).mask_step
        if step is None:
            raise LookupError("the mask step is not open")
        return step

    def describe(self, scene: OpenScene) -> dict[str, Any]:
        """Return the state of a scene, see `state.describe`, with "command", which the user typed."""
        return describe(scene, self.jobs, self.exports[scene.name]) | {"command": self.command}

    def begin_masks(self, scene: OpenScene) -> bool:
        """Run the stages up to `fit` in the background, and open the mask step once `raw_masks` is done.

        A job that was stopped before the fit was done goes on.

        Returns:
            True if the mask step is open.

        Raises:
            ValueError: clicks do not suit the scene's masks.
        """
        step, state = scene.mask_step, self.jobs.state(scene)
        if step is not None and step.session.gaussians is not None:
            return True
        if state["state"] not in ("running", "elsewhere") and not self.jobs.is_finished(scene, "fit"):
            self.jobs.start(scene, "fit", with_clicks=True)
        if step is not None:
            return True
        poses, fit = (scene.home / stage / "receipt.json" for stage in ("poses", "fit"))
        if not (scene.home / "raw_masks" / "receipt.json").is_file():
            return False

        def is_fitted() -> bool:
            done = self.jobs.is_finished(scene, "fit")
            return fit.is_file() and (done or fit.stat().st_mtime > poses.stat().st_mtime)

        def is_fitting() -> bool:
            return self.jobs.state(scene)["state"] in ("running", "elsewhere")

        def progress() -> dict[str, object] | None:
            state = self.jobs.state(scene)
            share, left = state["share"], state["left"]
            known = state["stage"] == "fit" and share is not None and left is not None
            return {"share": share, "left": time.strftime("%M:%S", time.gmtime(left))} if known else None

        session = Session(load_capture(scene.home), is_fitted, load_local_segmenter())
        scene.mask_step = MaskStep(
            session, is_fitting, progress, scene.name, on_save=lambda: self.jobs.renew_plan(scene)
        )
        return True

    def close(self) -> None:
        """End the viewer, and interrupt the jobs that the page started. A killed server leaves the jobs running."""
        self.viewer.stop()
        for name in self.jobs.stop_all():
            print(f"the job of {name} is interrupted; the next start goes on from its last checkpoint", flush=True)

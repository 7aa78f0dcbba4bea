"""Runs the runner in processes of its own: plans scenes, starts and stops jobs, and reads the progress of any job.

A job that the page starts goes on when the page or its server ends, and a job that a terminal started is shown. The
files are runs/.app/<scene>.json (process and target), <scene>.log (what the runner prints) and <scene>.profile (the
quality that was chosen on the page).
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reffusion.command import root
from reffusion.io.arrays import load_json, save_json, save_text
from report.app.job_progress import BAR, ShownProgress, estimate_remaining, find_bar, find_running_stage
from report.app.scenes import OpenScene
from runner.files import MACHINE, lock_holder
from runner.plan import FINAL

RECORDS = ".app"  # folder in runs/
QUALITIES = ("laptop", "fine")  # profiles between which the page lets users choose
TAIL_BYTES, TAIL_LINES = 20_000, 40  # of a log: bytes that are read, lines that are shown
WITHOUT_MASKS = "poses.clicks={}"  # announces masks by clicks, so that stages accept a scene without masks


def make_command(*words: str) -> list[str]:
    """Return the command line of `reffusion` with these arguments."""
    return [sys.executable, "-m", "reffusion.command", *words]


def make_environment() -> dict[str, str]:
    """Return the environment of the processes that the page starts: they import this project, wherever they run."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(root()), os.environ.get("PYTHONPATH", "")]))}


def describe_missing_source(scene: OpenScene) -> str:
    """Return a sentence on a scene whose photographs were moved away."""
    return (
        f"The photographs are no longer at {scene.source}. Move them back to run stages again; finished results stay."
    )


@dataclass
class Plan:
    """The runner's plan for a scene, as last computed.

    Attributes:
        stages: stage -> entry of plan.json.
        lacks_masks: True if the scene needs masks before the whole job can run.
        error: why there is no plan, or what the planned job lacks; "" if neither is the case.
        is_lost: True if the scene's folder or video was not there.
        busy: True while the plan is being computed.
    """

    stages: dict[str, dict[str, Any]] = field(default_factory=dict)
    lacks_masks: bool = False
    error: str = ""
    is_lost: bool = False
    busy: bool = False


class Jobs:
    """Plans and jobs of all open scenes.

    Args:
        runs: folder of all results.
        options: further arguments of the runner, such as --profile.
    """

    def __init__(self, runs: Path, options: tuple[str, ...] = ()):
        self.runs, self.options = runs, options
        self.plans: dict[str, Plan] = {}
        self.started: dict[str, subprocess.Popen] = {}
        self.shown: dict[str, ShownProgress] = {}
        self.lock = threading.RLock()  # `start` holds it, and may come to `renew_plan`

    # ------------------------------------------------------------------------------------------------ plans

    def plan(self, scene: OpenScene) -> Plan:
        """Return the latest plan of a scene without waiting; the first plan is empty and `busy` at first.

        A plan is computed in the background if there is none, or if the scene was moved away or back since.
        """
        plan = self.plans.get(scene.name)
        if plan is None or plan.is_lost == scene.source.exists():
            self.renew_plan(scene)
        return self.plans[scene.name]

    def renew_plan(self, scene: OpenScene) -> None:
        """Compute the plan of a scene in the background, unless this is being done."""
        with self.lock:
            plan = self.plans.setdefault(scene.name, Plan())
            if plan.busy:
                return
            plan.busy = True
        threading.Thread(target=self._compute_plan, args=(scene, plan), daemon=True).start()

    def _compute_plan(self, scene: OpenScene, plan: Plan) -> None:
        """Fill in `plan` by the runner; if the plan lacks masks, the runner plans again as if there were clicks."""
        plan.is_lost = not scene.source.exists()
        if plan.is_lost:
            plan.lacks_masks, plan.error, plan.stages = (
                False,
                describe_missing_source(scene),
                self._read_last_plan(scene),
            )
            plan.busy = False
            return
        try:
            lacks_masks, error = False, self._record_plan(scene)
            stages = self._read_plan(scene)
            if not error and any(stages[stage]["word"] == "missing" for stage in ("poses", "raw_masks")):
                if not self._record_plan(scene, "--set", WITHOUT_MASKS):
                    again = self._read_plan(scene)
                    lacks_masks = again["poses"]["word"] != "missing"
                    stages = again if lacks_masks else stages
            wrong = [entry["reason"] for entry in stages.values() if entry["word"] == "missing"]
            plan.lacks_masks, plan.error, plan.stages = lacks_masks, error or next(iter(wrong), ""), stages
        finally:
            plan.busy = False

    def _record_plan(self, scene: OpenScene, *more: str) -> str:
        """Let the runner write plan.json; return its error, or ""."""
        words = ("plan", "--record", *self._words(scene), *more)
        done = subprocess.run(make_command(*words), env=make_environment(), capture_output=True, text=True)
        lines = done.stderr.strip().splitlines() or [f"the plan ended with code {done.returncode}"]
        return lines[-1].removeprefix("error: ") if done.returncode else ""

    def _read_plan(self, scene: OpenScene) -> dict[str, dict[str, Any]]:
        """Return the stages of plan.json, stage -> entry; empty without this file."""
        path = scene.home / "plan.json"
        return load_json(path)["stages"] if path.is_file() else {}

    def quality(self, scene: OpenScene) -> str:
        """Return the last plan's profile; "" without a plan, if it is none of `QUALITIES` or if --profile fixes it."""
        path = scene.home / "plan.json"
        profile = load_json(path).get("profile") if path.is_file() and "--profile" not in self.options else ""
        return profile if profile in QUALITIES else ""

    def choose_quality(self, scene: OpenScene, profile: str) -> None:
        """Save one of `QUALITIES` as a scene's profile for later jobs, and plan anew.

        Raises:
            ValueError: not such a profile, the scene's profile is fixed, or a job of the scene runs.
        """
        if profile not in QUALITIES or not self.quality(scene):
            raise ValueError(f"there is no quality {profile!r} to choose")
        state = self.state(scene)
        if state["state"] in ("running", "elsewhere"):
            raise ValueError(state["words"] or "a job runs; stop it first")
        save_text(self._profile_file(scene), profile)
        self.renew_plan(scene)

    def _read_last_plan(self, scene: OpenScene) -> dict[str, dict[str, Any]]:
        """Return the last plan, in which stages that were finished since then count as cached."""
        record = scene.home / "plan.json"
        stages = self._read_plan(scene)
        for stage, entry in stages.items():
            receipt = scene.home / stage / "receipt.json"
            if receipt.is_file() and receipt.stat().st_mtime >= record.stat().st_mtime:
                entry |= {"word": "cached", "reason": ""}
        return stages

    def _words(self, scene: OpenScene) -> tuple[str, ...]:
        """Return the options of the runner for a scene: its source, the runs, the chosen profile and others."""
        chosen = self._profile_file(scene)
        profile = ("--profile", chosen.read_text()) if chosen.is_file() and "--profile" not in self.options else ()
        return ("--scene", str(scene.source), "--runs", str(self.runs), *profile, *self.options)

    # ------------------------------------------------------------------------------------------------ jobs

    def start(self, scene: OpenScene, target: str, with_clicks: bool = False) -> None:
        """Start the runner in the background.

        Args:
            target: a stage, or "all".
            with_clicks: True if the scene has no masks yet, and gets them by clicks.

        Raises:
            ValueError: a job of the scene runs, started by the page or by somebody else.
        """
        with self.lock:
            state = self.state(scene)
            if state["state"] in ("running", "elsewhere"):
                raise ValueError(state["words"] or "a job runs; stop it first")
            more = ("--set", WITHOUT_MASKS) if with_clicks else ()
            log = self._log(scene)
            log.parent.mkdir(parents=True, exist_ok=True)
            with open(log, "w") as output:
                process = subprocess.Popen(
                    make_command("run", target, *self._words(scene), *more),
                    env=make_environment() | {"PYTHONUNBUFFERED": "1"},
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # it goes on when the server ends
                )
            self.started[scene.name] = process
            save_json(self._record(scene), {"process": process.pid, "target": target})
        threading.Thread(target=self._await, args=(scene, process), daemon=True).start()

    def _await(self, scene: OpenScene, process: subprocess.Popen) -> None:
        """Wait for the end of a job, and compute the plan anew."""
        process.wait()
        self.renew_plan(scene)

    def stop(self, scene: OpenScene) -> None:
        """Interrupt the job that the page started, without waiting for its end. The next start resumes the job.

        Raises:
            ValueError: there is no such job, or somebody else's runner holds the scene.
        """
        process, holder = self.started.get(scene.name), lock_holder(self.runs, scene.name)
        if process is not None and process.poll() is None:
            process.terminate()
        elif holder and holder == (str(self._read_record(scene).get("process")), MACHINE):
            os.kill(int(holder[0]), signal.SIGTERM)
        else:
            raise ValueError(self.state(scene)["words"] or "nothing runs")

    def stop_all(self) -> list[str]:
        """Interrupt all jobs that this server started and wait for their ends; return the names of their scenes."""
        running = {name: process for name, process in self.started.items() if process.poll() is None}
        for process in running.values():
            process.terminate()
        for process in running.values():
            process.wait()
        return list(running)

    def is_finished(self, scene: OpenScene, target: str) -> bool:
        """Return whether the last job that this server started for the scene succeeded with this target or "all"."""
        process, record = self.started.get(scene.name), self._read_record(scene)
        return process is not None and process.poll() == 0 and record.get("target") in (target, "all")

    def state(self, scene: OpenScene) -> dict[str, Any]:
        """Return what runs, as plain JSON values.

        Returns:
            "state": idle, running (started by the page), elsewhere (by somebody else), failed, stopped or finished;
            "words": one sentence on it; "target": what was asked for; "stage": the current stage, its "reason" and
            "share" done in [0, 1]; "left": expected seconds to the end of the job; "whole": share of the whole job that
            is done; "done": stages that this job has done; "log": last lines of the output.
        """
        record, holder = self._read_record(scene), lock_holder(self.runs, scene.name)
        process = self.started.get(scene.name)
        alive = process is not None and process.poll() is None
        mine = alive or (holder is not None and holder == (str(record.get("process")), MACHINE))
        lines = self._tail(scene) if record else []
        target = record.get("target", "all")
        found = {"state": "idle", "words": "", "target": target, "stage": "", "reason": "", "done": []}
        found |= {"share": None, "left": None, "whole": None}
        if mine or holder:
            found |= self._progress(scene, target, lines if mine else [])
            found["state"] = "running" if mine else "elsewhere"
            if not mine:
                who = f"process {holder[0]}" + (f" on {holder[1]}" if holder[1] != MACHINE else "")
                stage = f": stage {found['stage']}" if found["stage"] else ""
                share = f", {found['share']:.0%}" if found["share"] is not None else ""
                found["words"] = f"a terminal run ({who}) holds this scene{stage}{share}; stop it there, or wait"
        elif record:
            end = next((line for line in reversed(lines) if line.startswith(("error:", "stopped;"))), "")
            code = process.poll() if process is not None else None
            if end.startswith("error:"):
                found |= {"state": "failed", "words": end.removeprefix("error: ")}
            elif end or code:
                found |= {"state": "stopped", "words": "Stopped. Start goes on from the last checkpoint."}
            else:
                found |= {"state": "finished"}
        return found | {"log": lines[-TAIL_LINES:]}

    def _progress(self, scene: OpenScene, target: str, lines: list[str]) -> dict[str, Any]:
        """Return "stage", "reason", "share", "left", "whole" and "done" of a running job; see `state`."""
        lock, stages = self.runs / ".locks" / scene.name, self.plan(scene).stages
        began = lock.stat().st_mtime if lock.exists() else time.time()
        stage, since = find_running_stage(scene.home, began)
        expected = self.expected_seconds(scene)
        done = {s for s in stages if (r := scene.home / s / "receipt.json").is_file() and r.stat().st_mtime > began}
        ahead = [s for s in expected if s not in done and s != stage]
        if target != "all" and target in stages:  # a part of the job: up to its last stage
            ahead = [s for s in ahead if list(stages).index(s) <= list(stages).index(target)]
        share = left = None
        if stage:
            share, left = estimate_remaining(time.time() - since, expected.get(stage), find_bar(lines, stage))
        total = None if stage and left is None else (left or 0.0) + sum(expected[s] for s in ahead)
        reason = stages.get(stage, {}).get("reason", "")
        shown = self.shown.get(scene.name)
        if shown is None or shown.began != began:
            shown = self.shown[scene.name] = ShownProgress(began)
        numbers = shown.update(time.time(), stage, share, total)
        return {"stage": stage, "reason": reason, "done": sorted(done)} | numbers

    def expected_seconds(self, scene: OpenScene) -> dict[str, float]:
        """Return stage -> expected seconds, 0 where they are unknown, for the stages that may run by the plan."""
        due = {stage: entry for stage, entry in self.plan(scene).stages.items() if entry["word"] not in FINAL}
        return {stage: entry.get("seconds") or 0.0 for stage, entry in due.items()}

    # ------------------------------------------------------------------------------------------------ files

    def _record(self, scene: OpenScene) -> Path:
        """Return the file with the process and target of the last job that the page started."""
        return self.runs / RECORDS / f"{scene.name}.json"

    def _profile_file(self, scene: OpenScene) -> Path:
        """Return the file with the profile that was chosen on the page; it may not exist."""
        return self.runs / RECORDS / f"{scene.name}.profile"

    def _log(self, scene: OpenScene) -> Path:
        """Return the file to which jobs that the page starts print."""
        return self.runs / RECORDS / f"{scene.name}.log"

    def _read_record(self, scene: OpenScene) -> dict[str, Any]:
        """Return {"process", "target"} of the last job that the page started; {} if none is recorded."""
        try:
            return load_json(self._record(scene))
        except (OSError, ValueError):
            return {}

    def _tail(self, scene: OpenScene) -> list[str]:
        """Return the last lines that the job printed; of a progress bar, only its latest state."""
        log = self._log(scene)
        if not log.is_file():
            return []
        with open(log, "rb") as file:
            file.seek(max(0, log.stat().st_size - TAIL_BYTES))
            text = file.read().decode("utf-8", "replace")
        lines = [line.rsplit("\r", 1)[-1].rstrip() for line in text.replace("\r\n", "\n").split("\n")]
        kept: list[str] = []
        for line in filter(None, lines):
            bar, before = BAR.search(line), BAR.search(kept[-1]) if kept else None
            if bar and before and bar[1] == before[1]:
                kept.pop()
            kept.append(line)
        return kept

"""Starts processes that may import stages (worker.py), and asks them to describe stages."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from runner import Refused

PROJECT = Path(__file__).resolve().parent.parent  # holds runner/ and report/


def start_worker(root: Path, *arguments: str, **options: Any) -> subprocess.Popen[str]:
    """Start `python -m runner.worker <arguments>` with `root` first on its import path."""
    path = os.pathsep.join(filter(None, [str(root), str(PROJECT), os.environ.get("PYTHONPATH", "")]))
    command, environment = [sys.executable, "-m", "runner.worker", *arguments], {**os.environ, "PYTHONPATH": path}
    return subprocess.Popen(command, cwd=root, env=environment, stdin=subprocess.PIPE, text=True, **options)


def ask_stages(root: Path, questions: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The answer to each question (see `worker.describe`), all from one process."""
    if not questions:
        return []
    process = start_worker(root, "describe", stdout=subprocess.PIPE)
    answers, _ = process.communicate(json.dumps(questions))
    if process.returncode:
        raise Refused("the stages could not be asked for their parameters (see above)")
    return json.loads(answers)

"""Starting of worker processes, which may import stages (worker.py), and questions to them about stages."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from runner import Refused

PROJECT = Path(__file__).resolve().parent.parent  # the folder with runner/ and report/


def start_worker(root: Path, *arguments: str, **options: Any) -> subprocess.Popen[str]:
    """Start the process `python -m runner.worker <arguments>`, with a pipe for text as its standard input.

    Args:
        root: folder with pipeline.yaml and stages/; it is the working directory and comes first on the import path.
        arguments: the command of the worker, such as "run".
        options: further arguments of subprocess.Popen.
    """
    path = os.pathsep.join(filter(None, [str(root), str(PROJECT), os.environ.get("PYTHONPATH", "")]))
    command, environment = [sys.executable, "-m", "runner.worker", *arguments], {**os.environ, "PYTHONPATH": path}
    return subprocess.Popen(command, cwd=root, env=environment, stdin=subprocess.PIPE, text=True, **options)


def ask_stages(root: Path, questions: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Send questions about stages to one worker process, and return its answers in the same order.

    Args:
        root: folder with pipeline.yaml and stages/.
        questions: see `worker.describe`.

    Raises:
        Refused: the process failed.
    """
    if not questions:
        return []
    process = start_worker(root, "describe", stdout=subprocess.PIPE)
    answers, _ = process.communicate(json.dumps(questions))
    if process.returncode:
        raise Refused("the stages could not be asked for their parameters (see above)")
    return json.loads(answers)

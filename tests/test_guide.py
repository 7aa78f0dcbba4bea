"""Every command of docs/guide.md runs as written on a small scene; long commands run only with REFFUSION_SLOW=1."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import pytest

ROOT = Path(__file__).resolve().parent.parent
GUIDE = (ROOT / "docs/guide.md").read_text(encoding="utf-8")
COMMANDS = [line.split("#")[0].strip() for line in re.findall(r"^make .*", GUIDE, re.MULTILINE)]
QUICK = ("plan", "check", "mask")
LITTLE = "fit.iterations=20 personalize.steps=2 distill.iterations=2"

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(
        not Path(sys.prefix, ".ready").exists(), reason="the tests do not run in an environment that make has set up"
    ),
]


def make_command(command: str, mini_scene: Path) -> list[str]:
    words = [f"scene={mini_scene}" if word.startswith("scene=") else word for word in command.split()]
    return [*words, f"runs={mini_scene.parent / 'runs'}", "profile=laptop", f"set={LITTLE}", f"VENV={sys.prefix}"]


def run_make(command: str, mini_scene: Path) -> str:
    done = subprocess.run(make_command(command, mini_scene), cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_guide_names_these_commands():
    assert {command.split()[-1] for command in COMMANDS} == {*QUICK, "reference", "all", "report"}
    assert all(command.split()[1] == "scene=my-photos" for command in COMMANDS)


def test_short_commands_run(mini_scene):
    assert "fit" in run_make(*(c for c in COMMANDS if c.endswith("plan")), mini_scene)
    run_make(*(c for c in COMMANDS if c.endswith("check")), mini_scene)
    assert (mini_scene.parent / "runs/mini/check.png").is_file()


def test_the_mask_page(mini_scene):
    (command,) = (c for c in COMMANDS if c.endswith("mask"))
    group = {"start_new_session": True, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen([*make_command(command, mini_scene), "port=18390"], cwd=ROOT, **group) as serving:
        try:
            address = next(found[0] for line in serving.stdout if (found := re.findall(r"http://127\S+", line)))
            page = urljoin(address, f"/scenes/mini/mask/?{urlsplit(address).query}")
            assert address.endswith("#mini/object")
            assert "What should be removed?" in urllib.request.urlopen(page, timeout=20).read().decode()
        finally:
            os.killpg(serving.pid, signal.SIGTERM)  # not SIGINT, which a test runner may ignore and pass on


@pytest.mark.slow
def test_long_commands_run(mini_scene):
    for goal, made in (("reference", "to_paint"), ("all", "evaluate/scene.ply"), ("report", "report.html")):
        run_make(*(c for c in COMMANDS if c.endswith(goal)), mini_scene)
        assert goal == "reference" or (mini_scene.parent / "runs/mini" / made).exists()


def test_pictures_are_there_and_small():
    pictures = [ROOT / "docs" / name for name in re.findall(r"\]\((images/[^)]+)\)", GUIDE)]
    assert len(pictures) == 4 and sum(path.stat().st_size for path in pictures) < 300_000

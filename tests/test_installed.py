"""The wheel installs one package, whose commands work in any folder as they do in a checkout."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from scenes.capture import write_four_photos
from scenes.processes import run_module

from runner.keys import Hashes, code_fingerprints

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("reffusion", "stages", "runner", "report")
BUILD = "import sys, setuptools.build_meta as build; build.build_wheel(sys.argv[1])"


@pytest.fixture(scope="module")
def wheel_folder(tmp_path_factory) -> Path:
    """A folder with the unpacked contents of a wheel that is built from a copy of the project."""
    pytest.importorskip("setuptools", "77", reason="building a wheel needs setuptools 77 or later")
    copy, out = (
        tmp_path_factory.mktemp("copy"),
        tmp_path_factory.mktemp("out"),
    )  # a build leaves folders in its source folder
    for name in (*FOLDERS, "priors", "lab"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "pipeline.yaml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    for name in (
        "data/mine/photo.py",
        "tests/test_it.py",
        "runs/mine/note.json",
    ):  # files that the wheel must not contain
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).touch()
    subprocess.run([sys.executable, "-c", BUILD, str(out)], cwd=copy, check=True, capture_output=True)
    (wheel,) = out.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        assert len(set(archive.namelist())) == len(archive.namelist())
        archive.extractall(out)
    wheel.unlink()
    return out


def run_command(wheel_folder: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `reffusion <arguments>` from the unpacked wheel, in a folder outside the project."""
    return run_module("reffusion.command", *arguments, cwd=folder, env={"PYTHONPATH": str(wheel_folder)})


def test_all_is_in_one_package(wheel_folder):
    assert sorted(path.suffix or path.name for path in wheel_folder.iterdir()) == [".dist-info", "reffusion"]
    app = wheel_folder / "reffusion" / "app"
    assert {path.name for path in app.iterdir()} == {"pipeline.yaml", "priors", "lab", *FOLDERS[1:]}
    assert {path.name for path in (app / "lab").iterdir()} == {"__init__.py", "scenes"}
    ours = [path for name in FOLDERS for path in (ROOT / name).rglob("*") if path.suffix in (".py", ".yaml")]
    ours += [path for path in (ROOT / "priors" / "tiny").rglob("*") if path.suffix in (".json", ".safetensors")]
    for path in ours:
        inside = path.relative_to(ROOT)
        base = wheel_folder if inside.parts[0] == "reffusion" else app
        assert (base / inside).read_bytes() == path.read_bytes()
    entries = next(wheel_folder.glob("*.dist-info/entry_points.txt")).read_text()
    assert "reffusion = reffusion.command:main" in entries


def test_stages_depend_on_the_same_code(wheel_folder, tmp_path):
    """The same code has the same fingerprints in a wheel and a checkout.

    An installed version thus reuses the results of a checkout, and repeats only stages whose code differs.
    """
    app, hashes = wheel_folder / "reffusion" / "app", Hashes(tmp_path / "hashes.json")
    for stage in ("poses", "distill"):
        for folder in ("stages", "stages/plan"):
            code = code_fingerprints(ROOT, stage, hashes, folder)
            assert f"reffusion/params/{stage}.py" in code
            assert code_fingerprints(app, stage, hashes, folder) == code


def test_plan_in_any_folder(wheel_folder, tmp_path):
    """The folders data/ and runs/ are those of the current working directory."""
    write_four_photos(tmp_path / "data" / "row")
    done = run_command(wheel_folder, tmp_path, "plan", "--scene", "row", "--profile", "laptop")
    assert done.returncode == 0, done.stderr
    assert "run       poses" in done.stdout and "run       fit" in done.stdout and "4 masks" in done.stdout
    assert (tmp_path / "runs").is_dir() and not (wheel_folder / "reffusion" / "app" / "runs").exists()


def test_help_lists_every_command_and_version_says_which(wheel_folder, tmp_path):
    listed = run_command(wheel_folder, tmp_path, "--help")
    assert listed.returncode == 0 and run_command(wheel_folder, tmp_path).stdout == listed.stdout
    for name in ("plan", "run", "mask", "check", "patch", "export", "report", "view", "compare", "batch", "weights"):
        assert f"\n  {name} " in listed.stdout
    assert re.fullmatch(r"reffusion \d+\.\d+\S*\n", run_command(wheel_folder, tmp_path, "--version").stdout)
    wrong = run_command(wheel_folder, tmp_path, "masks")
    assert (
        wrong.returncode == 2 and wrong.stderr == "error: there is no command 'masks'; `reffusion --help` lists them\n"
    )


def test_the_message_on_an_unknown_scene_names_the_command_that_makes_one(wheel_folder, tmp_path):
    done = run_command(wheel_folder, tmp_path, "run", "--scene", "demo")
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "no folder data/demo" in done.stderr and "`reffusion demo` makes data/demo" in done.stderr
    listed = run_command(wheel_folder, tmp_path, "demo", "--help")
    assert listed.returncode == 0 and "--kind" in listed.stdout


def test_reports_are_commands_too(wheel_folder, tmp_path):
    done = run_command(wheel_folder, tmp_path, "report", "--scene", "nothing")
    assert done.returncode == 2 and "no stage has been done" in done.stderr and "Traceback" not in done.stderr

"""The plug-in for nerfbaselines on a synthetic scene.

The tests need an environment with the plug-in. $NERFBASELINES_PYTHON is its Python:

python3 -m venv nb && nb/bin/pip install ./plugins/nerfbaselines
NERFBASELINES_PYTHON=nb/bin/python pytest tests/test_nerfbaselines.py
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest
from scenes.browser import CHROMIUM

REPO = Path(__file__).resolve().parent.parent
PYTHON = os.environ.get("NERFBASELINES_PYTHON", "")
pytestmark = pytest.mark.skipif(not Path(PYTHON or "none").is_file(), reason="set NERFBASELINES_PYTHON: see above")
SMALL = "fit.iterations=200 personalize.steps=4 personalize.optimizer.batch=1 distill.iterations=4"


@pytest.fixture(scope="module")
def finished_demo(tmp_path_factory, generate) -> Path:
    """Return a folder with a scene in data/book, its finished run in runs/book, and the plug-in's output in out/."""
    root = tmp_path_factory.mktemp("finished")
    generate.generate(root / "data/book", 3, generate.KINDS["mini"])
    command = [sys.executable, "-m", "reffusion.command", "run", "all", "--scene", str(root / "data/book")]
    command += ["--runs", str(root / "runs"), "--profile", "laptop", "--set", SMALL]
    subprocess.run(command, cwd=REPO, check=True, stdout=subprocess.DEVNULL)
    run_in_nerfbaselines(
        root, "reffusion_nerfbaselines", str(root / "runs/book"), "--output", str(root / "out"), "--page"
    )
    return root


def run_in_nerfbaselines(root: Path, module: str, *words: str) -> str:
    home = {**os.environ, "REFFUSION_PYTHON": sys.executable, "HOME": str(root)}
    command = [PYTHON, "-m", module, *words]
    done = subprocess.run(command, cwd=root, env=home, stdout=subprocess.PIPE, text=True, check=True)
    return done.stdout


def load_scores(root: Path, out: str = "out") -> dict[str, float]:
    results = json.loads((root / out / "results/book.json").read_text())
    assert results["evaluation_protocol"] == "spinnerf-box" and results["nb_info"]["method"] == "reffusion"
    return results["metrics"]


def assert_equal_to_metrics(root: Path, theirs: dict[str, float]) -> None:
    ours = json.loads((root / "runs/book/evaluate/metrics.json").read_text())["mean"]
    for name in ("psnr", "ssim", "flip"):
        assert theirs[name] == pytest.approx(ours[f"{name}_box"], abs=1e-3), name


def test_its_evaluation_gives_our_own_figures(finished_demo):
    assert_equal_to_metrics(finished_demo, load_scores(finished_demo))
    assert len(list((finished_demo / "out/predictions/color").glob("*.png"))) == 3


def test_the_scene_itself_can_be_scored_on(finished_demo):
    """The run is scored on the capture itself, read as nerfbaselines reads it for other methods.

    The capture has the cameras as given and the run has adjusted ones, so the scores agree within 1 dB only.
    """
    words = ("runs/book", "--data", "data/book", "--output", "anew")
    paths = [word if word.startswith("--") else str(finished_demo / word) for word in words]
    run_in_nerfbaselines(finished_demo, "reffusion_nerfbaselines", *paths)
    assert load_scores(finished_demo, "anew")["psnr"] == pytest.approx(load_scores(finished_demo)["psnr"], abs=1)


def test_nerfbaselines_own_table(finished_demo):
    command = ("generate-dataset-results", "--results", str(finished_demo / "out/results"), "--dataset", "spinnerf")
    table = run_in_nerfbaselines(finished_demo, "nerfbaselines", *command, "--scenes", "book")
    assert "RefFusion" in table and f"{load_scores(finished_demo)['psnr']:.3f}" in table


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium is installed")
def test_its_page_opens(finished_demo):
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    serve = partial(SimpleHTTPRequestHandler, directory=str(finished_demo / "out/page"))
    with ThreadingHTTPServer(("127.0.0.1", 0), serve) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        home, wrong = f"http://127.0.0.1:{server.server_port}/", []
        with playwright.sync_playwright() as engine:
            page = engine.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"]).new_page()
            page.on("pageerror", lambda error: wrong.append(str(error)))
            # The page loads a font and icons from two other hosts; requests to other hosts get an empty answer.
            page.route(
                lambda url: not url.startswith(home), lambda route: route.fulfill(body="", content_type="text/css")
            )
            page.goto(f"{home}spinnerf.html")
            assert "RefFusion" in page.inner_text("body")
            page.screenshot(path=str(finished_demo / "page.png"))
            page.goto(f"{home}m-reffusion.html")
            assert (
                "SPIn-NeRF" in page.inner_text("body") and f"{load_scores(finished_demo)['psnr']:.2f}" in page.content()
            )
        server.shutdown()
    assert not wrong

"""`reffusion doctor`: does each 2D inpainter on this machine work? Each one fills the same hole.

The picture is made here, so that the content of the hole is known: a wall and a floor of planks, with a red box before
them. Each inpainter runs in a process of its own, so that its memory can be measured, and one that fails does not end
the others.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from reffusion.command import root, workplace
from reffusion.inpaint import classical, feedforward, moebius
from reffusion.inpaint.patchmatch.completion import complete
from reffusion.inpaint.source_image import flat_source
from reffusion.io.images import save_image
from reffusion.params.base import REFINED_FROM
from reffusion.params.inpainter import FEED_FORWARD, Inpainter
from reffusion.prior import inpaint
from reffusion.prior.model import load_prior
from reffusion.weights import local, painters
from reffusion.weights.published import MOEBIUS, PAINTERS, SD2, SDXL

SIZE = 384, 512  # px, height and width of the picture
EMBEDDED = "priors/tiny"
CLASSICAL = {"telea": "Telea (OpenCV)", "exemplar": "patches of the picture"}
NAMES = {
    **CLASSICAL,
    "embedded": "the embedded prior",
    **{kind: published.name for kind, published in PAINTERS.items()},
    "moebius": "Moebius",
    "sd2": "Stable Diffusion 2",
    "sdxl": "SDXL",
}
PRIORS = {"embedded": EMBEDDED, "sd2": SD2, "sdxl": SDXL}
FETCHED_BY = {  # inpainter -> command that fetches its weights
    **dict.fromkeys(PAINTERS, "make weights"),
    "moebius": "make weights painter=moebius",
    **dict.fromkeys(("sd2", "sdxl"), "make weights profile=paper"),
}
ABSENT = "is not on this machine"  # in the problem of a model that was not fetched
LEAST_CONTRAST = 1.0  # of 255: standard deviation of the colors in the hole, below which it is one color
LEAST_CHANGE = 4.0  # of 255: mean difference from the input in the hole, below which nothing was painted
# By how much the color step across the hole's border may exceed that of the true picture; colors are in [-1, 1].
MOST_SEAM = 0.1


class Case(NamedTuple):
    """The picture to complete: with the object and without it, uint8 [H, W, 3], and its hole, bool [H, W]."""

    image: np.ndarray
    truth: np.ndarray
    hole: np.ndarray


class Result(NamedTuple):
    """The picture of an inpainter, uint8 [H, W, 3], and what it took: seconds, loading included, and GB at the peak."""

    picture: np.ndarray
    seconds: float
    gigabytes: float
    gpu_gigabytes: float


def make_case() -> Case:
    """Return a wall above planks, and a red box on them, whose place with a margin of 4 px is the hole."""
    height, width = SIZE
    row, column = np.mgrid[:height, :width].astype(np.float32)
    light = 1.05 - 0.25 * column / width
    plank = ((column - width / 2) / (row - 120).clip(40) * 9 + 100).astype(int)
    floor = np.array([150, 110, 75]) + (plank % 5)[..., None] * np.array([12, 9, 6])
    picture = np.where((row < 200)[..., None], np.array([190, 195, 185]), floor) * light[..., None]
    truth = (picture + np.random.default_rng(0).normal(0, 3, picture.shape)).clip(0, 255).round().astype(np.uint8)
    image, hole = truth.copy(), np.zeros(SIZE, bool)
    image[144:256, 204:316] = 205, 40, 35
    hole[140:260, 200:320] = True
    return Case(image, truth, hole)


def find_problem(key: str) -> str | None:
    """Return why an inpainter cannot run on this machine; None if it can."""
    if key in CLASSICAL:
        return None
    if key in PRIORS:
        source = root() / EMBEDDED if key == "embedded" else PRIORS[key]
        problem = local.model_need(source, "float32").problem
    else:
        problem = painters.inpainter_needs(Inpainter(kind=key), "reference.inpainter")[0].problem
    return f"`{FETCHED_BY[key]}` fetches it" if problem and ABSENT in problem and key in FETCHED_BY else problem


def find_revision(key: str) -> str:
    """Return ", revision <12 digits>" of a model from the hub's cache, else an empty text."""
    source = PRIORS.get(key) or (MOEBIUS.repo if key == "moebius" else PAINTERS[key].repo if key in PAINTERS else "")
    folder = local.locate(source) if local.is_id(source) else None
    return f", revision {folder.name[:12]}" if folder and folder.parent.name == "snapshots" else ""


def run_painter(key: str, case: Case) -> Result:
    """Let an inpainter fill the hole in this process, and measure time and memory; raises what the inpainter raises."""
    began = time.monotonic()
    picture = _paint(key, case.image, case.hole)
    seconds, resident = time.monotonic() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    on_gpu = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0
    return Result(picture, seconds, resident / 2**20, on_gpu / 2**30)


def _paint(key: str, image: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Return the picture whose hole the inpainter `key` has filled, uint8 [H, W, 3]."""
    if key == "telea":
        return classical.telea(image, hole)
    if key == "exemplar":
        source = flat_source(image, hole)
        return complete(source, hole, [source]).image
    if key in FEED_FORWARD:
        painter = feedforward.load_inpainter(Inpainter(kind=key))
        assert painter is not None
        return painter.paint(image, hole)
    if key == "moebius":
        return moebius.load(painters.find_moebius(Inpainter(kind="moebius")))(image, hole, 0)
    cuda, small = torch.cuda.is_available(), key == "embedded"
    dtype = torch.float16 if cuda and not small else torch.float32
    prior = load_prior(root() / EMBEDDED if small else PRIORS[key], "cuda" if cuda else "cpu", dtype)
    steps, start = (12, 0.35) if small else (25, 0.999)
    painted = inpaint.paint(
        prior,
        inpaint.to_input(image),
        torch.from_numpy(hole),
        prompt="",
        seeds=[0],
        steps=steps,
        guidance=0.0,
        start=start,
        finest=REFINED_FROM,
    )
    return inpaint.to_picture(painted[0])


def find_faults(picture: np.ndarray, case: Case) -> list[str]:
    """Return what is implausible about a picture, in plain words; an empty list if nothing is."""
    inside, faults = picture[case.hole].astype(float), []
    if (picture != case.image)[~case.hole].any():
        faults.append("pixels outside the hole have changed")
    if inside.std(0).max() < LEAST_CONTRAST:
        faults.append("the hole has one color")
    if np.abs(inside - case.image[case.hole]).mean() < LEAST_CHANGE:
        faults.append("the object is still there")
    if (seam := measure_seam(picture, case.hole) - measure_seam(case.truth, case.hole)) > MOST_SEAM:
        faults.append(f"a seam shows (color step {seam:.2f} above that of the true picture, at most {MOST_SEAM:g})")
    return faults


def measure_seam(picture: np.ndarray, hole: np.ndarray) -> float:
    """Return the mean color step across the border of the hole, see `inpaint.seam_score`."""
    return float(inpaint.seam_score(inpaint.to_input(picture)[None], torch.from_numpy(hole))[0])


def examine(keys: list[str], case: Case, out: Path) -> int:
    """Let the inpainters fill the hole, print a line for each, and save the sheet; return the number of failures."""
    panels, failures = [case.image, case.truth], 0
    for key in keys:
        if problem := find_problem(key):
            print(f"{NAMES[key]:24} not here: {problem}", flush=True)
            continue
        spawn = multiprocessing.get_context("spawn")  # a fork would inherit this process' memory
        try:
            with ProcessPoolExecutor(1, mp_context=spawn) as pool:
                result = pool.submit(run_painter, key, case).result()
        except BrokenProcessPool:
            words = "its process was killed, probably for lack of memory"
        except Exception as error:
            words = " ".join(str(error).split())
        else:
            faults = find_faults(result.picture, case)
            psnr = cv2.PSNR(result.picture[case.hole], case.truth[case.hole])
            on_gpu = f" ({result.gpu_gigabytes:.1f} GB on the GPU)" if result.gpu_gigabytes else ""
            words = f"{result.seconds:.1f} s, {result.gigabytes:.1f} GB{on_gpu}, {psnr:.1f} dB{find_revision(key)}"
            panels.append(result.picture)
            if not faults:
                print(f"{NAMES[key]:24} plausible: {words}; picture {len(panels)}", flush=True)
                continue
            words = f"{'; '.join(faults)} ({words}; picture {len(panels)})"
        failures += 1
        print(f"{NAMES[key]:24} IMPLAUSIBLE: {words}", flush=True)
    save_image(out, np.concatenate(panels, 1))
    print(f"from left to right: with the object, the truth, and the pictures in this order: {out}")
    return failures


def main() -> None:
    """Run `reffusion doctor`; the process exits with status 1 if an inpainter fails or is implausible."""
    parser = argparse.ArgumentParser(prog="reffusion doctor", description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=NAMES, default=list(NAMES), help="inpainters to examine")
    parser.add_argument("--out", type=Path, default=workplace(root()) / "runs" / "doctor.png", help="the sheet")
    arguments = parser.parse_args()
    sys.exit(1 if examine(arguments.only, make_case(), arguments.out) else 0)


if __name__ == "__main__":
    main()

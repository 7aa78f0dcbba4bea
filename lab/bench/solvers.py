"""Diagrams of the bilateral solver, by iterations and cell size, and of depth completion, by the size of its grid.

Both are measured against a known truth.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from lab.bench.points import Diagram, Point, cpu_seconds
from reffusion import seeding, trace
from reffusion.depth import bilateral, completion

HEIGHT, WIDTH = 180, 240
CELLS = (4.0, 8.0, 16.0, 32.0)  # sizes of the bilateral grid's cells, px
UNKNOWNS = (60_000, 5_000, 1_500, 500)  # limits on the completion's number of unknowns
NOISE = 0.01  # standard deviation of the target's noise, relative to that of the map


def picture(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Make a disparity map with a hole, and a picture of the scene.

    Returns:
        truth: [H, W], disparity of three slanted planes that meet.
        target: [H, W], the truth with noise, 0 in the hole.
        confidence: [H, W], 0 in a round hole over the creases between the planes, else 1.
        guide: uint8 [H, W, 3], a picture whose colors change from plane to plane.
        part: [H, W], index of the plane.
    """
    random = np.random.default_rng(seeding.seed_for(seed, "solvers"))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] / WIDTH
    planes = np.stack([0.5 + 0.3 * columns, 0.95 - 0.5 * columns, 0.05 + 1.1 * rows])
    truth, part = planes.max(0), planes.argmax(0)
    colors = np.array([[0.75, 0.6, 0.5], [0.35, 0.45, 0.6], [0.5, 0.5, 0.3]])[part]
    guide = (255 * (colors + 0.03 * random.standard_normal((HEIGHT, WIDTH, 3))).clip(0, 1)).round().astype(np.uint8)
    hole = np.hypot(rows - 0.4, columns - 0.5) < 0.13
    target = truth + NOISE * truth.std() * random.standard_normal(truth.shape)
    return truth, np.where(hole, 0.0, target), (~hole).astype(np.float64), guide, part


def bilateral_diagram() -> Diagram:
    """Measure the bilateral solver along its iterations, for several cell sizes.

    The solver gets an estimate with a different error on each surface, like monocular depth. It corrects the estimate
    in the hole by the misfit around the hole. The error is the RMS error in the hole over the standard deviation of the
    truth. Only the converged points can be recommended.
    """
    truth, target, confidence, guide, part = picture()
    hole = confidence == 0
    estimate = truth + truth.std() * np.array([0.3, -0.2, 0.1])[part] * (0.5 + truth)
    error = lambda map_: float(np.sqrt(np.mean((map_ - truth)[hole] ** 2)) / truth.std())
    points = []
    for cell in CELLS:
        solver = bilateral.Solver(spatial=cell)
        work = lambda watch=None, solver=solver: bilateral.refine(estimate, target, confidence, guide, solver, watch)
        for k, (seconds, wrong) in along(work, error).items():
            points.append(Point(f"{cell:g} px", f"step {k}", k, wrong, seconds, False))
        points.append(Point(f"{cell:g} px", "converged", -1, error(work()), cpu_seconds(work)))
    return Diagram(
        "bilateral",
        f"Bilateral solver, {WIDTH}x{HEIGHT}, cells of 4 to 32 px, along its iterations",
        "RMS error in the hole over the map's spread",
        ("8 px", "converged"),
        points,
        why="Kept at its authors' 8 px, since surfaces as large and plain as these favour larger cells.",
    )


def along(work: Callable, error: Callable, repeats: int = 3) -> dict[int, tuple[float, float]]:
    """Measure an iterative solver along its iterations, at logarithmically spaced iterations.

    Args:
        work: runs the solver. It gets a function that it must call after each iteration with the iteration's number and
            a function whose result begins with the iterate (`bilateral.Watch`).
        error: returns the error of an iterate.
        repeats: number of repetitions, of which the least time counts.

    Returns:
        Iteration -> (CPU seconds since the start of `work` without the measurements, error).
    """
    seconds: dict[int, float] = {}
    errors: dict[int, float] = {}
    for _ in range(repeats):
        began = time.process_time()

        def watch(step: int, look: Callable) -> None:
            nonlocal began
            now = time.process_time()
            if trace.is_log_step(step, -1, per_octave=1):
                seconds[step] = min(seconds.get(step, float("inf")), now - began)
                errors[step] = error(look()[0])
            began += time.process_time() - now

        work(watch)
    return {step: (seconds[step], errors[step]) for step in seconds}


def completion_diagram() -> Diagram:
    """Measure depth completion: the RMS error in the hole over the truth's standard deviation, and the CPU time.

    There is a curve with the picture as guide and one without, and a point for each limit on the number of unknowns.
    """
    truth, target, confidence, guide, _ = picture()
    hole = confidence == 0
    points = []
    for curve, image in (("with the picture", guide), ("without", None)):
        for most in UNKNOWNS:
            plate = completion.Plate(ring=0.08, most_unknowns=most)
            work = lambda plate=plate, image=image: completion.complete(target, confidence, image, plate)
            error = float(np.sqrt(np.mean((work() - truth)[hole] ** 2)) / truth.std())
            points.append(Point(curve, f"{most} unknowns", most, error, cpu_seconds(work)))
    return Diagram(
        "completion",
        f"Completion of a hole in {WIDTH}x{HEIGHT}, at most so many unknowns (more: a coarser grid)",
        "RMS error in the hole over the map's spread",
        ("with the picture", "60000 unknowns"),
        points,
        why="The limit bounds the direct solver's memory for pictures of a megapixel.",
    )

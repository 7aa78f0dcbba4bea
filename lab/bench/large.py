"""Speed of CPU splatting: `python -m lab.bench.large [--sizes 100000@512x384 ...] [--repeats 9] [--threads 2]`.

A *step* is one rendering (color, depth, alpha) and its backward pass. Times are medians of one thread's CPU time, with
all sizes measured in turn; the scaling with threads is measured in wall time. Columns:

  pairs      millions of pixel-Gaussian pairs that are blended, by the oracle's rule
  lanes      millions of pixel-Gaussian slots that the kernel visits, including those that do not blend
  fwd, bwd   milliseconds of the forward and of the backward pass of a step
  step/aim   time of a step over its target time. The target is 0.28 us per Gaussian + 4.2 ns per pair + 8 ns per pixel,
             for a core with a measured peak of 214 GF/s
  scaled     the same, with the target multiplied by 214 / (peak measured in this run)
  Glane/s    visited lanes per second, in the forward and in the backward pass, in 1e9
  FMA share  necessary floating-point operations over what the peak allows in the time: 31 per pair forward, 49 backward
             (a fused multiply-add is two; work per Gaussian or per pixel is not counted)
  threads    speedup of a step by --threads threads over one thread: median and upper quartile over pairs of
             consecutive measurements, in wall time
  ceiling    the same speedup for independent arithmetic, measured between these steps. It is the largest speedup that
             the machine allowed at the time
"""

from __future__ import annotations

import argparse
import math
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

# This import must precede torch. It stops torch's idle threads from spinning, which would undo the second thread's
# gain.
from reffusion.splat import rasterizer  # isort: skip

import numba
import numpy as np
import torch

from reffusion.kernels import vectors as v
from reffusion.splat import cpu, forward
from reffusion.splat.layout import ROWS
from reffusion.types import PARAMETERS, Camera, Gaussians

SIZES = ("5000@256x192", "20000@320x240", "100000@512x384", "100000@1008x756", "500000@1008x756")
PER_GAUSSIAN, PER_PAIR, PER_PIXEL, PEAK = 0.28e-6, 4.2e-9, 8e-9, 214.0  # the target's seconds, and its machine's GF/s
# Operations per pair. Forward: u; log2 alpha; exp2; weight and transmittance; color, depth, alpha. Backward: the first
# four again; shade; colors; remainder; g; the moments of g.
FORWARD_OPERATIONS = 2 + 4 + 13 + 3 + 9
BACKWARD_OPERATIONS = 2 + 4 + 13 + 3 + 7 + 8 + 2 + 5 + 5
LAYERS = 35  # approximate number of Gaussians over each pixel, including occluded ones


@dataclass
class Case:
    """Scene and view to measure, and the measurements.

    Attributes:
        gaussians: the scene.
        camera: the view.
        pairs: number of pixel-Gaussian pairs that are blended.
        lanes: number of pixel-Gaussian slots that the kernel visits, including those that do not blend.
        forward: measured times of the forward pass, one per step, ms.
        backward: measured times of the backward pass, one per step, ms.
    """

    gaussians: Gaussians
    camera: Camera
    pairs: int
    lanes: int
    forward: list[float]
    backward: list[float]

    @property
    def aim(self) -> float:
        """Target time of a step in milliseconds."""
        pixels = self.camera.width * self.camera.height
        return 1e3 * (PER_GAUSSIAN * len(self.gaussians) + PER_PAIR * self.pairs + PER_PIXEL * pixels)


class Scaling(NamedTuple):
    """Speedup by several threads over one thread, in wall time.

    Attributes:
        median: median over pairs of measurements.
        upper: upper quartile over pairs of measurements.
        ceiling: median speedup of independent arithmetic, the largest that the machine allows.
    """

    median: float
    upper: float
    ceiling: float

    def __str__(self) -> str:
        return f"{self.median:8.2f} {self.upper:4.2f} {self.ceiling:8.2f}"


def make_scene(count: int, camera: Camera, seed: int = 0) -> Gaussians:
    """Make random Gaussians of SH degree 3 all over a view's frustum; about `LAYERS` of them cover each pixel."""
    generator = torch.Generator().manual_seed(seed)
    uniform = lambda *shape: torch.rand(*shape, generator=generator)
    normal = lambda *shape: torch.randn(*shape, generator=generator)
    depth = 1.5 + 5 * uniform(count)
    place = (1.1 * uniform(count, 2) - 0.55) * torch.tensor([camera.width, camera.height])
    sigma = 0.8 * math.sqrt(camera.width * camera.height / count * LAYERS / 25)  # pixels
    return Gaussians(
        means=torch.cat((place * depth[:, None] / camera.fx, depth[:, None]), 1),
        quaternions=normal(count, 4),
        log_scales=torch.log(sigma * depth / camera.fx)[:, None] - 0.1 + 0.5 * normal(count, 3),
        opacity_logits=1.5 * normal(count) - 1,
        sh=torch.cat((0.5 * normal(count, 1, 3), 0.1 * normal(count, 15, 3)), 1),
    )


def prepare(size: str) -> Case:
    """Make the case of a size such as "100000@512x384" (number of Gaussians, image size).

    Raises:
        ValueError: the text is not of this form.
    """
    match = re.fullmatch(r"(\d+)@(\d+)x(\d+)", size)
    if not match:
        raise ValueError(f"size {size!r}: write it like {SIZES[0]}")
    count, width, height = map(int, match.groups())
    camera = Camera("bench", width, height, 1.1 * width, 1.1 * width, width / 2, height / 2, np.eye(4))
    gaussians = make_scene(count, camera)
    pairs = rasterizer.accumulate(gaussians, camera, torch.ones(height, width, 1), count=True).sum().item()
    return Case(gaussians, camera, round(pairs), visited_lanes(gaussians, camera), [], [])


def visited_lanes(gaussians: Gaussians, camera: Camera) -> int:
    """Return the number of pixel-Gaussian slots that the forward kernel visits, including those that do not blend."""
    parameters = [getattr(gaussians, name).numpy() for name in PARAMETERS]
    view = cpu.project_and_bin(parameters, gaussians.antialiased, np.empty((0, 2), np.float32), camera, 0)
    nothing, black = np.empty((len(gaussians), 0), np.float32), np.zeros(3, np.float32)
    used = forward.blend(view.footprints, nothing, black, view.bins, camera.width, camera.height)[-1]
    rows = view.bins.entries[:, ROWS]
    rows = np.append(0, np.cumsum((rows >> 8) - (rows & 255)))
    starts = view.bins.starts[:-1]
    return 8 * int((rows[starts + used] - rows[starts]).sum())


def time_step(case: Case, clock) -> tuple[float, float]:
    """Run one forward and one backward pass; return the milliseconds of each by the given clock (in seconds)."""
    leaves = case.gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    start = clock()
    rendering = rasterizer.render(leaves, case.camera)
    middle = clock()
    images = rendering.color, rendering.depth, rendering.alpha
    torch.autograd.grad(images, [getattr(leaves, n) for n in PARAMETERS], [torch.ones_like(i) for i in images])
    return 1e3 * (middle - start), 1e3 * (clock() - middle)


@numba.njit(nogil=True)
def _fma_chains(rounds):
    """Compute ten independent chains of fused multiply-adds on vectors."""
    x, y = v.splat(0.999), v.splat(0.001)
    a, b, c, d, e = v.ramp(), v.ramp() * 2.0, v.ramp() * 3.0, v.ramp() * 4.0, v.ramp() * 5.0
    f, g, h, i, j = v.ramp() * 6.0, v.ramp() * 7.0, v.ramp() * 8.0, v.ramp() * 9.0, v.ramp() * 10.0
    for _ in range(rounds):
        a, b, c, d, e = v.fma(a, x, y), v.fma(b, x, y), v.fma(c, x, y), v.fma(d, x, y), v.fma(e, x, y)
        f, g, h, i, j = v.fma(f, x, y), v.fma(g, x, y), v.fma(h, x, y), v.fma(i, x, y), v.fma(j, x, y)
    return v.any_lane(a + b + c + d + e + f + g + h + i + j > v.splat(0.0))


def fma_peak(rounds: int = 3_000_000, tries: int = 10) -> float:
    """Return the peak speed of one core in GF/s (1e9 floating-point operations per second), the best of some tries."""
    _fma_chains(1)
    seconds = []
    for _ in range(tries):
        start = time.thread_time()
        _fma_chains(rounds)
        seconds.append(time.thread_time() - start)
    return 2 * 10 * v.LANES * rounds / min(seconds) / 1e9


def time_first_image() -> tuple[float, float]:
    """Return the CPU seconds from the start of Python to the first small image, and those of torch's import alone.

    Each is the least of three runs, in a process of its own. The caches of compiled kernels are warm.
    """
    image = (
        "import lab.bench.large as b; import numpy as np; "
        "view = b.Camera('v', 64, 48, 70.0, 70.0, 32.0, 24.0, np.eye(4)); "
        "b.rasterizer.render(b.make_scene(100, view), view)"
    )
    cached = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}

    def seconds(code: str) -> float:
        before = os.times()
        subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2], env=cached)
        after = os.times()
        return after.children_user + after.children_system - before.children_user - before.children_system

    seconds(image)  # fills the caches
    return min(seconds(image) for _ in range(3)), min(seconds("import torch") for _ in range(3))


def measure_scaling(case: Case, threads: int, repeats: int) -> Scaling:
    """Measure the speedup of a step by several threads over one thread in wall time.

    Args:
        case: scene and view.
        threads: number of threads.
        repeats: number of pairs of consecutive measurements, one with one thread and one with several.
    """
    steps, ceilings = [], []
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(time.sleep, threads * [0.01]))  # starts the threads
        for _ in range(repeats):
            ceilings.append(_ceiling(pool, threads))
            steps.append(_best_step(case, 1) / _best_step(case, threads))
    torch.set_num_threads(1)
    return Scaling(*np.percentile(steps, (50, 75)), float(np.median(ceilings)))


def _best_step(case: Case, threads: int, tries: int = 2) -> float:
    """Return the wall time of a step with the given number of threads in milliseconds, the best of some tries."""
    torch.set_num_threads(threads)
    time_step(case, time.perf_counter)  # torch creates its threads again
    return min(sum(time_step(case, time.perf_counter)) for _ in range(tries))


def _ceiling(pool: ThreadPoolExecutor, threads: int, rounds: int = 20_000_000) -> float:
    """Return the speedup of independent arithmetic by the given number of threads over one thread."""
    start = time.perf_counter()
    _fma_chains(rounds)
    middle = time.perf_counter()
    list(pool.map(_fma_chains, threads * [rounds]))
    return threads * (middle - start) / (time.perf_counter() - middle)


def format_row(case: Case, peak: float, speedup: Scaling | None) -> str:
    """Return a row of the table.

    Args:
        case: the case with its measurements.
        peak: peak speed of a core, GF/s.
        speedup: speedup by threads; None if not measured.
    """
    fwd, bwd = float(np.median(case.forward)), float(np.median(case.backward))
    size = f"{len(case.gaussians)}@{case.camera.width}x{case.camera.height}"
    ratio = (fwd + bwd) / case.aim
    share = [1e-6 * n * case.pairs / (ms * peak) for n, ms in ((FORWARD_OPERATIONS, fwd), (BACKWARD_OPERATIONS, bwd))]
    return (
        f"{size:>16} {case.pairs / 1e6:7.2f} {case.lanes / 1e6:7.2f} {fwd:8.1f} {bwd:8.1f} {ratio:9.2f} "
        f"{ratio * peak / PEAK:7.2f} {1e-6 * case.lanes / fwd:8.2f} {1e-6 * case.lanes / bwd:5.2f} "
        f"{share[0]:8.1%} {share[1]:6.1%} {speedup or ''}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", default=SIZES, help="Gaussians@WIDTHxHEIGHT")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2, help="compared with one thread; 1 skips this")
    options = parser.parse_args()
    torch.set_num_threads(1)
    try:
        cases = [prepare(size) for size in options.sizes]
    except ValueError as error:
        sys.exit(f"error: {error}")
    for case in cases:
        time_step(case, time.thread_time)  # compiles, touches memory
    peak = fma_peak()
    for _ in range(options.repeats):
        for case in cases:
            time_step(case, time.thread_time)  # warms the caches, because in a fit one step follows another
            for series, ms in zip((case.forward, case.backward), time_step(case, time.thread_time), strict=True):
                series.append(ms)
    peak = max(peak, fma_peak())
    print(f"FMA peak of one core {peak:.0f} GF/s; {v.LANES} lanes to a vector; ", end="")
    first, torch_alone = time_first_image()
    print(f"from import to first image {first:.2f} s of CPU, {torch_alone:.2f} of them torch's import")
    print(f"{'size':>16} {'pairs':>7} {'lanes':>7} {'fwd':>8} {'bwd':>8} {'step/aim':>9} {'scaled':>7} ", end="")
    print(f"{'Glane/s':>14} {'FMA share':>15} {'threads':>13} {'ceiling':>8}")
    for case in cases:
        speedup = measure_scaling(case, options.threads, options.repeats) if options.threads > 1 else None
        print(format_row(case, peak, speedup), flush=True)


if __name__ == "__main__":
    main()

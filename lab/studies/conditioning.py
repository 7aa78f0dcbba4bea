"""Effect of preconditioning and scaling of linear systems: `python -m lab.studies.conditioning`.

The study measures the three linear systems of depth estimation in two forms each. Alignment: plain normal equations
against centered and scaled ones. Bilateral solver: conjugate gradients with and without Jacobi preconditioning.
Completion: the system for disparity itself against the system for the correction to a plane. It prints errors and
condition numbers, and draws them to --out.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg, eigsh, spsolve

from reffusion.depth import alignment, bilateral, completion

HEIGHT, WIDTH = 48, 64
SPREADS = 10.0 ** np.arange(0, 12)  # offsets of the data from zero, in units of the data's spread
STEPS = 400  # largest number of steps of conjugate gradients


def condition_number(matrix: sparse.spmatrix) -> float:
    """Return the largest over the smallest eigenvalue of a symmetric positive definite matrix."""
    start = np.ones(matrix.shape[0]) + 0.1 * np.arange(matrix.shape[0]) % 0.7  # fixed, for reproducible results
    largest = eigsh(matrix, k=1, which="LA", v0=start, return_eigenvectors=False)[0]
    smallest = eigsh(matrix.tocsc(), k=1, sigma=0.0, which="LM", v0=start, return_eigenvectors=False)[0]
    return float(largest / smallest)


def alignment_conditions(estimate: np.ndarray) -> tuple[float, float]:
    """Return two condition numbers of the normal equations: in plain form, and in the form that `align` solves.

    `align` works about the mean and in units of the spread, which decouples the two equations. The second number
    therefore exceeds 1 only by the rounding of the mean relative to the spread.

    Args:
        estimate: [S], not constant.
    """
    squared = lambda column: float(np.linalg.cond(np.stack([column, np.ones(len(column))], 1)) ** 2)
    return squared(estimate), squared((estimate - estimate.mean()) / estimate.std())


def alignment_errors() -> list[tuple[float, float, float, float]]:
    """Fit a line to exact data with a growing offset, by plain normal equations and by the library.

    Returns:
        Rows of (offset in units of half the data's range, condition number of the plain equations, error of the plain
        fit, error of the library's fit). Errors are maxima over the data, relative to the target's range.
    """
    random, rows = np.random.default_rng(0), []
    base = random.uniform(-1.0, 1.0, 1000)
    for offset in SPREADS[SPREADS < 1e6]:
        x, truth = base + offset, 2.0 * base
        plain = np.linalg.solve([[x @ x, x.sum()], [x.sum(), float(x.size)]], [x @ truth, truth.sum()])
        ours = alignment.align(x, truth)
        error = lambda line, truth=truth: float(np.abs(line - truth).max() / np.ptp(truth))
        rows.append((offset, alignment_conditions(x)[0], error(plain[0] * x + plain[1]), error(ours.apply(x))))
    return rows


def make_maps() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make the input of the bilateral solver, with edges, texture and noise.

    Returns:
        misfit: [H, W], the values to smooth.
        confidence: [H, W], from 1e-2 to 1e2, and 0 in a hole.
        guide: uint8 [H, W, 3].
    """
    random = np.random.default_rng(0)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    bright = np.where(columns + 0.4 * rows < 40, 80, 170)[..., None] + 12 * np.sin(columns / 3)[..., None]
    guide = np.clip(bright + 6 * random.normal(size=(HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8)
    hole = (rows > 14) & (rows < 34) & (columns > 20) & (columns < 44)
    confidence = np.where(hole, 0.0, 10 ** random.uniform(-2, 2, hole.shape))
    return np.where(columns + 0.4 * rows < 40, 0.1, -0.2) + 0.02 * random.normal(size=hole.shape), confidence, guide


def solver_errors() -> dict[str, tuple[float, list[tuple[float, float]]]]:
    """Solve the bilateral solver's system by conjugate gradients with and without preconditioning.

    Returns:
        Kind of preconditioning ("none", "Jacobi") -> (condition number, list with an entry for each step: wall seconds
        since the first step began, L2 error relative to the norm of the direct solution).
    """
    misfit, confidence, guide = make_maps()
    system, cell = bilateral.build_system(confidence, guide)
    right = np.bincount(cell, (confidence * misfit).ravel(), minlength=system.shape[0])
    exact = spsolve(system.tocsc(), right)
    jacobi = sparse.diags(1.0 / system.diagonal())
    root = sparse.diags(1.0 / np.sqrt(system.diagonal()))
    conditions = condition_number(system), condition_number((root @ system @ root).tocsr())
    errors = {}
    for name, form, number in (("none", None, conditions[0]), ("Jacobi", jacobi, conditions[1])):
        iterates, began = [], time.perf_counter()
        note = lambda x, iterates=iterates, began=began: iterates.append((time.perf_counter() - began, x.copy()))
        cg(system, right, rtol=1e-14, maxiter=STEPS, M=form, callback=note)
        error = lambda x: float(np.linalg.norm(x - exact) / np.linalg.norm(exact))
        errors[name] = number, [(seconds, error(x)) for seconds, x in iterates]
    return errors


def completion_errors() -> tuple[float, list[tuple[float, float, float]]]:
    """Complete a plane with a hole and a growing offset, by the system for disparity itself and by the library.

    Returns:
        Condition number of the system, and a list of (offset in units of the plane's range, error of the system for
        disparity itself, error of the library's completion). Errors are maxima in the hole, relative to the plane's
        range.
    """
    _, confidence, _ = make_maps()
    known = confidence > 0
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] / WIDTH
    tilted, errors = columns - 0.6 * rows, []
    plate = completion.Plate(ring=2.0)  # the whole map takes part, as in the absolute form
    system = completion.build_system(known.astype(float), None, np.ones(known.shape, bool), plate)
    factors = completion.factorize(system)
    for offset in SPREADS:
        truth = tilted + offset * np.ptp(tilted)
        absolute = factors.solve(np.where(known, truth, 0.0).ravel()).reshape(truth.shape)
        ours = completion.complete(truth, known, plate=plate)
        error = lambda x, truth=truth: float(np.abs(x - truth)[~known].max() / np.ptp(tilted))
        errors.append((offset, error(absolute), error(ours)))
    return condition_number(system), errors


def measure(say: Callable[[str], None]) -> tuple:
    """Measure all three systems and print the numbers with `say`.

    Returns:
        The arguments of `draw` except the path: results of `alignment_errors` and `solver_errors`, then the condition
        number and the list from `completion_errors`.
    """
    lines, systems, (number, maps) = alignment_errors(), solver_errors(), completion_errors()
    say("alignment: offset / spread, condition (plain), error plain, error centred and scaled (condition 1)")
    for row in lines:
        say("  {:8.0e} {:10.1e} {:10.1e} {:10.1e}".format(*row))
    say("bilateral solver: preconditioning, condition, steps and milliseconds to 1e-6")
    for name, (condition, steps) in systems.items():
        k = next((k for k, (_, error) in enumerate(steps) if error < 1e-6), len(steps) - 1)
        say(f"  {name:8} {condition:10.1e} {k + 1:6d} {1e3 * steps[k][0]:8.1f}")
    say(f"completion, condition {number:.1e}: offset / spread, error absolute, error about a plane")
    for row in maps:
        say("  {:8.0e} {:10.1e} {:10.1e}".format(*row))
    return lines, systems, number, maps


def draw(lines, systems, number, maps, path: Path) -> None:
    """Draw the errors of all three systems; the first arguments are the results of `measure`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.6), layout="constrained")
    first, second, third = figure.subplots(1, 3)
    visible = lambda values: np.maximum(values, 2.0**-53)  # an error of 0 is drawn as one rounding
    first.loglog([r[1] for r in lines], visible([r[2] for r in lines]), "o-", label="plain normal equations")
    first.loglog([r[1] for r in lines], visible([r[3] for r in lines]), "s-", label="centred and scaled")
    first.set(title="alignment", xlabel="condition number of the plain equations", ylabel="relative error")
    for (name, (condition, steps)), style in zip(systems.items(), ("-", "--"), strict=True):
        label = f"preconditioning {name}, condition {condition:.0e}"
        second.semilogy(range(1, len(steps) + 1), [error for _, error in steps], style, label=label)
    second.set(
        title="bilateral solver", xlabel="steps of conjugate gradients", ylabel="relative error", ylim=(1e-12, 3)
    )
    third.loglog([r[0] for r in maps], visible([r[1] for r in maps]), "o-", label="disparity itself")
    third.loglog([r[0] for r in maps], visible([r[2] for r in maps]), "s-", label="correction to a plane")
    third.set(
        title=f"completion, condition {number:.0e}", xlabel="offset / spread of the data", ylabel="relative error"
    )
    for axes in (first, second, third):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/conditioning.png"))
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    draw(*measure(print), arguments.out)
    print(arguments.out)


if __name__ == "__main__":
    main()

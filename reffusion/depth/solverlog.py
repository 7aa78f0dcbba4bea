"""Traces of the solvers that complete depth (docs/development.md#traces)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from reffusion import geometry, trace


class SolverLog:
    """Logs how far the solvers' disparity in one view is from that of the sparse points.

    Only the planes are fitted to these points; for the other solvers they are held out.

    Args:
        log: receives a series for each solver; None: nothing is written.
        view: the view's name.
        pixels, values: image points [S, 2] of sparse points around the hole, and their disparities [S].
    """

    def __init__(self, log: trace.Trace | None, view: str, pixels: np.ndarray, values: np.ndarray):
        self.log, self.view, self.pixels, self.values, self.iterations = log, view, pixels, values, 0

    def log_iteration(self, iteration: int, get_result: Callable[[], tuple[np.ndarray, float]]) -> None:
        """Log an iteration of the bilateral solver; a `bilateral.Watch`."""
        self.iterations = iteration
        if self.log is not None and trace.log_spaced(iteration, -1, per_octave=4):
            with self.log.paused():
                result, residual = get_result()
                self.log.log(iteration, series=f"bilateral {self.view}", residual=residual, **self._error(result))

    def log_result(self, solver: str, result: np.ndarray, iterations: int = 1) -> None:
        """Log a solver's result, disparity [H, W]."""
        if self.log is not None:
            with self.log.paused():
                end = {"reason": "converged"}
                self.log.log(iterations, series=f"{solver} {self.view}", **self._error(result), **end)

    def _error(self, result: np.ndarray) -> dict[str, float]:
        sampled, _ = geometry.sample_nearest(result, self.pixels)
        relative = sampled / self.values - 1
        return {"disparity_error": float(np.sqrt(np.mean(relative**2)))} if len(relative) else {}


NO_LOG = SolverLog(None, "", np.empty((0, 2)), np.empty(0))

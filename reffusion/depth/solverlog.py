"""The trace of the solvers that make up depth (docs/traces.md)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from reffusion import geometry, trace


class SolverLog:
    """How far the solvers' disparity in one view lies from that of the scene's points, which none but the planes see.

    Args:
        log: gets a series for each solver; None: nothing is written.
        view: its name.
        pixels, values: [S, 2] and [S], image points of scene points around the hole, and their disparities.
    """

    def __init__(self, log: trace.Trace | None, view: str, pixels: np.ndarray, values: np.ndarray):
        self.log, self.view, self.pixels, self.values, self.iterations = log, view, pixels, values, 0

    def iterated(self, iteration: int, look: Callable[[], tuple[np.ndarray, float]]) -> None:
        """Tell of an iteration of the bilateral solver: a `bilateral.Watch`."""
        self.iterations = iteration
        if self.log is not None and trace.log_spaced(iteration, -1, per_octave=4):
            with self.log.paused():
                solved, residual = look()
                self.log.log(iteration, series=f"bilateral {self.view}", residual=residual, **self._error(solved))

    def solved(self, solver: str, solved: np.ndarray, iterations: int = 1) -> None:
        """Tell of a solver's result, disparity [H, W]."""
        if self.log is not None:
            with self.log.paused():
                end = {"reason": "converged"}
                self.log.log(iterations, series=f"{solver} {self.view}", **self._error(solved), **end)

    def _error(self, solved: np.ndarray) -> dict[str, float]:
        shown, _ = geometry.sample_nearest(solved, self.pixels)
        relative = shown / self.values - 1
        return {"disparity_error": float(np.sqrt(np.mean(relative**2)))} if len(relative) else {}


SILENT = SolverLog(None, "", np.empty((0, 2)), np.empty(0))

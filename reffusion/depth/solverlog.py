"""Trace of the solvers that complete depth: their error at sparse points (docs/development.md#traces)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from reffusion import geometry, trace


class SolverLog:
    """Logger of the errors of the depth solvers in one view.

    The error ("disparity_error") is the root mean square of (a solver's disparity / the point's disparity - 1) over the
    sparse points around the hole. Without points no error is logged. Only the planes are fitted to these points. The
    other solvers do not read the points, so for the other solvers these points are held-out data.

    Args:
        log: The trace to write to, with one series for each solver. If None, nothing is written.
        view: The name of the view. It is a part of the name of each series.
        pixels: [S, 2] image points (x, y) of the sparse points around the hole, in pixels.
        values: [S] disparities of these points.
    """

    def __init__(self, log: trace.Trace | None, view: str, pixels: np.ndarray, values: np.ndarray):
        self.log, self.view, self.pixels, self.values, self.iterations = log, view, pixels, values, 0

    def log_iteration(self, iteration: int, get_result: Callable[[], tuple[np.ndarray, float]]) -> None:
        """Log the error and the residual of the bilateral solver after an iteration.

        This method is a `bilateral.Watch`. Only iterations that are evenly spaced in the logarithm are logged. The
        attribute `iterations` becomes the number of this iteration in any case.

        Args:
            iteration: The number of iterations so far.
            get_result: Returns the current disparity [H, W] and the current relative residual. It is called only if
                this iteration is logged.
        """
        self.iterations = iteration
        if self.log is not None and trace.is_log_step(iteration, -1, per_octave=4):
            with self.log.pause():
                result, residual = get_result()
                self.log.log(iteration, series=f"bilateral {self.view}", residual=residual, **self._error(result))

    def log_result(self, solver: str, result: np.ndarray, iterations: int = 1) -> None:
        """Log the error of the final result of a solver, in a line that ends the series by the reason "converged".

        Args:
            solver: The name of the solver, which becomes a part of the name of the series.
            result: [H, W] disparity.
            iterations: The number of iterations that the solver took.
        """
        if self.log is not None:
            with self.log.pause():
                end = {"reason": "converged"}
                self.log.log(iterations, series=f"{solver} {self.view}", **self._error(result), **end)

    def _error(self, result: np.ndarray) -> dict[str, float]:
        """Return the entry "disparity_error" of a disparity map [H, W]; empty without points."""
        sampled, _ = geometry.sample_nearest(result, self.pixels)
        relative = sampled / self.values - 1
        return {"disparity_error": float(np.sqrt(np.mean(relative**2)))} if len(relative) else {}


NO_LOG = SolverLog(None, "", np.empty((0, 2)), np.empty(0))

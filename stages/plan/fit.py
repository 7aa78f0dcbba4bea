"""Facts about the stage `fit` that the runner needs before the stage runs; imports nothing heavy."""

from __future__ import annotations

from pathlib import Path

from reffusion.params.fit import Params


def preview(params: Params, *, poses: Path | None, **_: Path | None) -> list[str]:
    """Say if the stage takes over Gaussians that the scene brings; an empty list if it fits Gaussians.

    Args:
        poses: folder of the stage `poses`; None if it has not run.
    """
    has_gaussians = poses is not None and (poses / "gaussians.ply").exists() and params.pixels == "all"
    return ["takes over the scene's gaussians.ply: no optimization"] if has_gaussians else []

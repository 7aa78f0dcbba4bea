"""What can be told of `fit` before it runs."""

from __future__ import annotations

from pathlib import Path

from reffusion.params.fit import Params

__all__ = ["Params", "preview"]


def preview(params: Params, *, poses: Path | None) -> list[str]:
    given = poses is not None and (poses / "gaussians.ply").exists() and params.pixels == "all"
    return ["takes over the scene's gaussians.ply: no optimisation"] if given else []

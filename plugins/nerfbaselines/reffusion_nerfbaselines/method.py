"""A finished run of RefFusion as a method that renders."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from reffusion_nerfbaselines.ask import ask
from reffusion_nerfbaselines.spec import METHOD

FILES = ("scene.ply", "transform.json")  # of a checkpoint, beside nerfbaselines' own nb-info.json


def poses_of(run: Path) -> Path:
    """Return the folder of the stage `poses` of a run; a variant uses that of its scene."""
    own = run / "poses"
    return own if own.is_dir() else run.with_name(run.name.partition("@")[0]) / "poses"


def checkpoint(run: Path, out: Path, data: dict[str, Any]) -> None:
    """Make a checkpoint of a finished run, runs/<scene> or runs/<scene>@<variant>.

    Args:
        data: the data set's metadata.

    Raises:
        FileNotFoundError: the run is not finished.
    """
    sources = {"scene.ply": run / "evaluate" / "scene.ply", "transform.json": poses_of(run) / "transform.json"}
    for name, source in sources.items():
        if not source.is_file():
            raise FileNotFoundError(f"{source} is missing; `make scene={run.name.partition('@')[0]} all` makes it")
        out.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, out / name)
    receipts = [json.loads(path.read_text()) for path in sorted(run.glob("*/receipt.json"))]
    info = {
        "method": METHOD,
        "num_iterations": 1,
        "total_train_time": sum(receipt["seconds"] for receipt in receipts if receipt["stage"] != "evaluate"),
        "dataset_metadata": data,
        "color_space": "srgb",
        "evaluation_protocol": data["evaluation_protocol"],
        "config_overrides": {},
        "hparams": {"profile": receipts[0]["profile"]} if receipts else {},
        "resources_utilization": {"memory": max((r["peak_memory_mb"] for r in receipts), default=0)},
    }
    (out / "nb-info.json").write_text(json.dumps(info, indent=1) + "\n")


class RefFusion:
    """See nerfbaselines' Method."""

    def __init__(self, *, checkpoint: str | None = None, train_dataset: Any = None, config_overrides: Any = None):
        if checkpoint is None:
            raise NotImplementedError("RefFusion trains by itself: `make scene=X all`, then reffusion-nerfbaselines")
        self._folder = Path(checkpoint)

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        return {
            "method_id": METHOD,
            "required_features": frozenset(("color",)),
            "supported_camera_models": frozenset(("pinhole",)),
            "supported_outputs": ("color", "depth", "accumulation"),
        }

    def get_info(self) -> dict[str, Any]:
        own = {"num_iterations": 1, "loaded_step": 1, "loaded_checkpoint": str(self._folder), "hparams": {}}
        return {**self.get_method_info(), **own}

    def get_train_embedding(self, index: int) -> None:
        return None

    def optimize_embedding(self, dataset: Any, *, embedding: Any = None) -> Any:
        raise NotImplementedError("RefFusion has no embeddings of views")

    def render(self, camera: Any, *, options: Any = None) -> dict[str, np.ndarray]:
        camera = camera.item()
        arrays = {"pose": camera.poses[:3, :4], "intrinsics": camera.intrinsics, "size": camera.image_sizes}
        return ask("render", folder=str(self._folder.resolve()), **arrays)

    def export_gaussian_splats(self, *, options: Any = None) -> dict[str, Any]:
        """For nerfbaselines' demo."""
        return dict(ask("splats", folder=str(self._folder.resolve())))

    def train_iteration(self, step: int) -> dict[str, float]:
        raise NotImplementedError("RefFusion trains by itself")

    def save(self, path: str) -> None:
        for name in FILES:
            shutil.copyfile(self._folder / name, Path(path) / name)

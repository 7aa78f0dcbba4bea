"""Box + 10 %: PSNR, SSIM, FLIP and, where weights are, LPIPS in the box around a test view's mask; RefFusion's code."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import numpy as np
from nerfbaselines.evaluation import with_supported_camera_models

from reffusion_nerfbaselines.ask import ask
from reffusion_nerfbaselines.spec import PROTOCOL


def eight_bit(image: np.ndarray) -> np.ndarray:
    """[H, W, 3 or more], uint8 or in [0, 1] -> uint8 [H, W, 3]."""
    image = np.asarray(image)[..., :3]
    return image if image.dtype == np.uint8 else np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)


class BoxProtocol:
    """See nerfbaselines' EvaluationProtocol. REFFUSION_LPIPS names the folder of LPIPS' weights."""

    def get_name(self) -> str:
        return PROTOCOL

    def render(self, method: Any, dataset: Any, *, options: Any = None) -> Any:
        models = method.get_info().get("supported_camera_models", frozenset(("pinhole",)))
        return with_supported_camera_models(models)(method.render)(dataset["cameras"].item(), options=options)

    def evaluate(self, predictions: Any, dataset: Any) -> dict[str, float]:
        """Empty where the view's mask is: it has no box."""
        if dataset.get("masks") is None:
            raise ValueError("these predictions hold no masks, so there is no box to score")
        arrays = {"image": eight_bit(predictions["color"]), "truth": eight_bit(dataset["images"][0])}
        mask = np.asarray(dataset["masks"][0]) > 0
        weights = os.environ.get("REFFUSION_LPIPS", "")
        return {name: float(value) for name, value in ask("score", mask=mask, weights=weights, **arrays).items()}

    def accumulate_metrics(self, metrics: Iterable[dict[str, float]]) -> dict[str, float]:
        """Means over the views that have a value; an identical view counts 100 dB."""
        found: dict[str, list[float]] = {}
        for row in metrics:
            for name, value in row.items():
                found.setdefault(name, []).append(min(value, 100.0) if name == "psnr" else value)
        return {name: float(np.mean(values)) for name, values in found.items()}

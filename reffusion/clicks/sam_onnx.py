"""A distilled Segment Anything Model (SAM) in two ONNX files, run by onnxruntime.

On one core encoding a picture takes 1.7 s, and a mask takes 0.1 s.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from reffusion.clicks.segmenter import Segmenter
from reffusion.onnx import open_session
from reffusion.weights.published import SEGMENTER_FILES

# Outputs of the decoder: the logits of four masks, and the IoU that the network expects of each mask.
MASKS, SCORES = "all_masks", "all_scores"
SIZE = 256, 256  # px, height and width of the decoder's masks
PADDING = -1  # label of the point that stands for "no box"
PRECISE = 0  # index of the mask that is meant for prompts of several points; masks 1 to 3 are part, object and whole


def load_distilled_sam(folder: Path) -> Segmenter | None:
    """Load the network from a folder that `reffusion.weights.npm_package` has written.

    Returns:
        The network, which answers with three masks (part, object, whole). None if a file is missing in the folder.

    Raises:
        ValueError: onnxruntime is not installed, a file is damaged, or the decoder lacks the expected outputs.
    """
    files = [folder / name for name in SEGMENTER_FILES]
    if not all(file.is_file() for file in files):
        return None
    encoder, decoder = (open_session(file, str(file)) for file in files)
    outputs = {each.name for each in decoder.get_outputs()}
    if not {MASKS, SCORES} <= outputs:
        raise ValueError(f"{files[1]}: gives {', '.join(sorted(outputs))}, not {MASKS} and {SCORES}")
    (square,) = encoder.get_inputs()
    side = square.shape[-1]
    no_mask = {"mask_input": np.zeros((1, 1, *SIZE), np.float32), "has_mask_input": np.zeros(1, np.float32)}

    def encode(picture: np.ndarray) -> np.ndarray:
        return encoder.run(None, {square.name: picture})[0]

    def decode(features: Any, points: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if labels.max() < 2:  # without a box the network expects a padding point
            points, labels = np.vstack([points, np.zeros((1, 2))]), np.append(labels, PADDING)
        prompt = {"point_coords": points[None].astype(np.float32), "point_labels": labels[None].astype(np.float32)}
        size = {"orig_im_size": np.array([side, side], np.float32)}
        masks, scores = decoder.run([MASKS, SCORES], {"image_embeddings": features, **prompt, **no_mask, **size})
        return masks.reshape(4, *SIZE)[PRECISE + 1 :], scores.reshape(4)[PRECISE + 1 :]

    return Segmenter("a distilled SAM", side, encode, decode)

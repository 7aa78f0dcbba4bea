"""Loading of the segmentation network that the parameter `segmenter` names."""

from __future__ import annotations

from reffusion.clicks import sam_onnx, sam_transformers
from reffusion.clicks.segmenter import Segmenter
from reffusion.weights.segmenters import AUTO, NONE, segmenter_folder


def load_local_segmenter(source: str = AUTO) -> Segmenter | None:
    """Load the segmentation network that the parameter `segmenter` names.

    Args:
        source: "auto" for the network that `reffusion weights` fetches; "none" for no network; otherwise a folder
            (encoder.onnx and decoder.onnx, or a SAM of transformers) or a hub id whose files are on this machine.

    Returns:
        The network. None for "none", and for "auto" if the network is not on this machine.

    Raises:
        ValueError: a named source holds no network or is not on this machine, the network's files are damaged, or
            onnxruntime is missing. The message has one line.
    """
    if source == NONE:
        return None
    segmenter = sam_onnx.load_distilled_sam(segmenter_folder(source))
    if segmenter is None and source != AUTO:
        segmenter = sam_transformers.load_sam(source)
        if segmenter is None:
            raise ValueError(f"segmenter: {source} is not on this machine")
    return segmenter

"""Opens the segmentation network of a setting."""

from __future__ import annotations

from reffusion.clicks import sam_onnx, sam_transformers
from reffusion.clicks.segmenter import Segmenter
from reffusion.weights.segmenters import AUTO, NONE, segmenter_folder


def load_local_segmenter(source: str = AUTO) -> Segmenter | None:
    """The network of the setting `segmenter`: "auto" is the one that `reffusion weights` fetches, or None if it is not
    on this machine; "none" is None; else a folder, or a hub id whose files are on this machine.

    Raises:
        ValueError: there is no network at a source that is named, or it is damaged; one line.
    """
    if source == NONE:
        return None
    segmenter = sam_onnx.load_distilled_sam(segmenter_folder(source))
    if segmenter is None and source != AUTO:
        segmenter = sam_transformers.load_sam(source)
        if segmenter is None:
            raise ValueError(f"segmenter: {source} is not on this machine")
    return segmenter

"""The segmentation network on this machine: found, opened, and named for the key of results that depend on it."""

from __future__ import annotations

import hashlib
from pathlib import Path

from reffusion.clicks.segmenter import Segmenter
from reffusion.weights.local import SEGMENTER_FILES, segmenter_cache

AUTO, NONE = "auto", "none"


def load_local_segmenter(source: str = AUTO) -> Segmenter | None:
    """The network of the setting `segmenter`: "auto" is the one that `reffusion weights` fetches, or None if it is not
    on this machine; "none" is None; else a folder, or a hub id whose files are on this machine.

    Raises:
        ValueError: there is no network at a source that is named, or it is damaged; one line.
    """
    from reffusion.clicks import sam_onnx, sam_transformers

    if source == NONE:
        return None
    found = sam_onnx.load_distilled_sam(segmenter_cache() if source == AUTO else Path(source).expanduser())
    if found is None and source != AUTO:
        found = sam_transformers.load_sam(source)
        if found is None:
            raise ValueError(f"segmenter: {source} is not on this machine")
    return found


def segmenter_facts(source: str) -> dict[str, str]:
    """What masks from clicks depend on: the hash of the network's files, or that there is none."""
    folder = segmenter_cache() if source == AUTO else Path(source).expanduser()
    files = [folder / name for name in SEGMENTER_FILES]
    if source == NONE or not all(file.is_file() for file in files):
        return {"segmenter": NONE if source == AUTO else source}
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return {"segmenter": digest.hexdigest()[:16]}

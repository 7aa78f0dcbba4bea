"""Segmentation networks on this machine: the folder of the network that a setting names, and a hash of its files.

The module imports no large libraries, so that `plan` can use it.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from reffusion.weights.local import segmenter_cache
from reffusion.weights.published import SEGMENTER_FILES

AUTO, NONE = "auto", "none"


def segmenter_folder(source: str) -> Path:
    """Return the folder that the parameter `segmenter` names.

    "auto" stands for the folder into which `reffusion weights` downloads the default network. Any other text, also a
    hub id, is taken as a path. The folder need not exist.
    """
    return segmenter_cache() if source == AUTO else Path(source).expanduser()


def segmenter_facts(source: str) -> dict[str, str]:
    """Return the facts about the segmentation network on which masks from clicks depend.

    Returns:
        {"segmenter": 16 digits of the sha256 of the network's ONNX files}. Without ONNX files: {"segmenter": "none"}
        if `source` is "auto", else {"segmenter": source}.
    """
    files = [segmenter_folder(source) / name for name in SEGMENTER_FILES]
    if source == NONE or not all(file.is_file() for file in files):
        return {"segmenter": NONE if source == AUTO else source}
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return {"segmenter": digest.hexdigest()[:16]}

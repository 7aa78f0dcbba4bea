"""Segmentation networks on this machine: where the one of a setting lies, and a name for the key of its results.

Imports nothing heavy, so that `plan` can use it.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

from reffusion.weights.local import segmenter_cache
from reffusion.weights.published import SEGMENTER_FILES

AUTO, NONE = "auto", "none"


def segmenter_folder(source: str) -> Path:
    """The folder that the setting `segmenter` means: "auto" is where `reffusion weights` puts the network."""
    return segmenter_cache() if source == AUTO else Path(source).expanduser()


def segmenter_facts(source: str) -> dict[str, str]:
    """What masks from clicks depend on: the hash of the network's files, or that there is none."""
    files = [segmenter_folder(source) / name for name in SEGMENTER_FILES]
    if source == NONE or not all(file.is_file() for file in files):
        return {"segmenter": NONE if source == AUTO else source}
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return {"segmenter": digest.hexdigest()[:16]}

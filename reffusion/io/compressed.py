"""Reading and writing of quantized files by the library gsply: PlayCanvas's compressed .ply and Niantic's .spz.

A compressed .ply is quantized in chunks of 256 Gaussians. This is the only module that imports gsply.
"""

from __future__ import annotations

import gzip
import importlib.util
import struct
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io.files import BadInput, reading
from reffusion.io.splat_rows import Rows

if TYPE_CHECKING:
    from reffusion.types import Gaussians, Similarity

MIP_COMMENT = "SplatRenderMode: mip"  # the comment by which Brush marks a .ply as antialiased; splat-transform reads it
PACKED = "packed_position"  # a vertex property by which a compressed .ply is recognized
SPZ_HEADER, SPZ_MAGIC = struct.Struct("<IIIBBBB"), 0x5053474E
SPZ_LIMIT = 2.0**22  # coordinates are below: 24 bits, one of them fractional, one the sign
SPZ_FLAGS = 14  # index of the byte of flags in the header; its lowest bit means antialiased
# Sign of each spherical harmonic when y and z change sign, in the order of 3DGS (degree 1 is y, z, x).
TURNED_SH = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


def save_compressed(path: Path, gaussians: Gaussians, similarity: Similarity) -> None:
    """Write Gaussians as a compressed .ply in the scene's own frame, and create its folder.

    The Gaussians are sorted along a Morton curve, so that chunks have a small extent and quantization is fine. The x, y
    and z of a position keep 11, 10 and 11 bits of the chunk's extent. Colors, opacity and spherical harmonics keep 8
    bits.

    Args:
        gaussians: in the normalized frame, on the CPU.
        similarity: from the scene's own frame to the normalized frame.

    Raises:
        BadInput: gsply is not installed.
    """
    gsply = _import_gsply(path)
    order = np.argsort(_morton_codes(gaussians.means.double().numpy()), kind="stable")
    arrays = {name: getattr(gaussians, name).double().numpy()[order] for name in ("means", "log_scales", "quaternions")}
    plain = lambda array: np.ascontiguousarray(array, np.float32)
    lengths = np.linalg.norm(arrays["quaternions"], axis=1, keepdims=True)
    turned = np.where(lengths > 0, arrays["quaternions"] / np.maximum(lengths, 1e-30), [1.0, 0.0, 0.0, 0.0])
    sh = gaussians.sh.numpy()[order]
    data = gsply.compress_to_bytes(
        plain(similarity.invert(arrays["means"])),
        plain(arrays["log_scales"] - np.log(similarity.scale)),
        plain(turned),
        plain(gaussians.opacity_logits.numpy()[order]),
        plain(sh[:, 0]),
        plain(sh[:, 1:]) if sh.shape[1] > 1 else None,
    )
    if gaussians.antialiased:  # gsply writes no comment about it
        data = data.replace(b"element", f"comment {MIP_COMMENT}\nelement".encode(), 1)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_bytes(data)


def load_compressed(path: Path) -> Rows:
    """Read the splats of a compressed .ply. Raises BadInput if the file is damaged or gsply is not installed."""
    gsply = _import_gsply(path)
    with reading(path, "a compressed .ply"):
        return _to_rows(gsply.plyread(str(path)))


def load_spz_header(path: Path) -> tuple[int, int, bool]:
    """Read the header of a .spz file.

    Returns:
        count: the number of splats.
        version: the version of the format.
        antialiased: True if the splats are to be rendered with Mip-Splatting's 2D filter.

    Raises:
        BadInput: the file is no .spz file, or its spherical harmonics have a degree above 3.
    """
    with reading(path, "a .spz file"), open(path, "rb") as file:
        start = file.read(4096)
        if start[:2] == b"\x1f\x8b":  # versions 1 to 3 are one gzip stream
            start = zlib.decompressobj(31).decompress(start, SPZ_HEADER.size)
        magic, version, count, degree, _, flags, _ = SPZ_HEADER.unpack_from(start)
        if magic != SPZ_MAGIC:
            raise BadInput(f"{path}: not a .spz file; it does not begin with NGSP")
        if degree > 3:
            raise BadInput(f"{path}: spherical harmonics of degree {degree}; convert it to .ply, or to degree 3")
        return count, version, bool(flags & 1)


def load_spz(path: Path) -> Rows:
    """Read the splats of a .spz, and rotate them by 180 degrees about x into the frame that a .ply would have.

    In a .spz file y points up, in a .ply down.

    Raises:
        BadInput: the file is damaged or gsply is not installed.
    """
    gsply = _import_gsply(path)
    with reading(path, "a .spz file"):
        return _turn_about_x(_to_rows(gsply.read_spz(str(path))))


def save_spz(path: Path, rows: Rows, antialiased: bool = False) -> None:
    """Write rows as a .spz file of version 3, and create its folder.

    Positions are fixed-point numbers of 24 bits. As many bits as the largest coordinate allows are fractional.

    Args:
        rows: in the frame of a .ply (y down); they are rotated by 180 degrees about x for the file.
        antialiased: True if the splats are to be rendered with Mip-Splatting's 2D filter.

    Raises:
        BadInput: gsply is not installed, or a coordinate is too large for the format.
    """
    gsply = _import_gsply(path)
    turned = _turn_about_x(rows)
    extent = float(np.abs(turned.means).max(initial=1e-6))
    if extent >= SPZ_LIMIT:
        raise BadInput(f"{path}: a .spz holds coordinates up to {SPZ_LIMIT:.0f}, here {extent:.0f}; use a .ply")
    plain = lambda array: np.ascontiguousarray(array, np.float32)
    data = gsply.GSData.from_arrays(
        means=plain(turned.means),
        scales=turned.log_scales,
        quats=plain(turned.unit_quaternions),
        opacities=turned.opacity_logits,
        sh0=plain(turned.sh[:, 0]),
        shN=plain(turned.sh[:, 1:]) if turned.sh.shape[1] > 1 else None,
        format="ply",
    )
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    gsply.write_spz(str(path), data, version=3, fractional_bits=int(np.clip(22 - np.ceil(np.log2(extent)), 1, 20)))
    if antialiased:  # gsply writes no flags
        content = bytearray(gzip.decompress(Path(path).read_bytes()))
        content[SPZ_FLAGS] |= 1
        Path(path).write_bytes(gzip.compress(content, 6, mtime=0))


def _to_rows(data) -> Rows:
    """Convert gsply's arrays to rows."""
    sh = data.sh0[:, None] if data.shN is None else np.concatenate([data.sh0[:, None], data.shN], axis=1)
    return Rows(data.means.astype(np.float64), data.quats, data.scales, data.opacities.reshape(-1), sh)


def _turn_about_x(rows: Rows) -> Rows:
    """Rotate rows by 180 degrees about x: y and z of positions and rotations change sign."""
    means, quaternions = rows.means * (1, -1, -1), rows.quaternions * np.array([1, 1, -1, -1], np.float32)
    # The spherical harmonics that are odd under this change of sign are negated.
    return Rows(means, quaternions, rows.log_scales, rows.opacity_logits, rows.sh * TURNED_SH[: rows.sh.shape[1], None])


def check_gsply(path: Path) -> None:
    """Raise BadInput if gsply is not installed, without importing gsply. `path` is for the message."""
    if importlib.util.find_spec("gsply") is None:
        raise BadInput(f"{path}: a quantised file takes gsply: `pip install gsply`, or save it as plain .ply")


def _import_gsply(path: Path):
    """Return the module gsply. Raises BadInput if it is not installed."""
    check_gsply(path)
    import gsply

    return gsply


def _morton_codes(points: np.ndarray) -> np.ndarray:
    """Compute Morton codes, uint64 [N], of positions [N, 3]."""
    low, extent = points.min(0, initial=np.inf), np.ptp(points, axis=0).max(initial=1e-30)
    cells = ((points - low) / extent * (2**20 - 1)).astype(np.uint64)
    # A code interleaves the bits of x, y and z (20 each), so that positions with similar codes lie near each other.
    code = np.zeros(len(points), np.uint64)
    for bit in range(20):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code

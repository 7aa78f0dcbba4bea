"""Reading of files of Gaussians.

They are .ply of 3DGS and related tools, compressed .ply, .spz, .splat, .glb and, by splat-transform, .sog, .ksplat,
.lcc and .lcc2.

A row is one Gaussian of a file. Rows are read and checked in blocks, so that memory holds only one block besides the
result.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reffusion.io import compressed, glb, splat_format, splat_transform
from reffusion.io.files import BadInput, is_file, reading
from reffusion.io.ply_table import load_header, load_vertices
from reffusion.io.splat_rows import BAD_SHARE, DEGREE, FLAT, Repairs, Rows, drop_invalid, fold_filter
from reffusion.splat.conventions import SH0

if TYPE_CHECKING:
    from reffusion.types import Gaussians, Similarity

POSITION = ("x", "y", "z")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
RED_GREEN_BLUE = ("red", "green", "blue")
FILTER = "filter_3D"  # property of Mip-Splatting: the standard deviation of the 3D filter of each Gaussian
# Comments of a .ply that say whether the Gaussians are to be rendered with Mip-Splatting's 2D filter: first those of
# Brush and splat-transform, then those of Postshot and, without a number, of earlier versions of this program.
RENDERING = re.compile(r"splatrendermode: ?(\w+)|antialiased(?: ([01]))?", re.IGNORECASE)
FORMATS = (".ply", ".compressed.ply", ".spz", ".splat", ".glb")  # endings of the files that are read and written
BY_PROGRAM = "save the scene as .ply in the program that wrote it"
UNREAD = {  # ending of a file that is not read: how to get a file that is
    **dict.fromkeys((".usdz", ".usd", ".usda", ".usdc"), BY_PROGRAM),
    ".gltf": "save the scene as .glb or .ply in the program that wrote it",
    ".zip": "unpack it, and name a file of splats in it",
    ".gz": "unpack it, and name the file in it",
    ".ckpt": "it is a checkpoint of nerfstudio; `ns-export gaussian-splat --load-config config.yml --output-dir .` "
    "writes a .ply",
    ".pt": "it is a checkpoint of gsplat; gsplat.export_splats writes a .ply of its `splats`",
    ".pth": "it is a checkpoint of 3DGS; name the point_cloud/iteration_*/point_cloud.ply beside it",
}
BLOCK = 8192  # rows that are read at a time
DEGREES = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(11)}  # number of `f_rest` properties -> degree


@dataclass(frozen=True)
class Splats:
    """The Gaussians of a file in the file's own frame, and notes on what was changed when they were read.

    Attributes:
        rows: the valid Gaussians, in the order of the file.
        antialiased: True if they are to be rendered with Mip-Splatting's 2D filter, which lowers the opacity of
            Gaussians that the low-pass widens. Always False for the two scales of 2DGS and for a .splat.
        notes: what was changed, a sentence each, without the file's name.
    """

    rows: Rows
    antialiased: bool
    notes: tuple[str, ...]

    def gaussians(self, similarity: Similarity | None = None) -> Gaussians:
        """Return the Gaussians as float32 tensors on the CPU.

        Args:
            similarity: from the file's frame to the normalized frame, into which the result is converted; None keeps
                the file's frame.
        """
        import torch

        from reffusion.types import Gaussians

        means, log_scales = self.rows.means, self.rows.log_scales
        if similarity is not None:
            means, log_scales = similarity.apply(means), log_scales + np.float32(np.log(similarity.scale))
        arrays = (means, self.rows.quaternions, log_scales, self.rows.opacity_logits, self.rows.sh)
        plain = (torch.from_numpy(np.array(array, np.float32, order="C", copy=None)) for array in arrays)
        return Gaussians(*plain, antialiased=self.antialiased)


@dataclass(frozen=True)
class Summary:
    """The contents of a file of Gaussians, as far as its header tells.

    Attributes:
        count: the number of rows, valid or not; None if it is known only after the file was converted.
        notes: what reading the file will change, a sentence each, without the file's name.
        properties: names of the vertex properties of a plain .ply, in order; empty for all other formats.
        antialiased: as in `Splats`.
    """

    count: int | None
    notes: tuple[str, ...] = ()
    properties: tuple[str, ...] = ()
    antialiased: bool = False


def summarize_splats(path: Path) -> Summary:
    """Return what the header of a file of Gaussians tells; no rows are read.

    Raises:
        BadInput: the file is truncated, is no file of Gaussians, or has a format that is not read; or gsply or Node is
            needed and not installed.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if splat_transform.is_convertible(path):
        splat_transform.check_node(path)
        notes = (
            f"it is converted to .ply by {splat_transform.PACKAGE}, which npm downloads at its first use (210 MB)",
        )
        return Summary(None, notes, antialiased=splat_transform.is_antialiased(path))
    if ending in UNREAD:
        raise BadInput(f"{path}: {ending} is not read; {UNREAD[ending]}")
    if ending == ".glb":
        count, antialiased = glb.summarize_glb(path)
        return Summary(count, antialiased=antialiased)
    if ending == ".splat":
        return Summary(splat_format.count_splat(path))
    if ending == ".spz":
        compressed.check_gsply(path)
        count, _, antialiased = compressed.load_spz_header(path)
        return Summary(count, antialiased=antialiased)
    header = load_header(path)
    count, names = header.vertices()
    if compressed.PACKED in names:
        compressed.check_gsply(path)
        return Summary(count, antialiased=is_antialiased(header.comments))
    notes = _check_properties(path, names)
    smoothed = FILTER in names or (SCALES[2] in names and is_antialiased(header.comments))
    return Summary(count, notes, tuple(names), smoothed)


def is_antialiased(comments: Sequence[str]) -> bool:
    """Return whether the comments of a .ply ask for Mip-Splatting's 2D filter. The last comment about it counts."""
    found = [match[1] or match[2] or "1" for comment in comments if (match := RENDERING.fullmatch(comment))]
    return bool(found) and found[-1].lower() in ("mip", "1")


def load_splats(path: Path) -> Splats:
    """Read the Gaussians of a file. Invalid rows are dropped, see `splat_rows.drop_invalid`.

    Raises:
        BadInput: the file cannot be read or is no file of Gaussians, more than half of its rows are invalid, or all of
            them are dropped. A file of 0 rows is no error. The message names the file.
    """
    path = Path(path)
    is_file(path)
    summary, ending = summarize_splats(path), path.suffix.lower()
    if summary.count is None:
        with tempfile.TemporaryDirectory() as folder:
            converted = load_splats(splat_transform.convert_to_ply(path, Path(folder)))
            return Splats(converted.rows, converted.antialiased or summary.antialiased, converted.notes)
    with reading(path, "a file of Gaussians"):
        if ending == ".splat":
            read = splat_format.open_splat(path)
        elif ending == ".glb":
            read = glb.load_glb(path).take
        elif ending == ".spz":
            read = compressed.load_spz(path).take
        elif not summary.properties:
            read = compressed.load_compressed(path).take
        else:
            read = _open_ply(load_vertices(path, load_header(path)))
        rows, repairs = _gather(path, summary.count, read)
    repair_note = repairs.sentence(summary.count)
    return Splats(rows, summary.antialiased, (*summary.notes, *([repair_note] if repair_note else [])))


def _gather(path: Path, count: int, read: Callable[[slice], Rows]) -> tuple[Rows, Repairs]:
    """Read `count` rows in blocks; return the valid rows, in order, and how many rows were dropped or changed."""
    first, repairs, at = read(slice(0, 0)), Repairs(), 0
    whole = Rows(*(np.empty((count, *array.shape[1:]), array.dtype) for array in vars(first).values()))
    for start in range(0, count, BLOCK):
        found, done = drop_invalid(read(slice(start, min(start + BLOCK, count))))
        repairs += done
        for array, block in zip(vars(whole).values(), vars(found).values(), strict=True):
            array[at : at + len(found)] = block
        at += len(found)
    if repairs.invalid > BAD_SHARE * count:
        raise BadInput(
            f"{path}: {repairs.invalid} of {count} splats hold NaN or infinite values: the file is damaged, or the "
            "training that wrote it diverged; save it again"
        )
    if count and not at:
        raise BadInput(f"{path}: it holds no Gaussians: {repairs.sentence(count)}")
    return whole.take(slice(at)), repairs


def _open_ply(table: np.ndarray) -> Callable[[slice], Rows]:
    """Return a function that converts a slice of a plain .ply's vertex table to rows."""
    names = table.dtype.names
    higher = sum(name.startswith("f_rest_") for name in names) // 3
    # Spherical harmonics above `DEGREE` are dropped.
    used = min(higher, (DEGREE + 1) ** 2 - 1)
    rest = [[f"f_rest_{channel * higher + k}" for channel in range(3)] for k in range(used)]

    def read_columns(block: np.ndarray, columns: Sequence[str], kind: str) -> np.ndarray:
        found = np.empty((len(block), len(columns)), kind)
        with np.errstate(over="ignore"):
            for column, name in enumerate(columns):
                found[:, column] = block[name]
        return found

    def read(chosen: slice) -> Rows:
        block = np.array(table[chosen])  # the table is a memory map: copy it once, or each property reads the disk
        logits = read_columns(block, ["opacity"], "f8")[:, 0]
        scales = read_columns(block, [name for name in SCALES if name in names], "f8")
        # The missing third scale of 2DGS becomes that of a flat axis.
        if scales.shape[1] == 2:
            scales = np.column_stack([scales, np.full(len(block), FLAT)])
        # Mip-Splatting's 3D filter is folded into scales and opacities.
        if FILTER in names:
            scales, logits = fold_filter(scales, logits, block[FILTER])
        sh = np.empty((len(block), 1 + used, 3), np.float32)
        sh[:, 0] = read_columns(block, DC, "f4") if DC[0] in names else _color_coefficients(block)
        for k, columns in enumerate(rest):
            sh[:, 1 + k] = read_columns(block, columns, "f4")
        with np.errstate(over="ignore"):
            narrow = scales.astype(np.float32), logits.astype(np.float32)
        return Rows(read_columns(block, POSITION, "f8"), read_columns(block, ROTATION, "f4"), *narrow, sh)

    return read


def _color_coefficients(block: np.ndarray) -> np.ndarray:
    """Return the constant spherical harmonic, float32 [N, 3], of colors that are bytes, or floats in [0, 1]."""
    colors = np.stack([block[name] for name in RED_GREEN_BLUE], axis=1)
    unit = colors if np.issubdtype(colors.dtype, np.floating) else colors / 255
    return ((unit - 0.5) / SH0).astype(np.float32)


def _check_properties(path: Path, names: Sequence[str]) -> tuple[str, ...]:
    """Return what reading a plain .ply will change, a sentence each; raises BadInput if it is no file of Gaussians."""
    others = (*POSITION, "opacity", *SCALES[:2], *ROTATION)
    colored = {*others, *RED_GREEN_BLUE} <= {*names} and DC[0] not in names  # as nerfstudio writes on request
    missing = [n for n in (*others, *(() if colored else DC)) if n not in names]
    if missing:
        raise BadInput(f"{path}: not a file of Gaussians, it lacks {', '.join(missing)}; export the Gaussians")
    count = sum(n.startswith("f_rest_") for n in names)
    if count not in DEGREES or any(f"f_rest_{k}" not in names for k in range(count)):
        raise BadInput(f"{path}: {count} f_rest properties; 0, 9, 24, 45 or 72 belong to degrees 0 to 4")
    if len(set(names)) < len(names):
        raise BadInput(f"{path}: a property comes twice")
    notes = ["the 3D filter of Mip-Splatting is folded into scales and opacities"] if FILTER in names else []
    notes += ["it has two scales, as 2DGS writes: the third axis is flat"] if SCALES[2] not in names else []
    if DEGREES[count] > DEGREE:
        notes.append(f"spherical harmonics of degree {DEGREES[count]} are cut to degree {DEGREE}")
    return tuple(notes)

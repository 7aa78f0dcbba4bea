"""Reading and writing of .glb files with splats: glTF 2.0 with the extension KHR_gaussian_splatting.

A primitive of points holds an accessor for each parameter: rotations as xyzw, scales and opacities as plain numbers,
and spherical harmonics in the order of 3DGS. In glTF y points up, in a .ply of splats down.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.io.files import BadInput, reading
from reffusion.io.splat_rows import Rows, rotate_rows
from reffusion.splat.conventions import SH0

HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
EXTENSION, COMPRESSION = "KHR_gaussian_splatting", "EXT_meshopt_compression"
TYPES = {
    5120: np.dtype("i1"),
    5121: np.dtype("u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5126: np.dtype("<f4"),
}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
POINTS = 0  # mode of a primitive
Y_UP = np.diag([-1.0, -1.0, 1.0])  # rotation by 180 degrees about z from the frame of a .ply, as splat-transform does
MIP = {"SplatRenderMode": "mip"}  # our extra of a primitive; the extension has no word for Mip-Splatting's 2D filter
LARGEST = 2**32 - 1  # bytes of a .glb


@dataclass(frozen=True)
class Glb:
    """A file's JSON, `document`, and `start`, the offset in bytes at which the data of its binary chunk begins."""

    path: Path
    document: dict[str, Any]
    start: int

    def primitives(self) -> list[tuple[dict[str, Any], np.ndarray]]:
        """Return the primitives of splats in the scene, each with the transform [4, 4] of its node to the scene."""
        nodes, scenes = self.document.get("nodes", []), self.document.get("scenes")
        roots = scenes[self.document.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
        found, left = [], [(index, np.eye(4)) for index in roots]
        for _ in range(len(nodes)):  # a node has one parent
            if not left:
                break
            index, above = left.pop()
            placed = above @ _node_matrix(nodes[index])
            left += [(child, placed) for child in nodes[index].get("children", [])]
            if "mesh" in nodes[index]:
                found += [(each, placed) for each in self.document["meshes"][nodes[index]["mesh"]]["primitives"]]
        return [(each, placed) for each, placed in found if EXTENSION in each.get("extensions", {})]

    def count(self, primitive: dict[str, Any]) -> int:
        """Return the number of splats of a primitive."""
        return int(self.document["accessors"][primitive["attributes"]["POSITION"]]["count"])

    def values(self, primitive: dict[str, Any], name: str) -> np.ndarray:
        """Return an attribute as float32 [N, width], normalized integers scaled to [-1, 1] or [0, 1].

        Raises BadInput if the values are compressed, sparse, in another file, or not as many as splats.
        """
        accessor = self.document["accessors"][primitive["attributes"][name]]
        view = self.document["bufferViews"][accessor["bufferView"]]
        kind: np.dtype[Any] = TYPES[accessor["componentType"]]
        width, count = WIDTHS[accessor["type"]], self.count(primitive)
        if COMPRESSION in view.get("extensions", {}) or "sparse" in accessor:
            raise BadInput(f"{self.path}: compressed or sparse values; save it without compression")
        if view["buffer"] or "uri" in self.document["buffers"][0]:
            raise BadInput(f"{self.path}: its splats are in another file; save it as one .glb")
        stride = view.get("byteStride", kind.itemsize * width)
        at = self.start + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        if accessor["count"] != count:
            raise BadInput(f"{self.path}: {name} has {accessor['count']} values for {count} splats; save it again")
        if not count:
            return np.empty((0, width), np.float32)
        data = np.memmap(self.path, np.uint8, "r", at, ((count - 1) * stride + kind.itemsize * width,))
        table = np.ndarray((count, width), kind, data, strides=(stride, kind.itemsize))
        if not accessor.get("normalized"):
            return table.astype(np.float32)
        return np.maximum(table / np.iinfo(kind).max, -1.0).astype(np.float32)


def open_glb(path: Path) -> Glb:
    """Read the JSON of a .glb.

    Raises:
        BadInput: the file is no .glb or cut off, or its splats are missing, compressed, or of another kind than 3DGS's.
    """
    with reading(path, "a .glb file"), open(path, "rb") as file:
        magic, version, size = HEADER.unpack(file.read(HEADER.size))
        length, kind = CHUNK.unpack(file.read(CHUNK.size))
        if magic != b"glTF" or version != 2 or kind != b"JSON":
            raise BadInput(f"{path}: not a .glb file of glTF 2.0")
        if size > (found := path.stat().st_size):
            raise BadInput(f"{path}: cut off: {found} of {size} bytes")
        glb = Glb(path, json.loads(file.read(length)), HEADER.size + 2 * CHUNK.size + length)
        primitives = glb.primitives()
        if not primitives:
            raise BadInput(f"{path}: it has no splats of {EXTENSION}; export the Gaussians")
        for primitive, _ in primitives:
            _check_kind(path, primitive)
        return glb


def summarize_glb(path: Path) -> tuple[int, bool]:
    """Return the number of splats, and whether all are antialiased, from the JSON. Raises as `open_glb`."""
    glb = open_glb(path)
    with reading(path, "a .glb file"):
        primitives = [primitive for primitive, _ in glb.primitives()]
        return sum(map(glb.count, primitives)), all(each.get("extras") == MIP for each in primitives)


def load_glb(path: Path) -> Rows:
    """Read the splats of a .glb in the frame that a .ply would have; raises as `open_glb`, or if it is damaged.

    The transforms of nodes are applied; they may scale, rotate and shift.
    """
    glb = open_glb(path)
    with reading(path, "a .glb file"):
        parts = [_load_primitive(glb, *each) for each in glb.primitives()]
        # Harmonics of the primitives with fewer degrees are 0.
        most = max(part.sh.shape[1] for part in parts)
        widened = [np.pad(part.sh, ((0, 0), (0, most - part.sh.shape[1]), (0, 0))) for part in parts]
        columns = zip(*(list(vars(part).values())[:-1] for part in parts), strict=True)
        return Rows(*(np.concatenate(each) for each in (*columns, widened)))


def save_glb(path: Path, rows: Rows, antialiased: bool = False) -> None:
    """Write rows as a .glb file, and create its folder.

    Positions are floats. Where rounding would move one by more than 1e-5 of the extent, they are relative to a node.

    Args:
        rows: in the frame of a .ply (y down); they are rotated by 180 degrees about z for the file.
        antialiased: True if the splats are to be rendered with Mip-Splatting's 2D filter, which only we read.

    Raises:
        BadInput: the file would be larger than 4 GiB.
    """
    turned, node = rotate_rows(rows, Y_UP), dict[str, Any](mesh=0)
    means, sh = turned.means, turned.sh
    if np.abs(means - means.astype(np.float32)).max(initial=0) > 1e-5 * np.ptp(means, axis=0).max():
        center = np.round((means.min(0) + means.max(0)) / 2)
        means, node = means - center, node | {"translation": center.tolist()}
    opacities = 1 / (1 + np.exp(-rows.opacity_logits.astype(np.float64)))
    colors = np.clip(np.round(255 * np.column_stack([0.5 + SH0 * sh[:, 0], opacities])), 0, 255)
    columns: dict[str, np.ndarray] = {
        "POSITION": means.astype("<f4"),
        "COLOR_0": colors.astype("u1"),  # what viewers without the extension show
        f"{EXTENSION}:ROTATION": turned.unit_quaternions[:, [1, 2, 3, 0]].astype("<f4"),
        f"{EXTENSION}:SCALE": np.exp(rows.log_scales).astype("<f4"),
        f"{EXTENSION}:OPACITY": opacities[:, None].astype("<f4"),
        **{name: sh[:, k].astype("<f4") for k, name in enumerate(_harmonic_names(sh.shape[1]))},
    }
    accessors, views, at = [], [], 0
    for name, values in columns.items():
        bounds = (
            {"min": values.min(0).tolist(), "max": values.max(0).tolist()} if name == "POSITION" and len(rows) else {}
        )
        kind = next(code for code, each in TYPES.items() if each == values.dtype)
        shape = next(word for word, width in WIDTHS.items() if width == values.shape[1])
        accessor = {"bufferView": len(views), "componentType": kind, "count": len(rows), "type": shape, **bounds}
        accessors.append(accessor | ({"normalized": True} if kind == 5121 else {}))
        views.append({"buffer": 0, "byteOffset": at, "byteLength": values.nbytes, "target": 34962})  # ARRAY_BUFFER
        at += values.nbytes
    if at + 2**20 > LARGEST:
        raise BadInput(f"{path}: {at} bytes are more than a .glb can hold; write a .ply")
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "sortingMethod": "cameraDistance"}
    primitive: dict[str, Any] = {
        "mode": POINTS,
        "attributes": {name: k for k, name in enumerate(columns)},
        "extensions": {EXTENSION: kernel | {"projection": "perspective"}},
        **({"extras": MIP} if antialiased else {}),
    }
    document = {
        "asset": {"version": "2.0", "generator": "reffusion"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": at}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with open(path, "wb") as file:
        file.write(HEADER.pack(b"glTF", 2, HEADER.size + 2 * CHUNK.size + len(text) + at))
        file.write(CHUNK.pack(len(text), b"JSON") + text + CHUNK.pack(at, b"BIN\0"))
        for values in columns.values():
            file.write(np.ascontiguousarray(values).data)


def _harmonic_names(count: int) -> Iterator[str]:
    """Yield the attributes of the first `count` spherical harmonics."""
    for k in range(count):
        degree = int(k**0.5)
        yield f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree * degree}"


def _check_kind(path: Path, primitive: dict[str, Any]) -> None:
    """Raise BadInput unless a primitive holds plain splats of the extension."""
    kernel, attributes = primitive["extensions"][EXTENSION], primitive.get("attributes", {})
    if compressed := next(iter(kernel.get("extensions", {})), None):
        raise BadInput(f"{path}: splats compressed by {compressed}; save it without compression, or as .spz")
    if kernel.get("kernel", "ellipse") != "ellipse":
        raise BadInput(f"{path}: splats of the kernel '{kernel['kernel']}'; only the ellipse of 3DGS is read")
    if kernel.get("colorSpace", "srgb_rec709_display") != "srgb_rec709_display":
        raise BadInput(f"{path}: colors in the space '{kernel['colorSpace']}'; save it in srgb_rec709_display")
    needed = ("POSITION", *(f"{EXTENSION}:{each}" for each in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0")))
    if missing := [name for name in needed if name not in attributes]:
        raise BadInput(f"{path}: its splats lack {', '.join(missing)}: a draft of the extension; save it again")


def _node_matrix(node: dict[str, Any]) -> np.ndarray:
    """Return the transform [4, 4] of a node to its parent."""
    from reffusion.io.rotations import quaternion_to_pose

    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    scales = np.diag([*node.get("scale", (1, 1, 1)), 1.0])
    return quaternion_to_pose([w, x, y, z], node.get("translation", (0, 0, 0))) @ scales


def _load_primitive(glb: Glb, primitive: dict[str, Any], placed: np.ndarray) -> Rows:
    """Read the splats of a primitive, and place them in the frame of a .ply."""
    read = lambda name: glb.values(primitive, f"{EXTENSION}:{name}")
    count = sum(name.startswith(f"{EXTENSION}:SH_DEGREE_") for name in primitive["attributes"])
    if count not in (1, 4, 9, 16):
        raise BadInput(f"{glb.path}: {count} spherical harmonics; 1, 4, 9 or 16 belong to degrees 0 to 3")
    sh = np.stack([glb.values(primitive, name) for name in _harmonic_names(count)], axis=1)
    scale = np.cbrt(np.linalg.det(placed[:3, :3]))
    rotation = placed[:3, :3] / (scale or 1.0)
    if scale <= 0 or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
        raise BadInput(f"{glb.path}: a node mirrors or stretches its splats; apply its transform in the editor")
    means = scale * glb.values(primitive, "POSITION").astype(np.float64) + placed[:3, 3] @ rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        opacities = read("OPACITY")[:, 0].astype(np.float64)
        logits, scales = np.log(opacities) - np.log1p(-opacities), np.log(read("SCALE")) + np.float32(np.log(scale))
    rows = Rows(means, read("ROTATION")[:, [3, 0, 1, 2]], scales, logits.astype(np.float32), sh)
    return rotate_rows(rows, Y_UP @ rotation)

"""Kernels that work on Gaussians: footprints and colors, and the gradients of parameters from sums over pixels.

A *footprint* is a Gaussian projected into the image (columns: see `layout`). Kernels process groups of LANES
consecutive Gaussians; `row` is the first Gaussian of a group.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from reffusion.kernels.compiled import inlined, kernel
from reffusion.kernels.memory import (
    load,
    load_column,
    load_columns,
    load_mask,
    store,
    store_column,
    store_columns,
    store_whole,
)
from reffusion.kernels.vectors import LANES, any_lane, maximum, minimum, narrow, select, splat, take_ticket, widen
from reffusion.splat import harmonics, projection
from reffusion.splat.binning import ellipse
from reffusion.splat.layout import (
    ANCHOR_U,
    ANCHOR_V,
    ANCHOR_X,
    ANCHOR_Y,
    BLUE,
    CHUNKS,
    COLUMN,
    DEPTH,
    FOOTPRINT,
    GRAD_BLUE,
    GRAD_FEATURES,
    GRAD_GREEN,
    GRAD_RED,
    GREEN,
    HALF_HEIGHT,
    HALF_WIDTH,
    LEVEL,
    RED,
    SLANT,
    TILT,
    WHITEN_X,
    WHITEN_Y,
)


class Parameters(NamedTuple):
    """Parameters of N Gaussians as flat arrays, and the format of their colors.

    Attributes:
        means, ..., sh: flat float32 arrays, in the order of `types.PARAMETERS`.
        width: numbers per Gaussian in `sh`, 3 for each spherical harmonic.
        degree: degree of the spherical harmonics used, which may be lower than the stored one.
    """

    means: np.ndarray
    quaternions: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    width: int
    degree: int


class Gradients(NamedTuple):
    """Gradients of the parameters, each [padded(N), columns] flat.

    Attributes:
        means, ..., sh: gradients, in the order of `types.PARAMETERS`.
        features: [padded(N), C], not flat.
        probe: [padded(N), 2] flat, gradient of the 2D means, or empty if it is not needed.
    """

    means: np.ndarray
    quaternions: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    features: np.ndarray
    probe: np.ndarray


class ScratchArrays(NamedTuple):
    """Temporary arrays for a group of LANES Gaussians, flat float32 arrays.

    Attributes:
        basis: [16, LANES], the spherical harmonics Y_k.
        along: [16, LANES], dLoss/dY_k.
        coefficients: [width, LANES], the coefficients sh_k, which are later overwritten by dLoss/dsh_k.
        sums: [LANES, columns], the sums of each Gaussian's records.
        moments: [columns, LANES], `sums` transposed.
    """

    basis: np.ndarray
    along: np.ndarray
    coefficients: np.ndarray
    sums: np.ndarray
    moments: np.ndarray


def padded(count: int) -> int:
    """Return `count` rounded up to a multiple of LANES, because kernels write LANES rows of an array at a time."""
    return -(-count // LANES) * LANES


@kernel
def next_chunk(tickets, count):
    """Return the start and the end of the next of CHUNKS parts of range(count), or (-1, -1) if all are taken."""
    ticket = take_ticket(tickets)
    if ticket >= CHUNKS:
        return -1, -1
    return ticket * count // CHUNKS, (ticket + 1) * count // CHUNKS


@kernel
def project_gaussians(tickets, parameters, probe, view, center, footprints, radii):
    """Compute the footprints of all Gaussians.

    Groups of LANES Gaussians none of which reaches the image are skipped; nothing is written for them.

    Args:
        parameters: `Parameters`.
        probe: [N, 2] flat, added to the 2D means, or empty.
        view: see `projection.view_numbers`.
        center: [3], the camera center.
        footprints: [padded(N), FOOTPRINT] float32 flat, output.
        radii: [padded(N)] int32 zeros, output, the radii in pixels of the Gaussians that reach the image.
    """
    basis, columns = np.zeros(16 * LANES, np.float32), np.zeros(FOOTPRINT * LANES, np.float32)
    coefficients = np.zeros(parameters.width * LANES, np.float32)
    last = parameters.opacity_logits.shape[0] - 1
    while True:
        begin, end = next_chunk(tickets, radii.shape[0] // LANES)
        if begin < 0:
            return
        for row in range(begin * LANES, end * LANES, LANES):
            mean = projection.three_columns(parameters.means, row, last)
            is_visible, mean_x, mean_y, slant, whiten_x, whiten_y, level, z, reach_x, reach_y = projection.project(
                view, mean, parameters.quaternions, parameters.log_scales, parameters.opacity_logits, row, last
            )
            if probe.shape[0] > 0:
                mean_x = mean_x + widen(load_column(probe, 2, 0, row, last))
                mean_y = mean_y + widen(load_column(probe, 2, 1, row, last))
            is_visible = is_visible & projection.in_image(view, mean_x, mean_y, reach_x, reach_y)
            if not any_lane(is_visible):
                continue
            radius = minimum(maximum(maximum(reach_x, reach_y), 1.0), 1073741824.0)
            store_whole(radii, row, select(is_visible, radius, 0.0))
            dx, dy, dz, _ = harmonics.direction(mean, center)
            harmonics.fill_basis(parameters.degree, dx, dy, dz, basis)
            _read_rows(parameters.sh, parameters.width, row, last, coefficients)
            colors = harmonics.colors(parameters.degree, basis, coefficients)
            anchor = projection.anchor(view, mean_x, mean_y, slant, whiten_x, whiten_y)
            _fill_footprint(columns, anchor, (slant, whiten_x, whiten_y, level), z, colors)
            _write_rows(footprints, FOOTPRINT, row, columns)


@inlined
def _fill_footprint(columns, anchor, ellipse_numbers, z, colors):
    """Write the columns of LANES footprints (see `layout`) into `columns` [FOOTPRINT, LANES] flat."""
    slant, whiten_x, whiten_y, level = ellipse_numbers
    shape = narrow(slant), narrow(whiten_x), narrow(whiten_y), narrow(level)
    half_width, half_height, tilt, column_height = ellipse(shape[0], shape[1], shape[2], shape[3])
    # `anchor` is x and y of the anchors, and u and v there (`projection.anchor`).
    store(columns, ANCHOR_X * LANES, narrow(anchor[0]))
    store(columns, ANCHOR_Y * LANES, narrow(anchor[1]))
    store(columns, ANCHOR_U * LANES, narrow(anchor[2]))
    store(columns, ANCHOR_V * LANES, narrow(anchor[3]))
    store(columns, SLANT * LANES, shape[0])
    store(columns, WHITEN_X * LANES, shape[1])
    store(columns, WHITEN_Y * LANES, shape[2])
    store(columns, LEVEL * LANES, shape[3])
    store(columns, DEPTH * LANES, narrow(z))
    store(columns, HALF_WIDTH * LANES, half_width)
    store(columns, HALF_HEIGHT * LANES, half_height)
    store(columns, TILT * LANES, tilt)
    store(columns, COLUMN * LANES, column_height)
    store(columns, RED * LANES, colors[0])
    store(columns, GREEN * LANES, colors[1])
    store(columns, BLUE * LANES, colors[2])


@kernel
def _read_rows(array, width, row, last, columns):
    """Copy LANES rows of a flat array [R, width], from `row` on, transposed into flat `columns` [width, LANES]."""
    # Rows after the row `last` are replaced by it.
    if width < LANES:
        for column in range(width):
            store(columns, column * LANES, load_column(array, width, column, row, last))
        return
    for start in range(0, width, LANES):
        column = min(start, width - LANES)
        load_columns(array, width, column, row, last, columns, column * LANES)


@kernel
def _write_rows(array, width, row, columns):
    """Write LANES rows of an array from `columns`, the inverse of `_read_rows`; the array must have all these rows."""
    if width < LANES:
        for column in range(width):
            store_column(array, width, column, row, load(columns, column * LANES))
        return
    for start in range(0, width, LANES):
        column = min(start, width - LANES)
        store_columns(array, width, column, row, columns, column * LANES)


@kernel
def add_records(records, written, first_slots, columns, row, sums):
    """Sum the records of each of LANES Gaussians, in the order of the records, into sums [LANES, columns] (flat).

    Args:
        records: [I * columns].
        written: [I] bool, True for the valid records; all other records are left out.
        first_slots: [N + 1], index of each Gaussian's first record.
        row: the first of the Gaussians; Gaussians from N on have no records.
    """
    for lane in range(LANES):
        begin, end = 0, 0
        if row + lane < first_slots.shape[0] - 1:
            begin, end = first_slots[row + lane], first_slots[row + lane + 1]
        # A cache line holds 16 floats: two vectors of 8 lanes, or one of 16 lanes, which is then computed twice.
        for part in range(0, columns, 16):
            other = part + 16 - LANES
            value = other_value = splat(0.0)
            for slot in range(begin, end):
                if written[slot]:
                    value = value + load(records, slot * columns + part)
                    other_value = other_value + load(records, slot * columns + other)
            store(sums, lane * columns + part, value)
            store(sums, lane * columns + other, other_value)


@kernel
def add_all_records(tickets, records, written, first_slots, gathered):
    """Sum the first C columns of each Gaussian's records, and write the sums into gathered [padded(N), C].

    Args:
        records: [I, columns].
        written, first_slots: as for `add_records`.
    """
    columns, channels = records.shape[1], gathered.shape[1]
    sums, flat = np.empty(LANES * columns, np.float32), records.reshape(-1)
    while True:
        begin, end = next_chunk(tickets, gathered.shape[0] // LANES)
        if begin < 0:
            return
        for row in range(begin * LANES, end * LANES, LANES):
            add_records(flat, written, first_slots, columns, row, sums)
            for lane in range(LANES):
                for c in range(channels):
                    gathered[row + lane, c] = sums[lane * columns + c]


@kernel
def project_gaussians_backward(
    tickets, records, written, first_slots, columns, radii, footprints, parameters, view, center, gradients
):
    """Compute the gradients of all parameters from the gradient records of each footprint.

    Args:
        records: [I * columns], from `backward.blend_backward`.
        written, first_slots: as for `add_records`.
        columns: number of columns of a record.
        radii, footprints: from `project_gaussians`.
        parameters, view, center: as for `project_gaussians`.
        gradients: `Gradients`, output.
    """
    workspace = ScratchArrays(
        np.zeros(16 * LANES, np.float32),
        np.zeros(16 * LANES, np.float32),
        np.zeros(parameters.width * LANES, np.float32),
        np.zeros(LANES * columns, np.float32),
        np.zeros(columns * LANES, np.float32),
    )
    while True:
        begin, end = next_chunk(tickets, radii.shape[0] // LANES)
        if begin < 0:
            return
        for row in range(begin * LANES, end * LANES, LANES):
            add_records(records, written, first_slots, columns, row, workspace.sums)
            for lane in range(LANES):
                for c in range(gradients.features.shape[1]):
                    gradients.features[row + lane, c] = workspace.sums[lane * columns + GRAD_FEATURES + c]
            is_visible = load_mask(radii, row)
            if any_lane(is_visible):
                _read_rows(workspace.sums, columns, 0, LANES - 1, workspace.moments)
                _rows_backward(row, is_visible, footprints, parameters, view, center, workspace, gradients)
            else:
                _clear_rows(row, parameters.width, gradients)


@inlined
def _rows_backward(row, is_visible, footprints, parameters, view, center, workspace, gradients):
    """Write the gradients of LANES Gaussians, except those of features, from the sums in `workspace.moments`."""
    last = parameters.opacity_logits.shape[0] - 1
    mean = projection.three_columns(parameters.means, row, last)
    _read_rows(parameters.sh, parameters.width, row, last, workspace.coefficients)
    # Gradient of the mean through the viewing direction of the colors.
    x, y, z = _colors_backward(parameters.degree, mean, center, is_visible, footprints, row, workspace)
    _write_rows(gradients.sh, parameters.width, row, workspace.coefficients)
    to_mean, to_quaternion, to_scales, to_logit, to_probe = projection.project_backward(
        view,
        mean,
        parameters.quaternions,
        parameters.log_scales,
        parameters.opacity_logits,
        row,
        last,
        workspace.moments,
    )
    means = narrow(to_mean[0]) + x, narrow(to_mean[1]) + y, narrow(to_mean[2]) + z
    w, i, j, k = to_quaternion
    _store_three(gradients.means, 3, row, is_visible, means[0], means[1], means[2])
    _store_three(gradients.quaternions, 4, row, is_visible, narrow(w), narrow(i), narrow(j))
    _store_one(gradients.quaternions, 4, 3, row, is_visible, narrow(k))
    _store_three(
        gradients.log_scales, 3, row, is_visible, narrow(to_scales[0]), narrow(to_scales[1]), narrow(to_scales[2])
    )
    _store_one(gradients.opacity_logits, 1, 0, row, is_visible, narrow(to_logit))
    if gradients.probe.shape[0] > 0:
        _store_one(gradients.probe, 2, 0, row, is_visible, narrow(to_probe[0]))
        _store_one(gradients.probe, 2, 1, row, is_visible, narrow(to_probe[1]))


@inlined
def _clear_rows(row, width, gradients):
    """Set the gradients of LANES Gaussians, none of which is visible, to 0, except those of features."""
    _store_zeros(gradients.probe, 2 if gradients.probe.shape[0] > 0 else 0, row)
    _store_zeros(gradients.means, 3, row)
    _store_zeros(gradients.quaternions, 4, row)
    _store_zeros(gradients.log_scales, 3, row)
    _store_zeros(gradients.opacity_logits, 1, row)
    _store_zeros(gradients.sh, width, row)


@inlined
def _colors_backward(degree, mean, center, is_visible, footprints, row, workspace):
    """Return the gradient of the means through the colors; write that of the coefficients over the coefficients."""
    x, y, z, inverse = harmonics.direction(mean, center)
    zero, used = splat(0.0), 3 * (degree + 1) * (degree + 1)
    x, y, z = select(is_visible, x, zero), select(is_visible, y, zero), select(is_visible, z, zero)
    harmonics.fill_basis(degree, x, y, z, workspace.basis)
    red = _color_gradient(workspace.moments, GRAD_RED, footprints, RED, is_visible, row)
    green = _color_gradient(workspace.moments, GRAD_GREEN, footprints, GREEN, is_visible, row)
    blue = _color_gradient(workspace.moments, GRAD_BLUE, footprints, BLUE, is_visible, row)
    # The gradients of the coefficients replace the coefficients in `workspace`.
    harmonics.colors_backward(degree, workspace.basis, workspace.coefficients, red, green, blue, workspace.along)
    workspace.coefficients[used * LANES :] = np.float32(0.0)
    # Return the gradient of the means, through the viewing directions, as three vectors.
    return harmonics.direction_backward(degree, x, y, z, inverse, workspace.along)


@inlined
def _store_one(array, width, column, row, is_visible, value):
    """Write a vector to one column of LANES rows, with 0 for Gaussians that are not visible."""
    store_column(array, width, column, row, select(is_visible, value, splat(0.0)))


@inlined
def _store_three(array, width, row, is_visible, first, second, third):
    """Write three vectors to the first three columns of LANES rows, with 0 for Gaussians that are not visible."""
    _store_one(array, width, 0, row, is_visible, first)
    _store_one(array, width, 1, row, is_visible, second)
    _store_one(array, width, 2, row, is_visible, third)


@inlined
def _store_zeros(array, width, row):
    """Set LANES rows, from `row` on, of an array [R, width] (flat) to 0."""
    for at in range(row * width, (row + LANES) * width, LANES):
        store(array, at, splat(0.0))


@inlined
def _color_gradient(moments, column, footprints, color, is_visible, row):
    """Return the gradient of a color channel; 0 where the color is clamped at 0 and for invisible Gaussians."""
    # `color` is a column of a footprint, and `column` one of a record.
    free = is_visible & (load_column(footprints, FOOTPRINT, color, row, row + LANES - 1) > 0.0)
    return select(free, load(moments, column * LANES), splat(0.0))

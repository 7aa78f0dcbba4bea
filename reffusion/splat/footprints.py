"""Work per Gaussian: footprints and colours, and gradients of the parameters from sums over pixels."""

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
    """Parameters of N Gaussians as flat arrays, and the format of their colours.

    Attributes:
        means, ..., sh: float32, in the order of `types.PARAMETERS`.
        width: numbers in a row of sh.
        degree: of the spherical harmonics used.
    """

    means: np.ndarray
    quaternions: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    width: int
    degree: int


class Gradients(NamedTuple):
    """Gradients of the parameters, [padded(N), columns] flat.

    Attributes:
        features: [padded(N), C], not flat.
        probe: of the offset of the 2D means, or empty.
    """

    means: np.ndarray
    quaternions: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    sh: np.ndarray
    features: np.ndarray
    probe: np.ndarray


class ScratchArrays(NamedTuple):
    """Temporary arrays, LANES numbers per column.

    The basis of the harmonics and its gradient, a row of sh, and the sums over a footprint's pixels by Gaussian and by
    column.
    """

    basis: np.ndarray
    along: np.ndarray
    coefficients: np.ndarray
    sums: np.ndarray
    moments: np.ndarray


def padded(count: int) -> int:
    """Number of rows of an array that kernels write LANES rows at a time."""
    return -(-count // LANES) * LANES


@kernel
def next_chunk(tickets, count):
    """Bounds of the next of CHUNKS parts of range(count), or (-1, -1) when all are taken."""
    ticket = take_ticket(tickets)
    if ticket >= CHUNKS:
        return -1, -1
    return ticket * count // CHUNKS, (ticket + 1) * count // CHUNKS


@kernel
def project_gaussians(tickets, parameters, probe, view, center, footprints, radii):
    """Compute the footprints of all Gaussians.

    Args:
        parameters: `Parameters`.
        probe: added to the 2D means, flat, or empty.
        view: see `projection.view_numbers`.
        center: of the camera.
        footprints: [padded(N), FOOTPRINT] float32 flat, output for groups with a Gaussian that reaches the image.
        radii: [padded(N)] int32 zeros, output for the same groups.
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
    """Write the columns of LANES footprints, see `layout`."""
    slant, whiten_x, whiten_y, level = ellipse_numbers
    shape = narrow(slant), narrow(whiten_x), narrow(whiten_y), narrow(level)
    half_width, half_height, tilt, column_height = ellipse(shape[0], shape[1], shape[2], shape[3])
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
    """Copy LANES rows of an array [R, width] (flat) into `columns`, LANES values per column; `last` is the last row."""
    if width < LANES:
        for column in range(width):
            store(columns, column * LANES, load_column(array, width, column, row, last))
        return
    for start in range(0, width, LANES):
        column = min(start, width - LANES)
        load_columns(array, width, column, row, last, columns, column * LANES)


@kernel
def _write_rows(array, width, row, columns):
    """The inverse of `_read_rows`; the array has all of these rows."""
    if width < LANES:
        for column in range(width):
            store_column(array, width, column, row, load(columns, column * LANES))
        return
    for start in range(0, width, LANES):
        column = min(start, width - LANES)
        store_columns(array, width, column, row, columns, column * LANES)


@kernel
def add_records(records, written, first_slots, columns, row, sums):
    """Sum the records of LANES Gaussians into sums [LANES, columns], in their order."""
    for lane in range(LANES):
        begin, end = 0, 0
        if row + lane < first_slots.shape[0] - 1:
            begin, end = first_slots[row + lane], first_slots[row + lane + 1]
        for part in range(0, columns, 16):  # a cache line, in two vectors or (twice the same) one
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
    """Write the sums of the first columns of all Gaussians' records into gathered [padded(N), C]."""
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
    """Compute the gradients of all parameters from the records of each footprint.

    Args:
        records, written, first_slots: see `backward.blend_backward`.
        columns: of a record.
        radii, footprints: from `project_gaussians`.
        parameters: `Parameters`.
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
    """Write LANES rows of all gradients except those of features, from `workspace.moments`."""
    last = parameters.opacity_logits.shape[0] - 1
    mean = projection.three_columns(parameters.means, row, last)
    _read_rows(parameters.sh, parameters.width, row, last, workspace.coefficients)
    # Gradient of the mean through the viewing direction of the colours.
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
    """Clear LANES rows without a visible Gaussian."""
    _store_zeros(gradients.probe, 2 if gradients.probe.shape[0] > 0 else 0, row)
    _store_zeros(gradients.means, 3, row)
    _store_zeros(gradients.quaternions, 4, row)
    _store_zeros(gradients.log_scales, 3, row)
    _store_zeros(gradients.opacity_logits, 1, row)
    _store_zeros(gradients.sh, width, row)


@inlined
def _colors_backward(degree, mean, center, is_visible, footprints, row, workspace):
    """Replace the coefficients by their gradients, and return the gradient of the mean, from those of the colours."""
    x, y, z, inverse = harmonics.direction(mean, center)
    zero, used = splat(0.0), 3 * (degree + 1) * (degree + 1)
    x, y, z = select(is_visible, x, zero), select(is_visible, y, zero), select(is_visible, z, zero)
    harmonics.fill_basis(degree, x, y, z, workspace.basis)
    red = _color_gradient(workspace.moments, GRAD_RED, footprints, RED, is_visible, row)
    green = _color_gradient(workspace.moments, GRAD_GREEN, footprints, GREEN, is_visible, row)
    blue = _color_gradient(workspace.moments, GRAD_BLUE, footprints, BLUE, is_visible, row)
    harmonics.colors_backward(degree, workspace.basis, workspace.coefficients, red, green, blue, workspace.along)
    workspace.coefficients[used * LANES :] = np.float32(0.0)
    return harmonics.direction_backward(degree, x, y, z, inverse, workspace.along)


@inlined
def _store_one(array, width, column, row, is_visible, value):
    """Write a column of LANES rows; 0 for Gaussians that are not visible."""
    store_column(array, width, column, row, select(is_visible, value, splat(0.0)))


@inlined
def _store_three(array, width, row, is_visible, first, second, third):
    """Write the first three columns in the same way."""
    _store_one(array, width, 0, row, is_visible, first)
    _store_one(array, width, 1, row, is_visible, second)
    _store_one(array, width, 2, row, is_visible, third)


@inlined
def _store_zeros(array, width, row):
    """Clear LANES rows."""
    for at in range(row * width, (row + LANES) * width, LANES):
        store(array, at, splat(0.0))


@inlined
def _color_gradient(moments, column, footprints, color, is_visible, row):
    """Gradient of a colour; 0 where it is clamped at 0."""
    free = is_visible & (load_column(footprints, FOOTPRINT, color, row, row + LANES - 1) > 0.0)
    return select(free, load(moments, column * LANES), splat(0.0))

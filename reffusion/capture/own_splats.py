"""Gaussians that a scene brings, and what a user did to them in a splat editor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from reffusion.capture.scene_folder import check_gaussian_files
from reffusion.gaussians import matching
from reffusion.gaussians.movement import Cloud, Movement
from reffusion.io.files import BadInput
from reffusion.io.ply import load_property_names
from reffusion.io.splat_rows import Rows, rotate_rows
from reffusion.io.splats import Splats, load_splats
from reffusion.params.poses import Params
from reffusion.splat.conventions import SH0


@dataclass(frozen=True)
class Edit:
    """What a user did to the N Gaussians of a scene in an editor.

    Attributes:
        deleted: bool [N], True for Gaussians that are missing in the cleaned file (named by the parameter `cleaned`),
            except the cropped ones.
        scattered: bool [N], True for deleted Gaussians that leave no hole to fill: they stood alone among Gaussians
            that stay, or were filtered by opacity.
        cropped: bool [N], True for Gaussians that were deleted around what stays.
        movement: takes the scene to the place that it has in the cleaned file.
        added: Gaussians that only the cleaned file has, in the scene's own frame; None without any.
    """

    deleted: np.ndarray
    scattered: np.ndarray
    cropped: np.ndarray
    movement: Movement
    added: Rows | None


@dataclass(frozen=True)
class OwnSplats:
    """The N Gaussians that a scene brings.

    Attributes:
        splats: the Gaussians in the scene's own frame.
        properties: names of the properties of the .ply, in order; empty for other formats.
        edit: what the user did to them; None if the scene has no file that says so.
        notes: sentences about both files, for the user.
    """

    splats: Splats
    properties: tuple[str, ...]
    edit: Edit | None
    notes: tuple[str, ...]


def load_own_splats(params: Params, scene: Path) -> OwnSplats | None:
    """Load the Gaussians that a scene brings, and find and print what was done to them; return None without any.

    Raises:
        BadInput: a file is unusable, or what was done leaves no hole.
    """
    check_gaussian_files(params, scene)
    if params.gaussians is None:
        return None
    path = scene / params.gaussians
    splats, edit = load_splats(path), None
    notes = [f"{path.name}: {note}" for note in splats.notes]
    if params.cleaned is not None:
        cleaned = load_splats(scene / params.cleaned)
        notes += [f"{params.cleaned}: {note}" for note in cleaned.notes]
        edit = _find_edit((path, scene / params.cleaned), splats.rows, cleaned.rows)
    return OwnSplats(splats, load_property_names(path), edit, tuple(notes))


def _describe_looks(rows: Rows) -> Cloud:
    """Return the means, log-scales, colors and opacities by which Gaussians are recognized."""
    opacities = 1 / (1 + np.exp(-rows.opacity_logits.astype(np.float64)))
    return Cloud(rows.means, rows.log_scales, 0.5 + SH0 * rows.sh[:, 0], opacities)


def _find_edit(files: tuple[Path, Path], whole: Rows, cleaned: Rows) -> Edit:
    """Find and print what was done to the Gaussians `whole`; raises BadInput if it is unclear or leaves no hole."""
    cloud = _describe_looks(whole)
    match = matching.match_gaussians(cloud, _describe_looks(cleaned))
    if match.movement is None:
        raise BadInput(
            f"{files[1]}: of its splats {match.found:.0%} are where {files[0].name} has one, and too few look like "
            "one: it is another scene, or was decimated, recolored or stretched; only delete, crop, move, turn, scale"
        )
    if match.movement.mirrors:
        raise BadInput(f"{files[1]}: it is {files[0].name} mirrored; save it again without mirroring")
    if not match.deleted.any():
        raise BadInput(f"{files[1]}: nothing was deleted: all splats of {files[0].name} are there")
    filtered = matching.find_filtered(cloud.opacities, match.deleted)
    regions = matching.find_regions(whole.means, match.deleted & ~filtered)
    cropped = matching.find_cropped(whole.means, match.deleted, regions)
    scattered = match.deleted & ((regions < 0) | filtered)
    deleted = match.deleted & ~cropped
    count, alone, around = (int(np.count_nonzero(each)) for each in (match.deleted, scattered, cropped))
    crop = f", {around} of them around what stays: cropped, and not filled" if around else ""
    if alone + around == count:
        raise BadInput(
            f"{files[1]}: {alone} scattered splats were deleted{crop}; no region to fill: each stood among splats that "
            f"stay. Delete a whole object, or use {files[1].name} as it is"
        )
    dust = f", {alone} of them scattered: they leave no region to fill" if alone else ""
    moved = "" if match.movement.is_still else f", and it was {match.movement.describe()}"
    new = np.flatnonzero(match.places < 0)
    more = f", and {len(new)} of its splats are new: they stay" if len(new) else ""
    print(f"{files[1].name}: {count} of {len(whole)} splats were deleted{dust}{crop}{moved}{more}", flush=True)
    if not len(new):
        return Edit(deleted, scattered, cropped, match.movement, None)
    turned = rotate_rows(cleaned.take(new), match.movement.rotation.T)
    sizes = turned.log_scales - np.float32(np.log(match.movement.scale))
    added = replace(turned, means=match.movement.invert(cleaned.means[new]), log_scales=sizes)
    return Edit(deleted, scattered, cropped, match.movement, added)

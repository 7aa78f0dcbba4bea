"""A scene folder read as the parameters of `poses` say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from reffusion.capture.layouts.capture import Capture, pictures_in
from reffusion.capture.clicked import check_clicks
from reffusion.capture.lens import without_distortion
from reffusion.capture.load import load_capture
from reffusion.capture.roles import Roles, load_roles, masks_of
from reffusion.capture.views import known
from reffusion.io.files import BadInput, there
from reffusion.io.ply import check_gaussians
from reffusion.params.poses import Params


def read_scene(params: Params, scene: Path) -> tuple[Capture, Roles]:
    """The capture and its views' roles; BadInput naming the file and the remedy where one is wrong."""
    capture = load_capture(scene, params.layout, params.images, params.longest)
    roles = load_roles(
        scene,
        capture,
        masks=params.masks,
        test_masks=params.test_masks,
        train=params.train,
        test=params.test,
        clean=params.clean,
        region=params.region is not None or params.fill is not None or params.clicks is not None,
        cameras_only=params.cameras_only,
        remove=params.remove,
    )
    if params.fill is not None:
        roles = replace(roles, fill=_to_fill(scene / params.fill, capture, roles))
    if params.region is not None and params.region.view is not None:
        known(params.region.view, {*roles.train, *roles.test}, "region")
    if params.clicks:
        check_clicks(params.clicks, capture, roles)
    if params.gaussians is not None:
        if not there(scene / params.gaussians):
            raise BadInput(f"{scene / params.gaussians}: no such file; correct `gaussians` in scene.yaml")
        check_gaussians(scene / params.gaussians)
    _check_lenses(capture)
    return capture, roles


def _to_fill(folder: Path, capture: Capture, roles: Roles) -> dict[str, Path]:
    """Training view -> mask of what is to be filled; BadInput where one has none."""
    files = masks_of(pictures_in(folder) if folder.is_dir() else {}, capture)
    if lacking := [name for name in roles.train if name not in {*files, *roles.clean}]:
        raise BadInput(
            f"{folder}: no mask for {len(lacking)} of {len(roles.train)} training views, '{lacking[0]}' for one; each "
            "needs one of what is to be filled, an empty one where it does not show that place"
        )
    return {name: files[name] for name in roles.train if name in files}


def _check_lenses(capture: Capture) -> None:
    """BadInput for a lens whose distortion cannot be undone."""
    lenses = capture.poses.lenses.items() if capture.poses else ()
    of = {lens: name for name, lens in lenses if replace(lens.pinhole, model=lens.model) != lens}
    for lens, name in of.items():
        try:
            without_distortion(lens)
        except BadInput as error:
            raise BadInput(f"{capture.brought_by}: view '{name}': {error}") from None

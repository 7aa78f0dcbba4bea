"""The prediction from the error of the renders beside the hole whether SDS can improve the initialization."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scenes.settings import with_changes
from scenes.wall_scene import CAMERAS, TRAIN, true_mask, wall_and_square

from reffusion.distill.inputs import resolve_sds
from reffusion.initialize.draft import Draft
from reffusion.initialize.origins import find_origins
from reffusion.initialize.sds_gain import HOLE_LOSS, MAX_VIEWS, PRIOR_PSNR, predict_gain
from reffusion.io.arrays import save_json
from reffusion.params import initialize
from reffusion.params.distill import Params
from reffusion.splat import rasterizer
from reffusion.types import MaskSet, Reference
from stages.initialize import summarize
from stages.plan import distill as plan

AT, TRAINED = 0.8, [CAMERAS[name] for name in TRAIN]


@pytest.fixture(scope="module")
def wall_without_square():
    """Gaussians of the wall without the square, masks, and photographs that equal the renders of these Gaussians."""
    scene, labels = wall_and_square(AT)
    wall = scene.map(lambda p: p[~labels])
    hidden = {camera.name: true_mask(camera, AT) for camera in TRAINED}
    sets = {name: MaskSet(mask, mask, mask, mask) for name, mask in hidden.items()}
    render_color = lambda camera: rasterizer.render(wall, camera).color.clamp(0, 1)
    photos = {camera.name: (255 * render_color(camera)).round().to(torch.uint8).numpy() for camera in TRAINED}
    return wall, sets, photos


def test_renders_that_show_the_photographs_cannot_gain(wall_without_square):
    wall, sets, photos = wall_without_square
    found = predict_gain(wall, TRAINED, sets, photos)
    assert not found.may_gain and found.psnr_beside > 45 and f"{found.psnr_beside - HOLE_LOSS:.1f} dB" in found.reason


def test_a_view_that_was_completed_twice_counts_with_all_its_patched_pixels(wall_without_square):
    wall, sets, photos = wall_without_square
    camera, mask = TRAINED[0], sets[TRAINED[0].name].consistent
    rows, columns = np.nonzero(mask)
    first, second = np.zeros_like(mask), np.zeros_like(mask)
    first[rows[::2], columns[::2]], second[rows[::20], columns[::20]] = True, True
    extra = [Reference(camera, photos[camera.name], each) for each in (first, second)]
    scene = SimpleNamespace(train=TRAIN, cameras=CAMERAS)
    space = SimpleNamespace(scene=scene, labels=torch.zeros(1, dtype=torch.bool))
    draft = Draft.start(wall)
    origins = {name: find_origins(draft, CAMERAS[name], sets[name]) for name in TRAIN}
    facts = summarize(initialize.Params(), space, draft, 0, sets, origins, extra, extra, photos)
    assert facts["extra_views"] == {camera.name: pytest.approx(0.5, abs=0.01)}
    assert not facts["sds_may_gain"], "patches are better than what the prior paints"


def test_what_is_wrong_in_the_hole_or_far_from_it_does_not_count_and_beside_it_does(wall_without_square):
    wall, sets, photos = wall_without_square
    rows = np.arange(photos["a0"].shape[0])[:, None]
    in_hole = {name: np.where(sets[name].consistent[..., None], 0, image) for name, image in photos.items()}
    far = {name: np.where((rows < 8)[..., None], 0, image).astype(np.uint8) for name, image in photos.items()}
    assert (
        not predict_gain(wall, TRAINED, sets, in_hole).may_gain and not predict_gain(wall, TRAINED, sets, far).may_gain
    )
    brighter = {name: np.where(image > 215, 255, image + 40).astype(np.uint8) for name, image in photos.items()}
    found = predict_gain(wall, TRAINED, sets, brighter)
    assert found.may_gain and found.psnr_beside - HOLE_LOSS < PRIOR_PSNR


def test_beside_what_is_put_in_where_nothing_was_removed(wall_without_square):
    wall, sets, photos = wall_without_square
    put_in = {name: replace(each, consistent=np.zeros_like(each.invent)) for name, each in sets.items()}
    assert predict_gain(wall, TRAINED, put_in, photos) == predict_gain(wall, TRAINED, sets, photos)


def test_a_few_views_are_looked_at_and_without_any_it_may_gain(wall_without_square):
    wall, sets, photos = wall_without_square
    many = [replace(TRAINED[k % 5], name=f"v{k}") for k in range(3 * MAX_VIEWS)]
    repeated = {camera.name: TRAIN[k % 5] for k, camera in enumerate(many)}
    names = []

    class Photos(dict):
        def __getitem__(self, name):
            names.append(name)
            return photos[repeated[name]]

    predict_gain(wall, many, {n: sets[o] for n, o in repeated.items()}, Photos(repeated))
    assert len(names) == MAX_VIEWS and names[0] == "v0" and names[-1] == many[-1].name
    assert predict_gain(wall, TRAINED, sets, {}).may_gain and predict_gain(wall, TRAINED, sets, {}).psnr_beside is None


@pytest.mark.parametrize(
    ("run", "may", "weight"), [("always", False, 1), ("never", True, 0), ("auto", True, 1), ("auto", False, 0)]
)
def test_distillation_reads_what_the_initialization_says(tmp_path, run, may, weight):
    save_json(tmp_path / "facts.json", {"sds_may_gain": may, "sds_reason": "too good at 40.0 dB"})
    settings = with_changes(Params(), sds={"run": run, "weight": 1})
    params, reason = resolve_sds(settings, tmp_path)
    assert params == with_changes(settings, sds={"weight": weight})
    assert ("40.0 dB" in reason) == (run == "auto") and ("left out" in reason) == (weight == 0)


def test_a_prior_that_is_never_asked_need_not_be_there():
    nothing = with_changes(Params(), sds={"run": "never"}, depth={"weight": 0})
    assert plan.needed_weights(nothing, frozenset()) == []
    assert plan.needed_weights(with_changes(nothing, sds={"run": "auto"}), frozenset()) != []

"""The depth loss term: alignment of estimates, target depth, gradients, convergence, degenerate views, and resume."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes.cameras import make_camera
from scenes.distill_scene import as_leaves
from scenes.settings import with_changes
from scenes.stage_runs import trace_lines

from reffusion import trace
from reffusion.depth import background_depth, estimates
from reffusion.depth.background_depth import CompletionSettings
from reffusion.distill import depth_estimator
from reffusion.distill import loop as D
from reffusion.distill.depth_estimator import DepthEstimator, build_estimator
from reffusion.distill.terms import depth as depth_term
from reffusion.distill.terms.term import TermInputs
from reffusion.distill.train_view import ReferenceHole, TrainView
from reffusion.gaussians.optimize import GaussianOptimizer, Rates
from reffusion.gaussians.surfels import surface_gaussians
from reffusion.geometry import Degenerate
from reffusion.params.distill import DepthTerm, Params
from reffusion.prior import inpaint
from reffusion.seeding import generator
from reffusion.splat.rasterizer import render
from reffusion.trace import load_checkpoint
from reffusion.types import PARAMETERS, Gaussians

WIDTH, HEIGHT, FOCAL = 32, 24, 30.0
VIEW = make_camera("a", (WIDTH, HEIGHT), FOCAL)
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
WALL = 0.5 + 0.004 * (COLUMNS + 0.5 - WIDTH / 2) - 0.002 * (ROWS + 0.5 - HEIGHT / 2)  # disparity of a slanted wall
HOLE = (np.abs(COLUMNS + 0.5 - WIDTH / 2) < 7) & (np.abs(ROWS + 0.5 - HEIGHT / 2) < 6)
NO_POINTS = np.zeros((0, 3))
HOW = CompletionSettings(ring=0.2)
DEPTH = DepthTerm(steps=2)


def slanted_wall(moved: float = 1.0):
    """Return Gaussians on a slanted wall, and bool [N], True for the masked Gaussians in the middle of the wall.

    Args:
        moved: Factor on the depth of the masked Gaussians; at 1.0 they lie on the wall.
    """
    wide = make_camera("sheet", (52, 44), FOCAL)
    rows, columns = np.mgrid[:44, :52] + 0.5
    disparity = 0.5 + 0.004 * (columns - 26) - 0.002 * (rows - 22)
    picture = 0.5 + 0.3 * np.stack([np.sin(columns / 3), np.cos(rows / 4), np.sin((rows + columns) / 5)], -1)
    everywhere = np.ones(disparity.shape, bool)
    gaussians = surface_gaussians(picture, 1 / disparity, everywhere, wide, sh_count=4, spread=0.6, opacity=0.98)
    masked = torch.from_numpy(((np.abs(columns - 26) < 6) & (np.abs(rows - 22) < 5)).ravel())
    factor = torch.where(masked, moved, 1.0)[:, None]
    moved_ones = replace(gaussians, means=gaussians.means * factor, log_scales=gaussians.log_scales + torch.log(factor))
    return moved_ones, masked


def black_train_view(hole=HOLE):
    hole = torch.from_numpy(hole)
    return TrainView(VIEW, torch.zeros(HEIGHT, WIDTH, 3), ~hole, hole, False)


def evaluate_term(gaussians, masked, estimator, prior=None, text=None, view=None, settings=DEPTH, **more):
    arguments = view or black_train_view(), prior, text, settings, 7.5, generator(1), estimator
    return depth_term.evaluate_depth(gaussians, masked, *arguments, **more)


def wall_depth(moved=1.0, how=HOW):
    """Return the depth that VIEW renders of the wall, with the masked Gaussians moved by the factor `moved`."""
    with torch.no_grad():
        return background_depth.extract_depth(render(slanted_wall(moved)[0], VIEW), VIEW, HOLE, HOLE, how)


def constant_estimator(estimate):
    """Return the paper's depth estimator, with a network that returns `estimate` for every image."""
    return depth_estimator.network_estimator(lambda image: torch.as_tensor(np.asarray(estimate)), HOW)


# ------------------------------------------------------------------------------------------ alignment and target


@pytest.mark.parametrize("unit", [1e-8, 1.0, 1e8])
def test_the_target_does_not_depend_on_the_estimates_unit(unit):
    """An estimated disparity that is an affine function of the true disparity gives the wall's depth as target."""
    view = replace(wall_depth(), depth=1 / WALL)
    guide = np.full((HEIGHT, WIDTH, 3), 0.5)
    disparity, _ = estimates.align_estimate(view, guide, unit * (40 * WALL - 7))
    target, compared = depth_term.depth_target(view, disparity, np.ones_like(HOLE))
    assert (compared == HOLE).all()
    np.testing.assert_allclose(target[HOLE], 1 / WALL[HOLE], rtol=1e-9)


def test_nothing_is_compared_where_depth_is_unknown():
    view = replace(wall_depth(), depth=1 / WALL)
    beyond, thin = COLUMNS > 18, COLUMNS < 12
    disparity = np.where(beyond, -0.1, WALL)
    target, compared = depth_term.depth_target(view, disparity, ~thin)
    assert (compared == (HOLE & ~beyond & ~thin)).all() and np.isfinite(target).all()
    farthest = 0.51 / (1 / WALL)[view.known].max()
    assert (depth_term.depth_target(view, np.full_like(WALL, farthest), ~thin)[1] == (HOLE & ~thin)).all()
    with pytest.raises(Degenerate, match="no pixel"):
        depth_term.depth_target(view, np.full_like(WALL, 0.9 * farthest), ~thin)
    with pytest.raises(FloatingPointError, match="not finite"):
        depth_term.depth_target(view, np.where(HOLE, np.nan, WALL), ~thin)


# ------------------------------------------------------------------------------------------ value and gradient


def test_a_surface_that_is_right_has_no_loss_and_one_that_is_not_is_pulled_the_right_way():
    estimator = depth_estimator.continuation_estimator(NO_POINTS, HOW)
    right = float(evaluate_term(*slanted_wall(), estimator)[0])
    for moved, sign in ((0.9, -1), (1.1, 1)):
        gaussians, masked = slanted_wall(moved)
        gaussians = as_leaves(gaussians)
        loss, _ = evaluate_term(gaussians, masked, estimator)
        loss.backward()
        # The loss is smaller than `whole`: a part of the hole shows unmasked Gaussians, which lie on the wall.
        whole = float((0.1 / WALL[HOLE].mean()) ** 2)
        assert 0.4 * whole < float(loss.detach()) < whole and right < 1e-3 * whole
        # A positive gradient moves a Gaussian towards the camera, because a step follows the negative gradient.
        pull = gaussians.means.grad[masked][:, 2]
        assert (sign * pull.sum()) > 0 and (sign * pull > 0).float().mean() > 0.8


def test_the_loss_is_in_its_unit():
    gaussians, masked = slanted_wall(0.9)
    estimator = depth_estimator.continuation_estimator(NO_POINTS, HOW)
    units = [DEPTH.changed({"unit": unit}) for unit in (1, 3)]
    once, thrice = (float(evaluate_term(gaussians, masked, estimator, settings=each)[0]) for each in units)
    assert once == pytest.approx(9 * thrice)


def test_a_displaced_surface_converges_to_the_wall():
    gaussians, masked = slanted_wall(0.92)
    optimizer = GaussianOptimizer(gaussians, masked, Rates(means=1.2e-2, means_last=1e-3))
    estimator, losses = depth_estimator.continuation_estimator(NO_POINTS, HOW), []
    for step in range(36):
        loss, rendering = evaluate_term(optimizer.gaussians, optimizer.masked, estimator)
        loss.backward()
        losses.append(float(loss.detach()))
        optimizer.step(step / 36, visible=masked & (rendering.radii > 0))
    assert losses[-1] < 0.02 * losses[0]
    with torch.no_grad():
        final = render(optimizer.gaussians, VIEW)
    assert np.abs(final.depth.numpy() * WALL - 1)[HOLE].mean() < 0.01
    assert (optimizer.gaussians.sh == gaussians.sh).all()
    for name in PARAMETERS:
        assert (getattr(optimizer.gaussians, name)[~masked] == getattr(gaussians, name)[~masked]).all(), name


@pytest.mark.integration
def test_the_gradient_reaches_the_geometry_of_masked_gaussians_only(prior, text):
    gaussians, masked = slanted_wall(0.9)
    gaussians = as_leaves(gaussians)
    loss, rendering = evaluate_term(gaussians, masked, constant_estimator(WALL), prior, text)
    loss.backward()
    assert gaussians.sh.grad is None or (gaussians.sh.grad == 0).all()
    for name in ("means", "quaternions", "log_scales", "opacity_logits"):
        gradient = getattr(gaussians, name).grad
        assert (gradient[~masked] == 0).all(), name
        assert (gradient[masked & (rendering.radii > 0)] != 0).any(), name


def test_the_gradient_agrees_with_finite_differences_in_float64():
    draw = generator(4, "few")
    count = 14
    few = Gaussians(
        torch.rand(count, 3, generator=draw) * torch.tensor([0.8, 0.6, 0.4]) + torch.tensor([-0.4, -0.3, 1.8]),
        torch.randn(count, 4, generator=draw),
        torch.full((count, 3), -2.0) + 0.3 * torch.randn(count, 3, generator=draw),
        torch.randn(count, generator=draw),
        torch.randn(count, 1, 3, generator=draw),
    )
    masked = torch.arange(count) % 3 > 0
    hole = (np.abs(COLUMNS + 0.5 - WIDTH / 2) < 4) & (np.abs(ROWS + 0.5 - HEIGHT / 2) < 4)
    estimator = DepthEstimator(replace(HOW, explained=0.2), lambda *_: WALL)
    gaussians = as_leaves(few)
    loss, rendering = evaluate_term(gaussians, masked, estimator, view=black_train_view(hole))
    loss.backward()
    compared = torch.from_numpy(hole) & (rendering.alpha > 0.2)
    assert compared.sum() > 30
    exact = few.map(lambda p: p.double())

    def value(changed: Gaussians) -> float:
        depth = render(changed, VIEW, impl="torch").depth
        return float((depth[compared] - torch.from_numpy(1 / WALL)[compared]).square().mean())

    assert float(loss.detach()) == pytest.approx(value(exact), rel=1e-4)
    h = 1e-5
    for name in ("means", "quaternions", "log_scales", "opacity_logits"):
        gradient, scale = getattr(gaussians, name).grad.double(), float(getattr(gaussians, name).grad.abs().max())
        for row in torch.nonzero(masked)[:6, 0].tolist():
            bump = torch.zeros_like(getattr(exact, name))
            bump[row] = torch.randn(bump[row].shape, generator=draw, dtype=torch.float64)
            up, down = (value(replace(exact, **{name: getattr(exact, name) + s * h * bump})) for s in (1, -1))
            assert float((gradient * bump).sum()) == pytest.approx((up - down) / (2 * h), rel=1e-2, abs=3e-3 * scale)


# ------------------------------------------------------------------------------------------ degenerate views


@pytest.mark.integration
@pytest.mark.parametrize(
    "estimate, reason",
    [(np.full(WALL.shape, 3.0), "constant"), (-WALL, "reversed"), (np.zeros(WALL.shape), "constant")],
)
def test_estimates_that_fit_nothing_are_degenerate(estimate, reason, prior, text):
    with pytest.raises(Degenerate) as caught:
        evaluate_term(*slanted_wall(), constant_estimator(estimate), prior, text)
    assert caught.value.reason == reason


def test_views_without_known_or_rendered_pixels_are_degenerate(prior, text):
    everywhere = black_train_view(np.ones_like(HOLE))
    for estimator, reason in (
        (constant_estimator(WALL), "few pixels"),
        (depth_estimator.continuation_estimator(NO_POINTS, HOW), "no plane"),
    ):
        with pytest.raises(Degenerate) as caught:
            evaluate_term(*slanted_wall(), estimator, prior, text, view=everywhere)
        assert caught.value.reason == reason
    gaussians, masked = slanted_wall()
    around = gaussians.map(lambda p: p[~masked])
    with pytest.raises(Degenerate) as caught:
        inner = black_train_view((np.abs(COLUMNS + 0.5 - WIDTH / 2) < 2) & (np.abs(ROWS + 0.5 - HEIGHT / 2) < 2))
        evaluate_term(around, masked[~masked], depth_estimator.continuation_estimator(NO_POINTS, HOW), view=inner)
    assert caught.value.reason == "nothing compared"


def test_a_view_larger_than_asked_for_is_rendered_smaller():
    _, rendering = evaluate_term(
        *slanted_wall(), depth_estimator.continuation_estimator(NO_POINTS, HOW), max_side=WIDTH // 2
    )
    assert rendering.depth.shape == (HEIGHT // 2, WIDTH // 2)


# ------------------------------------------------------------------------------------------ repainting


@pytest.mark.integration
def test_repainting_changes_the_hole_only_and_the_less_the_later_it_starts(prior, text):
    image = torch.rand(3, HEIGHT, WIDTH, generator=generator(5)) * 1.6 - 0.8
    hole, changes = torch.from_numpy(HOLE), []
    for start in (0.9, 0.001):
        options = {"start": start, "finest": 0.6, "levels": 3, "steps": 3, "guidance": 0.5}
        painted = inpaint.repaint(prior, image, hole, text, generator(6), **options)
        assert (painted[:, ~hole] == image[:, ~hole]).all() and torch.isfinite(painted).all()
        assert (painted == inpaint.repaint(prior, image, hole, text, generator(6), **options)).all()
        changes.append(float((painted - image)[:, hole].abs().mean()))
    assert 0 < changes[1] < 0.1 and changes[1] < 0.3 * changes[0]


def test_the_picture_is_painted_only_where_planes_do_not_explain(prior, text):
    calls = []

    def guide():
        calls.append(1)
        return np.full((HEIGHT, WIDTH, 3), 0.5)

    view = replace(wall_depth(), depth=1 / WALL)
    for share, times in ((0.7, 0), (2.0, 1)):
        found, _ = background_depth.continue_depth(view, guide, NO_POINTS, replace(HOW, planar_share=share))
        np.testing.assert_allclose(found[HOLE], WALL[HOLE], rtol=1e-3)
        assert len(calls) == times
    smooth = depth_estimator.continuation_estimator(NO_POINTS, replace(HOW, planar_share=2.0))
    assert float(evaluate_term(*slanted_wall(), smooth, prior, text)[0]) < 1e-3


def test_the_estimator_sees_the_repainted_view(prior, text):
    seen = []

    def network(image):
        seen.append(image)
        return torch.from_numpy(WALL)

    evaluate_term(*slanted_wall(), depth_estimator.network_estimator(network, HOW), prior, text)
    with torch.no_grad():
        color = render(slanted_wall()[0], VIEW).color.clamp(0, 1).permute(2, 0, 1)
    hole = torch.from_numpy(HOLE)
    assert torch.allclose(seen[0][:, ~hole], color[:, ~hole], atol=1e-6)
    assert (seen[0] - color)[:, hole].abs().mean() > 0.01 and seen[0].min() >= 0 and seen[0].max() <= 1


# ------------------------------------------------------------------------------------------ in distillation


RUN = Params(
    iterations=6, sds={"weight": 0}, depth=with_changes(DEPTH, weight=0.5, every=2), adversarial={"weight": 0},
    reconstruction={"every": 0}, checkpoint_seconds=1e-9,
)  # fmt: skip


def run_depth_distill(folder, prior, text, estimator, settings=RUN):
    folder.mkdir(exist_ok=True)
    gaussians, masked = slanted_wall(0.95)
    with torch.no_grad():
        image = render(gaussians, VIEW).color.clamp(0, 1)
    holes = [ReferenceHole(VIEW, image, torch.from_numpy(HOLE))]
    inputs = TermInputs([black_train_view()], holes, gaussians.means[masked], prior, text, estimator)
    return D.distill(gaussians, masked, inputs, settings, folder)


@pytest.mark.integration
def test_interrupted_distillation_with_the_depth_term_resumes_bit_for_bit(prior, text, tmp_path, monkeypatch):
    monkeypatch.setattr(trace, "WORK_PER_CHECKPOINT", 0)  # write a checkpoint after every step
    whole, _ = run_depth_distill(tmp_path / "whole", prior, text, constant_estimator(WALL))
    real = D.take_step

    def interrupted(optimizer, step, *others):
        if step == 3:
            raise KeyboardInterrupt
        return real(optimizer, step, *others)

    monkeypatch.setattr(D, "take_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_depth_distill(tmp_path / "broken", prior, text, constant_estimator(WALL))
    assert load_checkpoint(tmp_path / "broken")["step"] == 3
    monkeypatch.setattr(D, "take_step", real)
    resumed, _ = run_depth_distill(tmp_path / "broken", prior, text, constant_estimator(WALL))
    for name in PARAMETERS:
        assert (getattr(whole, name) == getattr(resumed, name)).all(), name
    assert trace_lines(tmp_path / "whole") == trace_lines(tmp_path / "broken")
    assert 0 < trace_lines(tmp_path / "whole")[-1]["depth"] < trace_lines(tmp_path / "whole")[1]["depth"]


@pytest.mark.integration
def test_skipped_views_are_counted_by_reason_and_move_nothing(prior, text, tmp_path):
    ended, _ = run_depth_distill(tmp_path, prior, text, constant_estimator(np.full(WALL.shape, 2.0)))
    assert trace_lines(tmp_path)[-1]["depth_skipped_constant"] == 3 and "depth" not in trace_lines(tmp_path)[-1]
    for name in PARAMETERS:
        assert (getattr(ended, name) == getattr(slanted_wall(0.95)[0], name)).all(), name


def test_an_estimate_that_is_not_finite_names_step_and_view(prior, text, tmp_path):
    nowhere = DepthEstimator(HOW, lambda view, picture: np.full(WALL.shape, np.nan))
    with pytest.raises(FloatingPointError, match="step 0, depth, view 'a'"):
        run_depth_distill(tmp_path, prior, text, nowhere)
    with pytest.raises(ValueError, match="estimator"):
        run_depth_distill(tmp_path, prior, text, None)


def test_initialize_and_distill_complete_depth_alike():
    from reffusion.initialize import fill

    assert fill.COMPLETION == CompletionSettings() == build_estimator(Params(), NO_POINTS).how

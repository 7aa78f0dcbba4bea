"""The fit of a whole scene: it improves, resumes, ignores masked pixels, and errors name the view and the value."""

import json
import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scenes.cameras import make_camera, make_scene, yaw
from scenes.gaussians import round_gaussians

from reffusion import seeding, trace
from reffusion.fit import exposure, step, view_loader
from reffusion.fit import reconstruction as fitting
from reffusion.fit.preparation import limit_gaussians
from reffusion.fit.reconstruction import PLACED_RATE_FACTOR, fit
from reffusion.fit.start import initial_gaussians
from reffusion.fit.step import control_density
from reffusion.gaussians.optimize import GaussianOptimizer
from reffusion.io.arrays import load_json
from reffusion.io.images import save_image
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_views, save_scene
from reffusion.params.fit import Densify, Init, LearningRates, Params, SphericalHarmonics
from reffusion.splat.rasterizer import render
from reffusion.types import PARAMETERS, Camera, Gaussians, Similarity
from stages import fit as stage
from stages.plan import fit as plan

WIDTH, HEIGHT = 22, 16
SETTINGS = Params(
    iterations=24,
    sh=SphericalHarmonics(degree=1, every=0.25),
    densify=Densify(start=0.2, stop=0.8, every=6, grow_grad2d=1e-4, cap_max=120, reset_every=0.5),
    lr=LearningRates(means=2e-3),
)


def arc_cameras(count: int = 5, scale: float = 1.0, offset=(0.0, 0.0, 0.0)) -> list[Camera]:
    """Return cameras on an arc that look at the origin from distance 1 in normalized units.

    The cameras' frame is the one in which the normalized point p has the coordinates p / scale + offset.
    """
    cameras = []
    for k in range(count):
        angle = 0.8 * (k / (count - 1) - 0.5)
        rotation = yaw(-angle)
        center = rotation.T @ np.array([0, 0, -1.0]) / scale + np.asarray(offset)
        cameras.append(make_camera(f"view{k}", (WIDTH, HEIGHT), WIDTH, center, rotation))
    return cameras


def normalize_camera(camera: Camera, similarity: Similarity) -> Camera:
    pose = camera.world_to_camera.copy()
    pose[:3, 3] = -pose[:3, :3] @ similarity.apply(camera.center)
    return replace(camera, world_to_camera=pose)


def true_gaussians() -> Gaussians:
    draw = lambda *shape: torch.randn(*shape, generator=generator)
    generator = seeding.generator(5, "truth")
    return Gaussians(draw(40, 3) * 0.2, draw(40, 4), -2.5 + 0.3 * draw(40, 3), 2 + draw(40), draw(40, 1, 3))


def render_photos(cameras) -> dict[str, np.ndarray]:
    pictures = {c.name: render(true_gaussians(), c, impl="torch").color.clamp(0, 1) for c in cameras}
    return {name: (picture * 255).round().byte().numpy() for name, picture in pictures.items()}


def initial_model(points=None, degree: int = 1) -> Gaussians:
    points = true_gaussians().means.numpy().astype(np.float64) if points is None else points
    colors = np.full((len(points), 3), 128, np.uint8)
    return initial_gaussians(points, colors, degree, 1000, seeding.generator(0))


def run_fit(folder, cameras=None, initial=None, settings=SETTINGS, **options) -> Gaussians:
    folder.mkdir(exist_ok=True)
    cameras = cameras or arc_cameras()
    return fit(cameras, render_photos(arc_cameras()), initial or initial_model(), settings, folder=folder, **options)


def test_a_fit_improves_and_logs_it(tmp_path):
    held_out = arc_cameras()[2:3]
    cameras = [c for c in arc_cameras() if c.name != held_out[0].name]
    settings = SETTINGS.changed({"iterations": 240, "densify.reset_every": 0, "random_background": False})
    fitted = run_fit(tmp_path, cameras, settings=settings, held_out=held_out)
    lines = [json.loads(line) for line in (tmp_path / "trace.jsonl").read_text().splitlines()]
    assert lines[-1]["iteration"] == 240 and lines[-1]["gaussians"] == len(fitted)
    assert lines[-1]["psnr_held_out"] > lines[0]["psnr_held_out"] + 2
    assert "psnr" not in lines[0] and lines[-1]["psnr"] > lines[1]["psnr"] + 2
    assert 40 < len(fitted) <= 120, "densification made more, the budget bounded it"
    seconds = [line["seconds"] for line in lines]
    assert seconds == sorted(seconds)


class Interruption(Exception):
    pass


@pytest.mark.parametrize("gains", [None, np.linspace(0.8, 1.2, 15).reshape(5, 3)], ids=["plain", "exposure"])
def test_a_resumed_fit_is_the_unbroken_one_bit_for_bit(tmp_path, monkeypatch, gains):
    monkeypatch.setattr(trace, "WORK_PER_CHECKPOINT", 0)  # write a checkpoint after every step
    unbroken = run_fit(tmp_path / "unbroken", gains=gains)
    adapt, folder = fitting.control_density, tmp_path / "resumed"
    for moment in (3, 4, 13, 18):  # twice in a row (before a resumed run writes a checkpoint), around densification

        def killing(optimizer, centers, started_with, settings, done, moment=moment):
            adapt(optimizer, centers, started_with, settings, done)
            if done == moment:
                raise Interruption

        monkeypatch.setattr(fitting, "control_density", killing)
        with pytest.raises(Interruption):
            run_fit(folder, settings=SETTINGS.changed({"checkpoint_seconds": 1e-9}), gains=gains)
        assert trace.load_checkpoint(folder)["iteration"] == moment - 1
    monkeypatch.setattr(fitting, "control_density", adapt)
    resumed = run_fit(folder, initial=initial_model(true_gaussians().means.numpy()[:5].astype(np.float64)), gains=gains)
    for name in PARAMETERS:
        assert torch.equal(getattr(unbroken, name), getattr(resumed, name)), name
    broken, whole = (trace.read_trace(tmp_path / k / "trace.jsonl") for k in ("resumed", "unbroken"))
    drop = lambda lines: [{k: v for k, v in line.items() if k != "seconds"} for line in lines]
    assert drop(broken) == drop(whole)
    if gains is not None:
        first, second = (load_json(tmp_path / k / exposure.FILE) for k in ("unbroken", "resumed"))
        assert first == second


@pytest.mark.integration
def test_exposures_are_found_and_taken_out_again(tmp_path):
    """Every photograph has a different exposure, and the fit estimates these exposures.

    The held-out view, rendered with the mean exposure, is then more accurate than after a fit without exposures.
    Photographs with their exposure undone are close to photographs of equal exposure.
    """
    target, cameras = arc_cameras(9)[4], [c for k, c in enumerate(arc_cameras(9)) if k != 4]
    pictures, gains = render_photos([*cameras, target]), (0.7, 1.2, 0.8, 1.25, 1.1, 0.85, 1.15, 0.95)
    poses = tmp_path / "poses"
    for camera, gain in zip(cameras, gains, strict=True):
        changed = (pictures[camera.name] * np.array([gain, 1.0, 2 - gain]) + 8 * (gain - 1)).clip(0, 255)
        save_image(poses / "images" / f"{camera.name}.png", changed.round().astype(np.uint8))
    photos = load_views(poses, [c.name for c in cameras]) | {target.name: pictures[target.name]}
    values = {"iterations": 2000, "densify.stop": 0.3, "densify.reset_every": 0, "random_background": False}
    settings = SETTINGS.changed(values)
    scores = []
    for on in (False, True):
        folder = tmp_path / str(on)
        folder.mkdir()
        fit(
            cameras,
            photos,
            initial_model(),
            settings,
            folder=folder,
            held_out=[target],
            gains=np.ones((8, 3)) if on else None,
        )
        scores.append(trace.read_trace(folder / "trace.jsonl")[-1]["psnr_held_out"])
    assert scores[1] > scores[0] + 2
    away = lambda views: np.mean([np.abs(v.astype(float) - pictures[n]).mean() for n, v in views.items()])
    names = [c.name for c in cameras]
    corrected = exposure.load_photos_in_scene_exposure(poses, tmp_path / "True", names)
    assert away(corrected) < 0.3 * away(load_views(poses, names))
    for view, image in exposure.load_photos_in_scene_exposure(poses, tmp_path / "False", names).items():
        assert np.array_equal(image, photos[view])
    assert exposure.normalize_exposure(pictures[target.name], tmp_path / "True", target.name) is pictures[target.name]


def test_a_view_is_exposed_as_the_photographs_next_to_it(tmp_path):
    """If neighboring photographs have similar exposures, the nearest ones determine the exposure of a view.

    If neighboring exposures differ, all photographs contribute.
    """
    cameras = arc_cameras(12)
    seen = [camera for k, camera in enumerate(cameras) if k % 3 != 1]

    def interpolate_gains(gain_of) -> dict[str, float]:
        bright = np.array([[gain_of(cameras.index(camera))] * 3 for camera in seen])
        exposure.Exposures([camera.name for camera in seen], gains=bright).save(tmp_path)
        return {name: matrix[0, 0] for name, matrix in exposure.view_exposures(tmp_path, cameras).items()}

    assert exposure.view_exposures(tmp_path, cameras) == {}
    steps = interpolate_gains(lambda k: 0.7 if k < 6 else 1.3)
    assert steps["view0"] == pytest.approx(0.7) and steps["view11"] == pytest.approx(1.3)
    assert steps["view1"] == pytest.approx(0.7, abs=0.05) and steps["view10"] == pytest.approx(1.3, abs=0.05)
    draws = np.random.default_rng(0).choice([0.8, 1.2], 12)
    mixed = interpolate_gains(lambda k: draws[k])
    assert all(0.85 < mixed[f"view{k}"] < 1.15 for k in (4, 7))
    color = torch.rand(2, 3, 3)
    matrix = exposure.view_exposures(tmp_path, cameras)["view4"]
    display = exposure.apply_exposure(color, matrix)
    np.testing.assert_allclose(exposure.undo_exposure(display.numpy(), matrix), color, atol=1e-6)
    assert exposure.apply_exposure(color, None) is color


def test_a_photograph_tells_how_its_view_is_exposed_though_it_is_sharper_and_shows_something_else():
    draws = np.random.default_rng(0)
    smooth = cv2.GaussianBlur(draws.random((60, 80, 3)), (0, 0), 5)
    smooth = 0.2 + 0.5 * (smooth - smooth.min()) / np.ptp(smooth)
    photo = smooth * [0.7, 0.9, 1.1] + [0.1, 0.05, 0.0] + 0.08 * draws.standard_normal((60, 80, 1))
    photo[:20, :30] = 0.9  # masked pixels
    photo[50:, 60:] = 0.5  # an occluder that is not masked
    pixels = np.ones((60, 80), bool)
    pixels[:20, :30] = False
    found = exposure.match_exposure(np.eye(3, 4), smooth, (photo.clip(0, 1) * 255).astype(np.uint8), pixels)
    assert np.abs(np.diag(found[:, :3]) - [0.7, 0.9, 1.1]).max() < 0.08
    assert np.abs(found[:, 3] - [0.1, 0.05, 0.0]).max() < 0.04
    nothing = exposure.match_exposure(np.eye(3, 4), smooth, np.zeros((60, 80, 3), np.uint8), pixels)
    assert np.array_equal(nothing, np.eye(3, 4))


def test_exposures_stay_the_identity_on_average():
    exposures = exposure.Exposures(["a", "b", "c"])
    for k in range(5):
        (exposures.apply(torch.full((2, 2, 3), 0.5), "a") - 1).square().sum().backward()
        exposures.step(k / 5)
    matrices = exposures.state_dict()["matrices"]
    mean = torch.stack(list(matrices.values())).mean(0)
    torch.testing.assert_close(mean, torch.eye(3, 4), atol=1e-6, rtol=0)
    assert matrices["a"].sum() > 3.05 and torch.equal(matrices["b"], matrices["c"])


def test_seeds_matter_and_repeat(tmp_path):
    first, again = run_fit(tmp_path / "a"), run_fit(tmp_path / "b")
    other = run_fit(tmp_path / "c", settings=SETTINGS.changed({"seed": 1}))
    assert torch.equal(first.means, again.means)
    assert len(other) != len(first) or not torch.equal(first.means, other.means)


def test_gaussians_whose_places_are_known_move_a_tenth_as_far(tmp_path):
    settings = SETTINGS.changed({"iterations": 1, "densify.stop": 0.0, "densify.start": 0.0})
    known = torch.arange(40) % 2 == 0
    free, placed = run_fit(tmp_path / "a", settings=settings), run_fit(tmp_path / "b", settings=settings, placed=known)
    moved, hardly = free.means - initial_model().means, placed.means - initial_model().means
    assert moved.abs().max() > 1e-3 and torch.equal(hardly[~known], moved[~known])
    torch.testing.assert_close(hardly[known], PLACED_RATE_FACTOR * moved[known], rtol=1e-3, atol=1e-7)
    assert torch.equal(free.sh, placed.sh) and torch.equal(free.log_scales, placed.log_scales)


def test_masked_pixels_do_not_matter_to_the_fit(tmp_path):
    cameras, pictures = arc_cameras(), render_photos(arc_cameras())
    weights = {c.name: np.ones((HEIGHT, WIDTH), bool) for c in cameras[1:]}
    for mask in weights.values():
        mask[3:10, 5:12] = False
    spoilt = {name: p.copy() for name, p in pictures.items()}
    for name, mask in weights.items():
        spoilt[name][~mask] = 255
    fitted = []
    for k, images in enumerate((pictures, spoilt)):
        (tmp_path / str(k)).mkdir()
        fitted.append(fit(cameras, images, initial_model(), SETTINGS, folder=tmp_path / str(k), weights=weights))
    assert torch.equal(fitted[0].means, fitted[1].means) and torch.equal(fitted[0].sh, fitted[1].sh)


def test_a_scene_a_thousand_times_larger_and_far_away_fits_alike(tmp_path):
    """A scene in metres of a national grid, normalized by its similarity, is fitted like the scene at unit scale."""
    scale, offset = 1e-3, np.array([4.5e5, -3.2e4, 120.0])
    far = Similarity(scale, offset)
    cameras = [normalize_camera(c, far) for c in arc_cameras(scale=scale, offset=offset)]
    points = true_gaussians().means.numpy().astype(np.float64)
    plain = run_fit(tmp_path / "plain")
    moved = run_fit(tmp_path / "far", cameras, initial_model(far.apply(far.invert(points))))
    assert len(plain) == len(moved)
    for camera in arc_cameras():
        a, b = (render(g, camera, impl="torch").color for g in (plain, moved))
        assert (a - b).abs().max() < 0.01


@pytest.mark.parametrize("broken", ["picture", "parameter"])
def test_a_value_that_is_not_finite_stops_the_fit_and_is_named(tmp_path, monkeypatch, broken):
    initial = initial_model()
    if broken == "parameter":
        initial.sh[3, 0, 0] = float("nan")
        with pytest.raises(FloatingPointError, match=r"step 0, view 'view\d'"):
            run_fit(tmp_path, initial=initial)
        return

    def burst(image, target, weights=None, share=0.2):
        return image.sum() * float("inf")

    monkeypatch.setattr(step, "reconstruction_loss", burst)
    with pytest.raises(FloatingPointError, match=r"step 0, view 'view\d': the reconstruction loss"):
        run_fit(tmp_path)


def test_wrong_input_is_refused_before_any_work(tmp_path):
    cameras, pictures = arc_cameras(), render_photos(arc_cameras())
    with pytest.raises(ValueError, match="view 'view1': image is 10x16, camera is 22x16"):
        fit(cameras, pictures | {"view1": pictures["view1"][:, :10]}, initial_model(), SETTINGS, folder=tmp_path)
    with pytest.raises(ValueError, match="view 'view2': mask"):
        weights = {"view2": np.ones((3, 3), bool)}
        fit(cameras, pictures, initial_model(), SETTINGS, folder=tmp_path, weights=weights)
    with pytest.raises(ValueError, match="'view0': no image"):
        fit(cameras, {}, initial_model(), SETTINGS, folder=tmp_path)
    with pytest.raises(ValueError, match="at least one view"):
        fit([], {}, initial_model(), SETTINGS, folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_start_has_the_points_colors_and_spacing():
    grid = np.stack(np.meshgrid(*[np.arange(4) * 0.1] * 3), -1).reshape(-1, 3)
    colors = np.tile(np.array([[10, 128, 250]], np.uint8), (64, 1))
    gaussians = initial_gaussians(grid, colors, 2, 1000, seeding.generator(0))
    assert torch.allclose(gaussians.log_scales.exp(), torch.tensor(0.1), rtol=1e-5)
    assert torch.allclose(0.5 + 0.28209479 * gaussians.sh[:, 0], torch.tensor([10, 128, 250]) / 255, atol=1e-6)
    assert torch.allclose(gaussians.opacity_logits.sigmoid(), torch.tensor(0.1))
    opacities = np.linspace(0.1, 0.9, len(grid))
    each = initial_gaussians(grid, colors, 0, 1000, seeding.generator(0), opacities).opacity_logits.sigmoid()
    np.testing.assert_allclose(each, opacities, rtol=1e-5)
    assert gaussians.sh.shape == (64, 9, 3) and torch.all(gaussians.sh[:, 1:] == 0)
    assert len(initial_gaussians(grid, colors, 0, 20, seeding.generator(0))) == 20
    with pytest.raises(ValueError, match="at least 4; the scene has 3"):
        initial_gaussians(grid[:3], colors[:3], 0, 9, seeding.generator(0))
    coincident = initial_gaussians(np.zeros((5, 3)), colors[:5], 0, 9, seeding.generator(0))
    assert torch.isfinite(coincident.log_scales).all()


def write_arc_poses(folder) -> None:
    cameras, pictures = arc_cameras(), render_photos(arc_cameras())
    names = [c.name for c in cameras]
    points = np.repeat(true_gaussians().means.numpy().astype(np.float64), 3, 0)
    points += np.random.default_rng(0).normal(0, 0.01, points.shape)
    colors = np.full((len(points), 3), 128, np.uint8)
    scene = make_scene({c.name: c for c in cameras}, names[:1], points=points, colors=colors)
    save_scene(folder, scene)
    for name in scene.train:  # no file for the test view: the stage would fail if it read one
        save_image(folder / "images" / f"{name}.png", pictures[name])


def test_the_stage_writes_its_artifact_and_never_reads_test_views(tmp_path):
    poses, out = tmp_path / "poses", tmp_path / "out"
    write_arc_poses(poses)
    out.mkdir()
    params = stage.Params().changed({"iterations": 10, "densify.cap_max": 150, "sh.degree": 1, "holdout": 4})
    stage.run(params, out, poses=poses)
    fitted = load_ply(out / "gaussians.ply")
    assert 0 < len(fitted) <= 150 and fitted.sh_degree == 1
    assert "psnr_held_out" in trace.read_trace(out / "trace.jsonl")[-1]
    assert trace.load_checkpoint(out) is None
    assert plan.preview(params, poses=poses) == []


def test_the_stage_starts_from_flow_points_of_the_views_it_fits(tmp_path, capsys, monkeypatch):
    from reffusion.capture import flow

    write_arc_poses(tmp_path / "poses")
    seen, find = [], flow.triangulate_points
    monkeypatch.setattr(flow, "triangulate_points", lambda cameras, *rest: seen.append(cameras) or find(cameras, *rest))
    values = {"iterations": 3, "densify.cap_max": 500, "sh.degree": 0, "init.flow_cell": 2, "holdout": 4}
    params = stage.Params(antialiased=True).changed(values)
    (tmp_path / "out").mkdir()
    stage.run(params, tmp_path / "out", poses=tmp_path / "poses")
    found = int(re.search(r"(\d+) points by optical flow beside 120", capsys.readouterr().out)[1])
    fitted = load_ply(tmp_path / "out" / "gaussians.ply")
    assert found > 0 and len(fitted) == 120 + found and fitted.antialiased
    assert len(seen) == 1 and {c.name for c in seen[0]} == {"view1", "view2", "view4"}, "not the held-out view"


def test_larger_pictures_and_more_views_have_room_for_more_gaussians():
    few, pixels = arc_cameras(), arc_cameras()[0].width * arc_cameras()[0].height
    cameras = few * 10
    budget = lambda cameras, **densify: (
        limit_gaussians(stage.Params(densify=Densify(**densify)), cameras).densify.cap_max
    )
    assert budget(cameras, per_pixel=0.25) == round(0.25 * pixels)
    doubled = [camera.resized(2 * camera.width, 2 * camera.height) for camera in cameras]
    assert budget(doubled, per_pixel=0.25) == pixels
    assert budget(doubled, per_pixel=0.25, cap_max=100) == 100
    assert budget(cameras, cap_max=1234) == 1234
    assert budget(few, per_pixel=0.25) == round(0.4 * 0.25 * pixels)
    assert budget(cameras[:24], per_pixel=0.25) == round(0.7 * 0.25 * pixels)


def test_the_stage_takes_over_a_scene_of_gaussians(tmp_path):
    poses, out = tmp_path / "poses", tmp_path / "out"
    write_arc_poses(poses)
    out.mkdir()
    save_ply(poses / "gaussians.ply", true_gaussians())
    stage.run(stage.Params(), out, poses=poses)
    assert torch.equal(load_ply(out / "gaussians.ply").means, true_gaussians().means)
    assert "no optimization" in plan.preview(stage.Params(), poses=poses)[0]


def test_a_dense_start_looks_at_half_the_size_first():
    camera = make_camera("v", (7, 4), 5.0)
    image, counts = np.arange(84, dtype=np.uint8).reshape(4, 7, 3), np.ones((4, 7), np.float32)
    counts[0, 0] = 0
    args = [camera], {"v": image}, {"v": counts}, range(3), 0
    sizes = [
        (c.width, c.height, tuple(t.shape), tuple(w.shape)) for c, t, w in view_loader.iterate_views(*args, coarse=2)
    ]
    assert sizes == [(4, 2, (2, 4, 3), (2, 4))] * 2 + [(7, 4, (4, 7, 3), (4, 7))]
    small, _, weights = view_loader.downsample(camera, image, counts)
    assert weights[0, 0] == 0 and weights[1, 2] == 1 and small.cy == 1.0
    counts[0, 0], counts[1, 3] = 1, 0
    mean = cv2.resize(np.where(counts == 0, 0, 1.0), (4, 2), interpolation=cv2.INTER_AREA)
    assert (view_loader.downsample(camera, image, counts)[2][mean < 1] == 0).all()
    assert (
        step.coarse_steps(Params(iterations=10)) == 0 < step.coarse_steps(Params(iterations=10, init=Init(flow_cell=3)))
    )


def test_the_end_of_a_fit_is_a_mean_where_no_gaussian_is_added_any_more():
    counted = lambda **changed: [k for k in range(1, 101) if step.is_averaged(Params(iterations=100, **changed), k)]
    assert counted() == [], "as 3DGS"
    assert counted(init=Init(flow_cell=3)) == counted(densify=Densify(stop=0.0)) == [92, 94, 96, 98, 100]
    assert counted(init=Init(flow_cell=3), densify=Densify(stop=0.95)) == [96, 98, 100]


@pytest.mark.parametrize(("growth", "number"), [("linear", 43), ("immediate", 60)])
def test_the_cap_grows_linearly_or_holds_from_the_start(growth, number):
    """The first densification of 3DGS's schedule clones 30 Gaussians with large gradients as far as the cap allows."""
    optimizer = GaussianOptimizer(round_gaussians(np.zeros((30, 3)), np.full((30, 3), 0.5), 0.001, 2.0))
    optimizer.grad2d_sum += 1.0
    settings = Params(densify=Densify(cap_max=1000, cap_growth=growth, start=500 / 30_000))
    cameras = [make_camera("a", (16, 16), 16.0, center=(0.0, 0.0, -1.0))]
    control_density(optimizer, cameras, 30, settings, 500)
    assert len(optimizer.gaussians) == 30, "3DGS densifies after `start`, first after 600 of 30,000 steps"
    control_density(optimizer, cameras, 30, settings, 600)
    assert len(optimizer.gaussians) == number


def test_a_gaussian_is_split_from_a_hundredth_of_the_distance_or_of_the_cameras_extent_on():
    """The extent of these cameras is 0.55: a Gaussian of 0.008 is large by it, and small beside its distance 1."""
    cameras = [make_camera(f"{x}", (16, 16), 16.0, center=(x, 0.0, 0.0)) for x in (-0.5, 0.5)]
    smallest = {}
    for unit in ("distance", "cameras"):
        settings = Params(iterations=10, densify=Densify(start=0, every=1, stop=1, size_unit=unit, reset_every=0))
        optimizer = GaussianOptimizer(round_gaussians(torch.tensor([[0.0, 0, 1]]), torch.full((1, 3), 0.5), 2.0, 2.0))
        optimizer.gaussians.log_scales.data[:] = math.log(0.008)
        optimizer.grad2d_sum, optimizer.grad2d_count = torch.ones(1), torch.ones(1)
        control_density(optimizer, cameras, 9, settings, 4)
        assert len(optimizer.gaussians) == 2
        smallest[unit] = float(optimizer.gaussians.log_scales.detach().exp().min())
    assert smallest["distance"] == pytest.approx(0.008) and smallest["cameras"] == pytest.approx(0.008 / 1.6)


def test_sizes_are_measured_in_the_distance_or_in_the_cameras_extent():
    """A Gaussian far behind the others is pruned in units of the cameras' extent, and kept in units of its distance.

    Before the first reset of opacities no Gaussian is pruned for its size.
    """
    cameras = [make_camera(f"{x}", (16, 16), 16.0, center=(x, 0.0, 0.0)) for x in (-0.5, 0.5)]
    means = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 100.0]])
    kept = {}
    for unit in ("distance", "cameras"):
        schedule = Densify(start=0, every=1, size_unit=unit, prune_scale3d=0.1, reset_every=0.5)
        settings = Params(iterations=10, densify=schedule)
        for done in (4, 6):
            optimizer = GaussianOptimizer(round_gaussians(means, torch.full((2, 3), 0.5), 2.0, 2.0))
            optimizer.gaussians.log_scales.data[0] = math.log(0.001)
            control_density(optimizer, cameras, 2, settings.changed({"densify.stop": 1.0}), done)
            kept[unit, done] = len(optimizer.gaussians)
    assert kept == {("distance", 4): 2, ("distance", 6): 2, ("cameras", 4): 2, ("cameras", 6): 1}

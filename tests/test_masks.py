"""The stage `masks`: votes, labels of Gaussians and pixel classes, on a synthetic scene with known ground truth.

The scene is a square (the object) before a wall. C is the consistent mask: the object's mask after the vote.
"""

import numpy as np
import pytest
import torch
from scenes import wall_scene
from scenes.cameras import make_scene
from scenes.gaussians import join_gaussians, round_gaussians
from scenes.stage_runs import run_masks

from reffusion import geometry, morphology
from reffusion.io.arrays import load_json, load_labels, save_json
from reffusion.io.files import BadInput
from reffusion.io.images import load_mask, save_mask
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_mask_sets
from reffusion.masks import regions, voting
from reffusion.types import Similarity
from stages.masks import Params

# Depths of the square. At NEAR, close to the wall, the square hides a part of the wall from all views. At FAR, other
# views see almost all of the wall.
NEAR, FAR = 1.7, 0.8


def classify(tmp_path, square_at, params=None, **scene):
    poses, fit, labels = wall_scene.write_poses_and_fit(tmp_path, square_at, **scene)
    out = run_masks(poses, fit, tmp_path / "masks", params)
    found = load_labels(out / "labels.npy")
    return load_mask_sets(out, wall_scene.CAMERAS), load_json(out / "facts.json"), found, labels


def one_gaussian(z, opacity=0.9, scale=0.1):
    return round_gaussians([[0.0, 0.0, z]], [[0.5, 0.5, 0.5]], scale, float(np.log(opacity / (1 - opacity))))


def test_a_vote_is_the_blending_weight_inside_and_outside_the_mask():
    view, front, back = wall_scene.front_camera("v", 0.0), one_gaussian(1.0), one_gaussian(1.5)
    both = join_gaussians(front, back)
    left = np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool)
    left[:, : wall_scene.WIDTH // 2] = True
    votes = voting.cast_votes(both, [view], {"v": left}, mode="weight")
    np.testing.assert_allclose(votes.masked, votes.unmasked, rtol=1e-4)  # the scene is symmetric
    alone = voting.cast_votes(front, [view], {"v": left}, mode="weight")
    np.testing.assert_allclose(votes.masked[0], alone.masked[0], rtol=1e-5)  # nothing occludes the front Gaussian
    assert votes.masked[1] < voting.cast_votes(back, [view], {"v": left}, mode="weight").masked[0]
    counts = voting.cast_votes(both, [view], {"v": left}, mode="count")
    assert counts.masked[1] == round(float(counts.masked[1])) and counts.masked[1] > votes.masked[1]


@pytest.mark.parametrize("tau", [0.5, 1.0, 2.0])
def test_the_label_needs_a_ratio_above_tau(tau):
    votes = voting.Votes(
        torch.tensor([tau * 3, tau * 3 + 1e-3, 0.0, 1.0, 0.0]), torch.tensor([3.0, 3.0, 0.0, 0.0, 1.0])
    )
    assert voting.label_gaussians(votes, tau).tolist() == [False, True, False, True, False]


def test_views_without_a_mask_do_not_vote_and_empty_masks_do():
    views = [wall_scene.front_camera("v", 0.0), wall_scene.front_camera("w", 0.0)]
    full, empty = (
        np.ones((wall_scene.HEIGHT, wall_scene.WIDTH), bool),
        np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool),
    )
    alone = voting.cast_votes(one_gaussian(1.0), views, {"v": full})
    assert voting.label_gaussians(alone).all() and alone.unmasked == 0
    both = voting.cast_votes(one_gaussian(1.0), views, {"v": full, "w": empty})
    assert both.masked == both.unmasked > 0 and not voting.label_gaussians(both).any()  # a tie is not a majority


def test_wrong_masks_are_refused():
    with pytest.raises(ValueError, match="none of the training views has a mask"):
        voting.cast_votes(
            one_gaussian(1.0),
            [wall_scene.front_camera("v", 0.0)],
            {"other": np.ones((wall_scene.HEIGHT, wall_scene.WIDTH), bool)},
        )
    with pytest.raises(ValueError, match="mask of view v"):
        voting.cast_votes(one_gaussian(1.0), [wall_scene.front_camera("v", 0.0)], {"v": np.ones((4, 4), bool)})


def test_unseen_gaussians_take_the_label_of_their_neighbors():
    views = [wall_scene.front_camera("v", -0.2), wall_scene.front_camera("w", 0.2)]
    ballots = {view.name: wall_scene.true_mask(view, 1.0) for view in views}
    aside = one_gaussian(1.0).map(lambda p: p.clone())
    aside.means[0, 0] = 0.5
    nowhere = one_gaussian(-1.0)
    assert [bool(voting.hidden_inside(g, views, ballots)) for g in (one_gaussian(1.0), aside, nowhere)] == [
        True,
        False,
        False,
    ]


def test_tidy_removes_specks_and_closes_gaps():
    mask = np.zeros((40, 40), bool)
    mask[5:25, 5:25] = True
    whole = mask.copy()
    mask[10, 10] = False
    mask[35, 35] = True
    assert (morphology.remove_small_parts(mask, 3, 3) == whole).all()
    assert (morphology.remove_small_parts(mask, 0, 0) == mask).all()
    mask[12:20, 12:20] = False
    assert not morphology.remove_small_parts(mask, 3, 3)[15, 15]


def test_consistent_and_unobserved_masks_match_the_truth(tmp_path):
    sets, facts, found, labels = classify(tmp_path, NEAR)
    assert (found == labels).float().mean() > 0.99
    for name, view in wall_scene.CAMERAS.items():
        assert wall_scene.iou(sets[name].consistent, wall_scene.true_mask(view, NEAR)) > 0.9
        assert wall_scene.iou(sets[name].unobserved, wall_scene.true_unobserved(view, NEAR)) > 0.75
        assert not (sets[name].unobserved & ~sets[name].consistent).any()
        assert (sets[name].invent == sets[name].unobserved).all()
    assert facts["best_reference"] in wall_scene.TRAIN and facts["invent_views"] == list(wall_scene.TRAIN)
    assert facts["masked_gaussians"] == int(found.sum())
    assert facts["invent_pixels"] == sum(int(sets[name].invent.sum()) for name in wall_scene.TRAIN)


def test_pixels_seen_by_other_views_are_not_invented(tmp_path):
    sets, facts, _, _ = classify(tmp_path, FAR)
    assert all(
        wall_scene.iou(sets[n].consistent, wall_scene.true_mask(v, FAR)) > 0.9 for n, v in wall_scene.CAMERAS.items()
    )
    # The share is not 0: a band of half a Gaussian's footprint stays unobserved, because the vote labels
    # Gaussians at the rim of the masks wrongly.
    assert facts["unobserved_share"] < 0.1


def test_a_missing_and_a_contradicting_mask_are_outvoted(tmp_path):
    masks = {name: wall_scene.true_mask(wall_scene.CAMERAS[name], NEAR) for name in wall_scene.TRAIN[1:]}
    masks["a3"] = np.zeros_like(masks["a3"])
    sets, facts, _, _ = classify(tmp_path, NEAR, masks=masks)
    assert facts["voting_views"] == 4
    assert wall_scene.iou(sets["a0"].consistent, wall_scene.true_mask(wall_scene.CAMERAS["a0"], NEAR)) > 0.9
    assert not sets["a0"].raw.any()


def test_masks_without_the_objects_rim_are_enlarged(tmp_path):
    whole = {name: wall_scene.true_mask(wall_scene.CAMERAS[name], NEAR) for name in wall_scene.TRAIN}
    small = {name: ~morphology.dilate(~mask, 0.03) for name, mask in whole.items()}
    for grow, found in ((0.0, False), (0.03, True)):
        (folder := tmp_path / str(grow)).mkdir()
        sets, _, _, _ = classify(folder, NEAR, Params(grow=grow), masks=small)
        assert (wall_scene.iou(sets["a0"].raw, whole["a0"]) > 0.95) == found


def test_gaussians_inside_every_mask_are_the_object_even_if_outvoted(tmp_path, monkeypatch):
    """All masks miss the same spot of the object, as a segmentation misses a bright reflection.

    The vote alone keeps the Gaussians of this spot. With `inside_share` below 1 they are labelled as the object.
    """
    rows, columns = np.mgrid[: wall_scene.HEIGHT, : wall_scene.WIDTH] + 0.5
    masks = {}
    for name in wall_scene.TRAIN:
        (at,), _ = geometry.project(np.array([[0.0, 0.0, NEAR]]), wall_scene.CAMERAS[name])
        spot = np.hypot(columns - at[0], rows - at[1]) < 2.5
        masks[name] = wall_scene.true_mask(wall_scene.CAMERAS[name], NEAR) & ~spot
    monkeypatch.setattr(morphology, "GAP", 0.1)
    found = {}
    for share in (0.9, 1.0):
        (tmp_path / str(share)).mkdir()
        params = Params(inside_share=share, debris=False, remnants=False)
        _, _, found[share], truth = classify(tmp_path / str(share), NEAR, params, masks=masks)
    lost = truth & ~found[1.0]
    assert lost.sum() >= 4, "the vote alone leaves the spot standing"
    assert found[0.9][lost].all()
    assert torch.equal(found[0.9] & ~truth, found[1.0] & ~truth), "nothing but the object is added to the vote"


def test_a_clean_view_shows_what_the_object_hid(tmp_path):
    masks = {name: wall_scene.true_mask(wall_scene.CAMERAS[name], NEAR) for name in wall_scene.TRAIN if name != "a2"}
    sets, facts, _, _ = classify(tmp_path, NEAR, masks=masks, clean=("a2",))
    assert facts["voting_views"] == 5
    assert not sets["a2"].unobserved.any()
    hidden = classify(tmp_path / "b", NEAR)[1] if (tmp_path / "b").mkdir() is None else None
    assert facts["invent_pixels"] <= hidden["invent_pixels"]


@pytest.mark.parametrize("value", [False, True])
def test_empty_and_full_masks_are_handled(tmp_path, value):
    mask = np.full((wall_scene.HEIGHT, wall_scene.WIDTH), value)
    sets, facts, found, _ = classify(tmp_path, NEAR, masks=dict.fromkeys(wall_scene.TRAIN, mask))
    assert bool(found.any()) == value
    assert all(each.consistent.mean() == (1.0 if value else 0.0) for each in sets.values())
    assert (facts["best_reference"] is None) == (not value)


def test_a_region_alone_marks_and_fills(tmp_path):
    poses, fit, labels = wall_scene.write_poses_and_fit(tmp_path, NEAR, masks={})
    with pytest.raises(ValueError, match="neither masks nor a region"):
        run_masks(poses, fit, tmp_path)
    save_json(tmp_path / "raw_masks/region.json", {"center": [0, 0, NEAR], "size": [0.5, 0.5, 0.1]})
    run_masks(poses, fit, tmp_path)
    sets = load_mask_sets(tmp_path, wall_scene.CAMERAS)
    assert (load_labels(tmp_path / "labels.npy") == labels).all()
    rows, columns = np.nonzero(sets["a2"].invent)
    half = 0.25 / (NEAR - 0.05) * wall_scene.FOCAL
    assert all(abs((side.max() - side.min() + 1) / 2 - half) <= 1 for side in (rows, columns))


@pytest.mark.parametrize("invent", ["auto", "consistent"])
def test_a_region_to_be_filled_removes_nothing_and_is_a_part_of_m(tmp_path, invent):
    poses, fit, _ = wall_scene.write_poses_and_fit(tmp_path, NEAR, masks={})
    save_json(
        tmp_path / "raw_masks/region.json", {"center": [0, 0, NEAR], "size": [0.5] * 3, "round": True, "holds": False}
    )
    run_masks(poses, fit, tmp_path, Params(invent=invent))
    sets = load_mask_sets(tmp_path, wall_scene.CAMERAS)
    assert not load_labels(tmp_path / "labels.npy").any()
    assert not any(each.consistent.any() for each in sets.values())
    assert all(sets[name].invent.any() for name in wall_scene.TRAIN)


def test_masks_say_what_is_to_be_filled(tmp_path):
    """Fill masks are used as the invent masks without a change. No Gaussian is removed and C is empty."""
    poses, fit, _ = wall_scene.write_poses_and_fit(tmp_path, NEAR, masks={})
    mask = np.zeros((wall_scene.HEIGHT, wall_scene.WIDTH), bool)
    mask[10:30, 5:40] = True
    for name in wall_scene.TRAIN:
        save_mask(tmp_path / "raw_masks/fill" / f"{name}.png", mask)
    run_masks(poses, fit, tmp_path)
    sets = load_mask_sets(tmp_path, wall_scene.CAMERAS)
    assert not load_labels(tmp_path / "labels.npy").any()
    assert all((sets[name].invent == mask).all() and not sets[name].consistent.any() for name in wall_scene.TRAIN)


def test_the_drawn_part_of_a_region_and_its_rim_are_repainted():
    """The repainted pixels are the region's pixels in C, and those outside C on which something was drawn (high alpha).

    A faint pixel (alpha 0.01) does not count as drawn. A hole of one pixel in the drawing is closed.
    """
    invent, consistent, alpha = np.zeros((60, 100), bool), np.zeros((60, 100), bool), np.zeros((60, 100))
    invent[10:50, 10:90], consistent[10:50, 10:20], alpha[20:40, 40:60] = True, True, 0.9
    alpha[30, 50], alpha[15, 80] = 0.0, 0.01  # a hole of one pixel; a faint pixel
    found = regions.restrict_to_new(invent, consistent, alpha)
    rows, columns = np.nonzero(found & ~consistent)
    assert found[20:40, 40:60].all() and (found & consistent == invent & consistent).all()
    assert rows.min() == 20 and rows.max() == 39 and columns.min() == 40 and columns.max() == 59


def test_a_box_behind_the_surface_has_no_silhouette():
    view = wall_scene.front_camera("v", 0.0)
    wall = np.full((wall_scene.HEIGHT, wall_scene.WIDTH), 1 / wall_scene.WALL)
    box = regions.Region([0, 0, 1.5], [0.2] * 3)
    visible = regions.silhouette(box, view, wall)
    assert visible[36, 48] and not visible[2, 2]
    assert not regions.silhouette(box, view, np.full(wall.shape, 1 / 1.2)).any()
    assert not regions.silhouette(regions.Region([0, 0, -1.5], [0.2] * 3), view, wall).any()


def test_a_region_that_no_view_shows_is_refused_with_places_in_the_scenes_frame():
    view = wall_scene.front_camera("v", 0.0)
    scene = make_scene({"v": view}, similarity=Similarity(0.01, np.array([100.0, 0, 0])))
    regions.check_region(regions.Region([0, 0, 1.5], [0.2] * 3), scene)
    with pytest.raises(BadInput, match=r"no view shows it; .* is \[5.1e\+03, 0, 150\], .* around \[100, 0, 0\]"):
        regions.check_region(regions.Region([50, 0, 1.5], [0.2] * 3), scene)


def test_masks_of_a_sphere_cover_what_lies_beyond_it():
    """A sphere of radius r at distance d projects to a disc of radius tan(asin(r / d)). The mask is the rest."""
    view = wall_scene.front_camera("v", 0.0)
    ahead, radius = view.center + 1.0 * view.world_to_camera[2, :3], 0.25
    np.testing.assert_allclose(regions.point_on_axis(view, 1.0), ahead)
    beyond = regions.outside_sphere(ahead, radius, view)
    rays = geometry.pixel_rays(view)
    disc = np.hypot(rays[..., 0], rays[..., 1]) < np.tan(np.arcsin(radius))
    assert disc.any() and not disc.all() and (beyond == ~disc).all()
    assert regions.outside_sphere(view.center - (ahead - view.center), radius, view).all(), "it is behind the camera"
    assert not regions.outside_sphere(view.center, radius, view).any(), "the camera is in it"


def test_the_best_view_has_the_largest_mask_clear_of_the_border():
    blank = np.zeros((20, 30), bool)
    small_one, large, cut = blank.copy(), blank.copy(), blank.copy()
    small_one[5:8, 5:8] = large[5:12, 5:12] = cut[:15, :15] = True
    assert voting.best_view({"s": small_one, "l": large, "c": cut}, ["c", "s", "l"]) == "l"
    assert voting.best_view({"s": blank, "c": cut}, ["s", "c"]) == "c"
    assert voting.best_view({"s": blank}, ["s"]) is None


def test_faint_gaussians_show_mostly_where_no_view_saw():
    view, blob = wall_scene.front_camera("v", 0.0), one_gaussian(1.0)
    inside = wall_scene.true_mask(view, 1.0)
    aside = blob.map(lambda p: p.clone())
    aside.means[0, 0] = 0.4
    both = join_gaussians(blob, aside)
    assert voting.find_floaters(both, [view], {"v": inside}).tolist() == [True, False]


def test_any_subset_of_the_objects_goes_and_the_others_stay(tmp_path):
    """The two halves of the square are two objects with separate masks. `remove` selects the objects to remove."""
    poses, fit, labels = wall_scene.write_poses_and_fit(tmp_path, NEAR)
    first = labels & (load_ply(fit / "gaussians.ply").means[:, 0] < 0)
    for path in sorted((tmp_path / "raw_masks/masks").glob("*.png")):
        mask, half = load_mask(path), mask_left_of_square(path.stem)
        for name, part in (("left", half), ("right", ~half)):
            save_mask(tmp_path / "raw_masks/masks" / name / path.name, mask & part)
        path.unlink()
    found = {}
    for remove in (None, ["left"], ["right"], ["left", "right"]):
        out = tmp_path / f"masks-{remove}"
        out.mkdir()
        run_masks(poses, fit, out, Params(remove=remove))
        found[str(remove)] = load_labels(out / "labels.npy"), load_json(out / "facts.json")["kept"]
    everything, left, right, both = found.values()
    assert torch.equal(everything[0], both[0]) and everything[1] == both[1] == []
    assert left[1] == ["right"] and right[1] == ["left"]
    assert (left[0] == first)[labels].float().mean() > 0.9
    assert (right[0] == (labels & ~first))[labels].float().mean() > 0.9
    across = load_ply(fit / "gaussians.ply").means[:, 0]
    # Only the column of Gaussians at the seam of the two halves is labelled both times.
    apart = across[labels].unique().diff().max()
    assert across[left[0] & right[0] & labels].abs().max() < 1.5 * apart


def mask_left_of_square(name: str) -> np.ndarray:
    """Return bool [H, W], True at the pixels left of the middle of the square, in the view of this name."""
    camera = wall_scene.CAMERAS[name]
    column = geometry.project(np.array([[0.0, 0.0, NEAR]]), camera)[0][0, 0]
    return np.broadcast_to(np.arange(wall_scene.WIDTH) + 0.5 < column, (wall_scene.HEIGHT, wall_scene.WIDTH))

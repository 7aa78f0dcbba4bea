"""Detection of remnants: parts of the object that the masks miss are found, and no other parts of the scene."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from scenes import wall_scene
from scenes.gaussians import join_gaussians

from reffusion.gaussians.neighbors import find_neighbors, measure_overlap
from reffusion.io.arrays import load_json, load_labels
from reffusion.io.images import save_mask
from reffusion.io.scene import load_warnings
from reffusion.masks.remnants import compare_densities, find_remnants
from reffusion.types import Gaussians
from stages import masks

CAMERAS = [wall_scene.CAMERAS[name] for name in wall_scene.TRAIN]
BLUE = (0.1, 0.3, 0.9)


def cut_away(labels: torch.Tensor, gaussians: Gaussians, axis: int, share: float) -> torch.Tensor:
    """Return the labels without the outermost `share`, in [0, 1], of the object's Gaussians along an axis."""
    at = gaussians.means[:, axis]
    return labels & (at < at[labels].quantile(1 - share))


@pytest.mark.parametrize("axis", (0, 1))
def test_a_part_that_the_masks_cut_off_is_found_and_would_float(axis):
    scene, labels = wall_scene.wall_and_square(1.0)
    cut = cut_away(labels, scene, axis, 0.2)
    (remnant,) = find_remnants(scene, cut, CAMERAS)
    missing = (labels & ~cut).numpy()
    assert remnant.would_float and (remnant.members == missing).mean() > 0.99
    assert remnant.share == pytest.approx(0.25, abs=0.06) and remnant.mask.any()
    x, y = remnant.center
    assert remnant.mask[y, x] and remnant.view in remnant.describe()


def test_a_whole_mask_leaves_nothing():
    scene, labels = wall_scene.wall_and_square(1.0)
    assert find_remnants(scene, labels, CAMERAS) == []
    assert find_remnants(scene, torch.zeros_like(labels), CAMERAS) == []


def test_what_stands_beside_the_object_in_another_color_stays():
    scene, labels = wall_scene.wall_and_square(1.0)
    half = wall_scene.HALF
    aside = wall_scene.rectangle_gaussians(1.0, half, half, lambda x, y: np.broadcast_to(BLUE, (*x.shape, 3)))
    aside.means[:, 0] += 2 * half
    both = join_gaussians(scene, aside)
    whole = torch.cat([labels, torch.zeros(len(aside), dtype=torch.bool)])
    assert find_remnants(both, whole, CAMERAS) == []


def test_nothing_is_found_where_everything_is_removed():
    scene, labels = wall_scene.wall_and_square(1.0)
    assert find_remnants(scene, torch.ones_like(labels), CAMERAS) == []


def test_the_stage_removes_what_would_float(tmp_path):
    """The masks miss a fifth of the square. With `remnants`, the stage `masks` labels this part as the object, too.

    The stage also writes a warning, an entry in facts.json and a picture of the remnant.
    """
    poses, fit, _ = wall_scene.write_poses_and_fit(tmp_path, 1.0)
    raw_masks = poses.with_name("raw_masks")
    for path in sorted((raw_masks / "masks").glob("*.png")):
        true = wall_scene.true_mask(wall_scene.CAMERAS[path.stem], 1.0)
        columns = np.flatnonzero(true.any(0))
        part = true & (np.arange(true.shape[1]) < columns[round(0.8 * len(columns))])
        save_mask(path, part)
    found = {}
    for name, context in (("on", pytest.warns(UserWarning, match="would float")), ("off", nullcontext())):
        (tmp_path / name).mkdir()
        with context:
            params = masks.Params(remnants=name == "on")
            masks.run(params, tmp_path / name, poses=poses, raw_masks=raw_masks, fit=fit)
        found[name] = int(load_labels(tmp_path / name / "labels.npy").sum())
    assert found["on"] > 1.15 * found["off"]
    assert load_json(tmp_path / "on/facts.json")["remnants"][0]["removed"]
    assert "float" in load_warnings(tmp_path / "on")[0] and (tmp_path / "on/remnants/1.png").is_file()
    assert load_warnings(tmp_path / "off") == [] and not (tmp_path / "off/remnants").exists()


# --- functions of the detection


def test_overlap_of_two_gaussians():
    """The overlap of two equal Gaussians is exp(-(d / 2 s)^2 / 2).

    The distance d of their means lies along one of their axes, and s is the standard deviation along this axis.
    """
    scales, quaternion = torch.tensor([0.1, 0.2, 0.4]), torch.tensor([0.5**0.5, 0.0, 0.0, 0.5**0.5])  # rotates x to y
    for axis, deviation in enumerate((0.2, 0.1, 0.4)):
        means = torch.zeros(2, 3)
        means[1, axis] = 0.3
        pair = Gaussians(
            means, quaternion.repeat(2, 1), scales.log().repeat(2, 1), torch.zeros(2), torch.zeros(2, 1, 3)
        )
        assert measure_overlap(pair, np.array([[0, 1]]))[0] == pytest.approx(np.exp(-((0.3 / 2 / deviation) ** 2) / 2))
    assert find_neighbors(pair).pairs.tolist() == [[0, 1]]


def test_densities_of_colors():
    rng = np.random.default_rng(0)
    colors = np.concatenate([rng.normal(0.2, 0.03, (300, 3)), rng.normal(0.8, 0.03, (600, 3))])
    inside = np.arange(900) < 300
    ratio = compare_densities(colors, inside, ~inside)
    assert ratio[inside].min() > 3 and ratio[~inside].max() < -3

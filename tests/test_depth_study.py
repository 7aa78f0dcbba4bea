"""The depth study: its true depth maps agree with the generator's sparse points, and depth edges are found."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.studies import depth as study
from reffusion.io import colmap
from reffusion.io.given_masks import load_given_mask

pytestmark = pytest.mark.integration


def test_truth_is_where_sparse_points_are(generate, tmp_path):
    """Sparse points that project outside a view's mask lie at the depth of the room without the object."""
    import depths

    kind, folder = generate.KINDS["mini"], tmp_path / "mini"
    generate.generate(folder, 0, kind)
    truth = json.loads((folder / "truth/cameras.json").read_text())
    center = np.array([truth["cx"], truth["cy"]])
    points = colmap.load_model_points(folder / "sparse/0/points3D.bin").positions
    agreeing, hidden = [], []
    for label in sorted((folder / "images_4/label").glob("*.png")):
        mask, pose = load_given_mask(label), np.array(truth["world_to_camera"][label.stem])
        x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
        rays = np.stack([x / z, y / z], 1)
        bent = truth["f"] * (1 + truth["k1"] * (rays**2).sum(1, keepdims=True)) * rays
        column, row = np.floor(bent + center).astype(int).T
        inside = (z > 0) & (column >= 0) & (row >= 0) & (column < kind.width) & (row < kind.height)
        visible = inside.copy()
        visible[inside] = ~mask[row[inside], column[inside]]
        error = depths.background_depth(0, kind, pose, rays[visible]) / z[visible] - 1
        agreeing.append(np.abs(error) < 0.01)
        hidden.append(error < -0.01)  # another surface occludes the point
    agreeing, hidden = np.concatenate(agreeing), np.concatenate(hidden)
    assert agreeing.mean() > 0.9
    assert (agreeing | hidden).mean() > 0.98


def test_a_slanted_plane_has_no_edges_and_a_step_has():
    rows = np.linspace(1.0, 0.2, 40)[:, None]
    floor = np.broadcast_to(1 / rows, (40, 60))
    assert not study.near_edges(floor).any()
    stepped = np.where(np.arange(60) < 30, floor, 1.1 * floor)
    found = study.near_edges(stepped)
    assert found[:, 30 - study.NEAR : 30 + study.NEAR].all()
    assert not found[:, : 29 - study.NEAR].any() and not found[:, 31 + study.NEAR :].any()


def test_scores_count_what_has_no_depth_as_wrong():
    true = np.full((1, 4), 2.0)
    found = study.scores(study.relative_errors(np.array([[2.0, 2.03, 2.09, 0.0]]), true))
    assert [found[f"within {n}%"] for n in (1, 2, 5)] == [0.25, 0.5, 0.75]


def test_the_name_of_a_scene_tells_its_kind():
    assert [study.scene_kind(name) for name in ("demo", "demo-7", "demo-table-21")] == ["demo", "demo", "table"]

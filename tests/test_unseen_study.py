"""The study of unseen pixels: it finds the pixels that neither a photograph nor a reference shows, and paints them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes.distill_scene import write_initialized_run
from scenes.networks import small_prior

from lab.studies import unseen
from reffusion.io.arrays import save_json
from reffusion.io.images import save_image
from reffusion.io.scene import load_scene, save_references, save_scene
from reffusion.types import Reference

pytestmark = pytest.mark.integration

HOLE = np.zeros((36, 48), bool)
HOLE[10:24, 12:30] = True
LEFT = HOLE & (np.arange(48) < 20)


def write_run(home, filled, given=True):
    """Write a run with training views `a` and `b`, test view `c`, and a reference that fills `filled` in `a`.

    Args:
        given: False if the stage `reference` made the reference.
    """
    run = write_initialized_run(home, HOLE)
    scene = load_scene(run / "poses")
    save_scene(run / "poses", replace(scene, train=("a", "b"), test=("c",), clean=frozenset()))
    picture = np.full((*HOLE.shape, 3), 90, np.uint8)
    save_image(run / "poses" / "images" / "c.png", picture)
    save_references(run / "reference", [Reference(scene.cameras["a"], picture, filled)])
    save_json(run / "reference" / "facts.json", {"given": ["a"] if given else []})
    return run


def test_unseen_pixels_are_those_that_no_picture_shows(tmp_path):
    (view,) = unseen.find_unseen_views(write_run(tmp_path / "half", LEFT), 6)
    assert view.name == "c" and not (view.unseen & ~HOLE).any()
    assert view.unseen[HOLE & ~LEFT].mean() > 0.9 and view.unseen[LEFT].mean() < 0.1
    assert unseen.find_unseen_views(write_run(tmp_path / "whole", HOLE), 6) == []
    (whole,) = unseen.find_unseen_views(write_run(tmp_path / "invented", HOLE, given=False), 6)
    assert whole.unseen[HOLE].mean() > 0.9, "patches show nothing"
    painted = unseen.paint(small_prior(), view, "whole view", ("", "", ""), seed=0)
    assert (painted[~view.unseen] == view.start[~view.unseen]).all()
    assert (painted[view.unseen] != view.start[view.unseen]).any()

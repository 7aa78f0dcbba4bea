"""A painting that puts an object into the hole is noticed; one that continues the surroundings is not."""

import cv2
import numpy as np
import pytest
from test_leftovers import NETWORK

from reffusion.references.added_things import find_added_thing

SHAPE = (96, 128)
HOLE = cv2.rectangle(np.zeros(SHAPE, np.uint8), (30, 20), (100, 80), 1, -1) > 0


def paint(*disks) -> np.ndarray:
    """Return a noisy wall, uint8 [H, W, 3], with disks (center, radius)."""
    picture = np.clip(np.random.default_rng(0).normal(130, 3, (*SHAPE, 3)), 0, 255).astype(np.uint8)
    for center, radius in disks:
        cv2.circle(picture, center, radius, (200, 40, 40), -1)
    return picture


@pytest.mark.parametrize("center", [(65, 50), (48, 60)], ids=["in the middle", "beside it"])
def test_an_added_thing_is_found(center):
    found = find_added_thing(NETWORK, paint((center, 16)), HOLE)
    true = cv2.circle(np.zeros(SHAPE, np.uint8), center, 16, 1, -1) > 0
    assert (found & true).sum() > 0.95 * true.sum() and (found & ~true).sum() < 0.02 * true.sum()


@pytest.mark.parametrize(
    "picture", [paint(), paint(((65, 50), 5)), paint(((65, 50), 60))], ids=["wall", "speck", "goes on beyond the hole"]
)
def test_what_belongs_there_is_no_added_thing(picture):
    assert not find_added_thing(NETWORK, picture, HOLE).any()

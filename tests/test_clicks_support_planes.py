"""The surroundings stay out of the object's masks: planes that support the object, and pixels that votes exclude."""

from __future__ import annotations

import numpy as np
import pytest

from reffusion.clicks import support_planes
from reffusion.clicks.propagation_with_network import Projection, draw_mask
from reffusion.clicks.segmenter import Candidate
from reffusion.clicks.single_view import ViewEvidence


def support_scene(generator, bumps=0.0):
    """Place Gaussians on a ball of radius 1 that stands on the plane z = 0.

    Args:
        generator: NumPy's random generator.
        bumps: standard deviation of the plane's heights.

    Returns:
        Means [N, 3]; bool [N], True on the ball; bool [N], True on the plane.
    """
    ball = generator.normal(size=(400, 3))
    ball = ball / np.linalg.norm(ball, axis=1, keepdims=True) + (0, 0, 1)
    plane = np.column_stack([generator.uniform(-3, 3, (1200, 2)), bumps * generator.normal(size=1200)])
    is_ball = np.arange(1600) < 400
    return np.concatenate([ball, plane]), is_ball, ~is_ball


def test_a_plane_known_on_one_side_of_the_object_goes_on_at_the_other_side():
    means, ball, plane = support_scene(np.random.default_rng(0))
    known = means[:, 0] > 0
    found = support_planes.find_support_gaussians(means, ball & known, plane & known)
    near = np.linalg.norm(means - np.median(means[ball & known], 0), axis=1) < 1.5
    assert found[plane & near & ~known].all() and found[ball].mean() < 0.02


@pytest.mark.parametrize("case", ["a rug is the object", "rough ground", "nothing labelled"])
def test_no_plane_speaks_against_the_object_where_none_supports_it(case):
    means, ball, plane = support_scene(np.random.default_rng(1), bumps=1.0 if case == "rough ground" else 0.0)
    known, rug = means[:, 0] > 0, plane & (np.linalg.norm(means, axis=1) < 1)
    is_object = {"a rug is the object": rug & known, "rough ground": ball & known, "nothing labelled": known & False}
    is_other = known & ~ball & ~rug if case == "a rug is the object" else plane & known
    assert not support_planes.find_support_gaussians(means, is_object[case], is_other).any()


def test_pixels_that_votes_exclude_are_taken_from_the_networks_mask():
    """The network's only mask is a statue, its plinth and a thin strip beside it; votes allow only the statue.

    The plinth is removed. The strip stays, since a thin strip of excluded pixels may be an error of the votes. Without
    votes against the object, the network's mask is unchanged.
    """
    statue, plinth, strip = (np.zeros((90, 120), bool) for _ in range(3))
    statue[20:60, 40:70], plinth[60:80, 30:80], strip[20:55, 70:72] = True, True, True
    answer = [Candidate(statue | plinth | strip, 0.9)] * 3
    view = ViewEvidence(np.zeros((90, 120, 3), np.uint8), ask=lambda prompt: answer)
    votes = Projection(statue, statue * 1.0, np.where(statue, 0.0, 1.0))
    assert (draw_mask(view, votes) != statue | strip).sum() <= 4  # a few pixels may differ at the plinth's corners
    unknown = Projection(statue, statue * 1.0, np.zeros((90, 120)))
    assert np.array_equal(draw_mask(view, unknown), answer[0].mask)

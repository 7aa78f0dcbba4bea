"""The score of leftovers: what a segmentation network still finds of a removed object in rendered views."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from reffusion.clicks.segmenter import DEVIATION, MEAN, Segmenter
from reffusion.io.arrays import load_json, save_json
from reffusion.metrics import leftovers, rows
from reffusion.metrics.leftovers import FOUND, find_leftovers, measure_share

SIDE = 128


def segment_by_color(picture, points, labels):
    """Answer as the network does: the region of about the point's color, and below and above it two useless masks."""
    colors = (picture[0].transpose(1, 2, 0) * DEVIATION + MEAN) * 255
    filled = np.zeros((SIDE + 2, SIDE + 2), np.uint8)
    seed = tuple(int(value) for value in points[0])
    cv2.floodFill(
        np.ascontiguousarray(colors, np.float32), filled, seed, 0, (25,) * 3, (25,) * 3, cv2.FLOODFILL_FIXED_RANGE
    )
    region = 2.0 * filled[1:-1, 1:-1] - 1
    return np.stack([np.full_like(region, -1), region, np.full_like(region, 1)]), np.ones(3)


NETWORK = Segmenter("colors", SIDE, lambda picture: picture, segment_by_color)


def draw_views(background, thing, remaining):
    """Return a view with a disk and after its removal, where a share of its height remains, and the disk's mask."""
    rng = np.random.default_rng(0)
    after = np.clip(np.full((96, 128, 3), background) + rng.normal(0, 3, (96, 128, 3)), 0, 255).astype(np.uint8)
    mask = cv2.circle(np.zeros((96, 128), np.uint8), (60, 50), 30, 1, -1) > 0
    before = np.where(mask[..., None], np.uint8(thing), after)
    below = np.arange(96)[:, None] >= 80 - 60 * remaining
    return before, np.where((mask & below)[..., None], before, after), mask


@pytest.mark.parametrize("remaining", [0.0, 0.2, 0.5, 1.0])
@pytest.mark.parametrize("thing", [(200, 40, 40), (30, 30, 30)], ids=["red", "dark"])
def test_what_remains_is_found_and_nothing_else(tmp_path, thing, remaining):
    before, after, mask = draw_views((120, 140, 110), thing, remaining)
    true = mask & (before == after).all(-1)
    found = find_leftovers(NETWORK, before, after, mask)
    if remaining == 0:
        assert not found.any()
    else:
        assert (found & true).sum() > 0.9 * true.sum() and (found & ~true).sum() < 0.02 * mask.sum()
        share = measure_share(NETWORK, before, after, mask)
        assert share == pytest.approx(found.sum() / mask.sum())
        summary = rows.summarize_leftovers([{leftovers.COLUMN: share}], None)
        save_json(tmp_path / "summary.json", summary)  # as the stage does
        assert load_json(tmp_path / "summary.json") == summary


def test_a_thing_of_the_backgrounds_color_is_no_leftover():
    before, after, mask = draw_views((120, 140, 110), (118, 138, 112), 0.0)
    assert (np.abs(before.astype(int) - after).max(-1) <= leftovers.SAME)[mask].mean() > 0.9
    assert not find_leftovers(NETWORK, before, after, mask).any()


def test_without_remains_the_network_is_never_asked():
    never = Segmenter("never", SIDE, lambda _: pytest.fail("asked"), segment_by_color)
    before, after, mask = draw_views((120, 140, 110), (200, 40, 40), 0.0)
    assert measure_share(never, before, after, mask) == 0 < FOUND


def test_without_the_network_the_summary_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    segmenter, reason = leftovers.load_segmenter()
    summary = rows.summarize_leftovers([{"view": "a"}], reason)
    assert segmenter is None and summary["share"] is None and summary["views"] == summary["found"] == 0
    assert "make weights" in summary["unavailable"]
    for name in ("encoder.onnx", "decoder.onnx"):
        path = tmp_path / "reffusion" / "segmenter" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"no network")
    segmenter, reason = leftovers.load_segmenter()
    assert segmenter is None and "encoder.onnx" in reason and "\n" not in reason
    found = rows.summarize_leftovers([{leftovers.COLUMN: 0.0}, {leftovers.COLUMN: 0.5}, {}], None)
    assert (found["share"], found["found"], found["views"], found["unavailable"]) == (0.25, 1, 2, None)

"""A stage renders the depth of equal Gaussians from one camera once."""

import hashlib
from collections import Counter

import numpy as np
import pytest
from scenes.stage_runs import run_masks, write_true_references
from scenes.wall_scene import write_poses_and_fit

from reffusion.params.initialize import Params
from reffusion.splat import rasterizer
from stages import initialize

pytestmark = pytest.mark.integration


@pytest.fixture
def rendered(monkeypatch):
    """Counts of the renderings of depth alone: those without features, outside of optimization."""
    counts, render = Counter(), rasterizer.render

    def count(gaussians, camera, **options):
        alone = options.get("features") is None and options.get("sh_degree") == 0
        if alone and not gaussians.means.requires_grad:
            shapes = (gaussians.means, gaussians.opacity_logits, gaussians.log_scales, gaussians.quaternions)
            key = b"".join(np.ascontiguousarray(each.detach().numpy()).tobytes() for each in shapes)
            counts[hashlib.blake2b(key).digest(), repr(camera)] += 1
        return render(gaussians, camera, **options)

    monkeypatch.setattr(rasterizer, "render", count)
    return counts


def test_depth_is_rendered_once(rendered, tmp_path):
    poses, fit, _ = write_poses_and_fit(tmp_path, 1.7)
    folders = {"poses": poses, "fit": fit, "masks": run_masks(poses, fit, tmp_path / "masks")}
    assert rendered and max(rendered.values()) == 1
    rendered.clear()
    folders["reference"] = write_true_references(tmp_path / "reference", folders["masks"], "a2")
    (tmp_path / "initialize").mkdir()
    initialize.run(Params(), tmp_path / "initialize", **folders)
    assert len(rendered) > 3 and max(rendered.values()) == 1, [n for n in rendered.values() if n > 1]

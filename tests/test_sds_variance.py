"""The benchmark of the variance of the SDS gradient, on samples of known variance and on a small run."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scenes.distill_scene import write_initialized_run
from scenes.networks import small_prior

from lab.studies import sds_variance as benchmark
from reffusion import seeding

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent


def test_variance_is_split_into_that_of_noise_and_that_of_timesteps():
    """The gradients have the means 0, 1, ..., 4 at five timesteps (variance 2.5), and noise of variance 4."""
    draw = seeding.generator(0, "variances")
    means = torch.arange(5.0)[:, None, None]
    found = benchmark.variances(means + 2 * torch.randn(5, 8, 20_000, generator=draw))
    assert found["over_noise"] == pytest.approx(4, rel=0.01) and found["noise"] == pytest.approx([4] * 5, rel=0.03)
    assert found["over_timesteps"] == pytest.approx(2.5, rel=0.02)
    assert found["together"] == pytest.approx(6.5, rel=0.02)
    assert found["pull"] == pytest.approx([0, 1, 4, 9, 16], abs=0.15)


def test_without_noise_and_without_a_pull_nothing_is_left():
    same = torch.full((3, 4, 10), 0.7)
    found = benchmark.variances(same)
    assert found["over_noise"] == found["over_timesteps"] == found["together"] == 0
    assert found["pull"] == pytest.approx([0.49] * 3)


@pytest.mark.slow
def test_on_a_scene_without_ground_truth(tmp_path):
    prior, hole = small_prior(), np.zeros((36, 48), bool)
    hole[10:24, 12:30] = True
    found = benchmark.measure({"before": prior, "after": prior}, write_initialized_run(tmp_path / "run", hole))
    assert set(found) == {"whole", "window"}
    for by_time in found.values():
        assert by_time["before"] == by_time["after"] and by_time["before"]["over_noise"] > 0
    assert benchmark.load_inputs(tmp_path / "run", prior)["whole"][0].shape[0] == 2  # the clean view is not distilled
    text = benchmark.table(found)
    assert text.count("| 1.00 |") == 2 * (len(benchmark.TIMESTEPS) + 3)


def test_missing_inputs_are_named(tmp_path):
    with pytest.raises(ValueError, match="make scene=nowhere initialize"):
        benchmark.load_inputs(tmp_path / "nowhere", small_prior())
    with pytest.raises(ValueError, match="nothing is to be invented"):
        benchmark.load_inputs(write_initialized_run(tmp_path / "run", np.zeros((36, 48), bool)), small_prior())

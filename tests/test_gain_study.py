"""The study that compares distillation with initialization: gradient energy, the table, and runs of variants."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.studies import gain, holes

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent


def row(**values) -> dict[str, float]:
    return {"psnr_box": 30.0, "ssim_box": 0.9, "flip_box": 0.05, "energy_box": 0.9, "energy_mask": 0.8} | values


def test_a_variants_initialization_is_written_once():
    ways = {"initialization": row(), "result": row(psnr_box=31.5)}
    text = gain.table({"demo": ways, "demo@no_sds": ways, "other@no_sds": ways}, {"demo": {"by masks": 0.7}})
    assert text.count("initialization |") == 2  # of demo, and of `other@no_sds`, since there is no run of `other`
    assert "| demo@no_sds, result | 31.50 | 0.9000 | 0.0500 | 0.90 | 0.80 |" in text
    assert "{'by masks': 0.7}" in text


def test_a_run_that_was_not_evaluated_is_refused_with_the_command(tmp_path):
    with pytest.raises(ValueError, match="make scene=demo all"):
        gain.evaluate_run(tmp_path / "demo")


def test_energy_counts_steps_whose_ends_both_lie_in_the_mask():
    picture, mask = np.zeros((4, 6, 3), np.uint8), np.zeros((4, 6), bool)
    picture[:, 3:] = 255  # one edge, between columns 2 and 3
    mask[1:3, 1:3] = True
    assert holes.gradient_energy(picture, mask) == 0  # the step crosses the border of the mask
    mask[1:3, 3] = True
    assert holes.gradient_energy(picture, mask) == pytest.approx(
        2 / 7
    )  # 2 of the 7 steps (4 horizontal, 3 vertical) in the mask

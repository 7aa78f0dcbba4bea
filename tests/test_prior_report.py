"""The report on a prior: scores inside holes, the held-out test set, and the page with the results."""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from lab.prior import images
from lab.studies import holes
from lab.studies import prior as benchmark
from lab.studies import prior_page as page
from reffusion.io.images import load_image, save_image
from reffusion.metrics import image_metrics

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def hole_cases():
    return holes.make_cases(16)


def test_a_perfect_picture_a_blurred_one_and_a_flat_one_are_told_apart(hole_cases):
    for case in hole_cases[:6]:
        perfect = holes.hole_scores(case.truth, case.truth, case.hole)
        has_lpips = not np.isnan(perfect["lpips"])  # its weights have been fetched
        lpips = {"lpips": 0 if has_lpips else pytest.approx(np.nan, nan_ok=True)}
        assert perfect == {"psnr": image_metrics.PSNR_CAP, "ssim": 1, "flip": 0, "energy": 1} | lpips
        soft, softer = (holes.hole_scores(cv2.GaussianBlur(case.truth, (0, 0), s), case.truth, case.hole)
                        for s in (1, 4))  # fmt: skip
        for better, worse in ((perfect, soft), (soft, softer)):
            assert better["psnr"] > worse["psnr"] and better["ssim"] > worse["ssim"]
            assert better["flip"] < worse["flip"] and better["energy"] > worse["energy"]
            assert better["lpips"] < worse["lpips"] or not has_lpips


def test_only_the_hole_counts(hole_cases):
    case = hole_cases[0]
    spoilt = np.where(case.hole[..., None], case.truth, 255 - case.truth)
    assert holes.hole_scores(spoilt, case.truth, case.hole)["psnr"] == image_metrics.PSNR_CAP
    inside = case.truth.copy()
    inside[case.hole] = np.clip(inside[case.hole].astype(int) + 10, 0, 255)
    # The whole error lies in the hole, so the PSNR of the hole follows from the PSNR of the image.
    whole = image_metrics.psnr(inside, case.truth) + 10 * np.log10(case.hole.mean())
    assert holes.hole_scores(inside, case.truth, case.hole)["psnr"] == pytest.approx(whole)
    with pytest.raises(ValueError, match="hole is empty"):
        holes.hole_scores(case.truth, case.truth, case.hole & False)


def test_the_held_out_set_is_fixed_and_shares_no_picture_with_training(hole_cases):
    again = holes.make_cases(3)
    assert all(np.array_equal(a.truth, b.truth) and np.array_equal(a.hole, b.hole) for a, b in zip(again, hole_cases))  # noqa: B905
    kinds = [case.kind for case in hole_cases]
    assert 0 < kinds.count("photograph") < len(kinds)
    trained = {images.image(seed, index)[0].tobytes() for seed in (0, 1, holes.SEED) for index in range(10)}
    fresh = {images.image(holes.SEED, index, held_out=True)[0].tobytes() for index in range(10)}
    assert len(fresh) == 10 and not fresh & trained
    captions = {images.image(holes.SEED, index)[1].split()[-1] for index in range(30)}
    assert captions & set(images.PHOTOS) and not captions & set(images.HELD_OUT_PHOTOS)


def test_holes_are_objects_of_a_fair_size(hole_cases):
    photographs = [(str(k), np.random.default_rng(k).integers(0, 256, (200, 300, 3), np.uint8)) for k in range(2)]
    photograph_cases = holes.make_photograph_cases(photographs, 4)
    assert [case.kind for case in photograph_cases] == ["whole", "window"] * 4
    for case in [*hole_cases, *photograph_cases]:
        assert case.truth.shape == (holes.SIDE, holes.SIDE, 3)
        assert holes.COVER[0] <= case.hole.mean() <= holes.COVER[1]
        parts, _ = cv2.connectedComponents(case.hole.astype(np.uint8))
        assert parts - 1 <= 3 + 2  # three outlines; one that crosses itself may form several parts


def test_a_wrong_reference_has_another_picture_and_the_same_holes(tmp_path):
    for folder, value in (("references", 90), ("masks", 255)):
        save_image(tmp_path / "given" / folder / "a.png", np.full((6, 8, 3), value, np.uint8))
    save_image(tmp_path / "other.png", np.full((30, 40, 3), 200, np.uint8))
    made = benchmark.replace_references(tmp_path / "given", tmp_path / "other.png", tmp_path / "made")
    assert load_image(made / "references/a.png").shape == (6, 8, 3)
    assert (load_image(made / "references/a.png") == 200).all()
    assert (made / "masks/a.png").read_bytes() == (tmp_path / "given/masks/a.png").read_bytes()


def test_settings_are_checked_and_come_last():
    assert benchmark.parse_setting("betas=[0.8, 0.99]") == ("betas", [0.8, 0.99])
    assert benchmark.profile_params("personalize", "laptop", {"steps": 7}).steps == 7
    with pytest.raises(ValueError, match="steeps"):
        benchmark.profile_params("personalize", "laptop", {"steeps": 7})
    with pytest.raises(argparse.ArgumentTypeError, match="NAME=VALUE"):
        benchmark.parse_setting("steps")


def write_benchmark_result(folder: Path) -> None:
    """Write a small synthetic result of the benchmark: prior.json and the folders of images."""
    row = {"psnr": 20.0, "ssim": 0.5, "flip": 0.2, "energy": 0.7, "lpips": 0.1, "psnr_error": 0.3, "pictures": 2}
    better, scales = row | {"psnr": 22.0}, ("reference", "whole", "window")
    sampler = {"4": row | {"seconds": 0.05}}
    levels = {"error": [0.1, 0.4], "variance": [0.2, 0.3], "samples": row}
    for name, columns in (("inpainting", 4), ("reference", 4), ("whole", 4), ("window", 4)):
        for index in range(2):
            save_image(folder / name / f"{index}.png", np.full((8, 8 * columns, 3), 90 * index, np.uint8))
    (folder / "prior.json").write_text(json.dumps({
        "prior": "a/prior",
        "inpainting": {"columns": ["hole", "Telea", "a/prior", "truth"],
                       "scores": {name: {"all": row, "photograph": row} for name in ("Telea", "a/prior")}},
        "sampler": sampler,
        "personalization": {
            "seeds": {str(seed): {"before": dict.fromkeys(scales, row), "after": dict.fromkeys(scales, after),
                                  "wrong": dict.fromkeys(scales, row), "seconds": 9.0}
                      for seed, after in ((0, row), (1, better))},
            "sampler": {"reference": sampler, "whole": sampler},
            "steps": 7, "timesteps": [100, 900], "columns": ["hole", "before", "after", "truth"],
            "trace": [{"iteration": 0, "clean_latent_mse": 0.3}, {"iteration": 7, "clean_latent_mse": 0.2}],
            **{scale: {"before": levels, "after": levels} for scale in scales},
        },
    }))  # fmt: skip


def test_the_page_holds_every_table_and_picture(tmp_path):
    for name in ("inpainting", "reference", "whole", "window"):
        (tmp_path / name).mkdir()
    write_benchmark_result(tmp_path)
    text = page.make(tmp_path).read_text()
    assert "| all: Telea | 2 | 20.00 ± 0.30 | 0.500 | 0.200 | 0.700 |" in text
    assert "| window, after | 0.2500 | 0.2500 | 20.00 ± 0.30 |" in text
    assert "| held out, 4 | 20.00 ± 0.30 | 0.500 | 0.200 | 0.700 | 0.100 | 50 |" in text
    assert "| whole, after | 21.00 (20.00 to 22.00) | 0.500 (0.500 to 0.500) |" in text
    assert "| whole, wrong | 20.00 (20.00 to 20.00) |" in text
    linked = [line[4:-1] for line in text.splitlines() if line.startswith("![](")]
    assert sorted(linked) == ["charts.png", "inpainting.png", "reference.png", "whole.png", "window.png"]
    assert all(load_image(tmp_path / name).shape[1] > 90 for name in linked)


def test_without_a_measurement_the_page_says_what_to_run(tmp_path):
    with pytest.raises(ValueError, match=r"python -m lab\.studies\.prior"):
        page.make(tmp_path)

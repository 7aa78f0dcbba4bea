"""The preference study: clips of two methods, a session in a browser, votes with a known preference."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest
from scenes import wall_scene
from scenes.browser import open_page

from reffusion.io.images import save_image
from reffusion.io.ply import save_ply
from report import study, turntable, votes
from report.results import FOLDER_COMPARISON

pytestmark = pytest.mark.integration

METHODS = ("full", "no_sds", "inpaint_2d")


@pytest.fixture
def comparison_folder(tmp_path):
    """Two compared scenes: `full` shows a wall, `no_sds` a square before the wall, `inpaint_2d` has pictures only."""
    everything, labels = wall_scene.wall_and_square(1.0)
    wall = everything.map(lambda part: part[~labels])
    runs = []
    for scene in ("x", "y"):
        poses, _, _ = wall_scene.write_poses_and_fit(tmp_path / scene, 1.0)
        for method in METHODS:
            place = tmp_path / (scene if method == "full" else f"{scene}@{method}") / "evaluate"
            for name in wall_scene.TEST:
                save_image(place / "renders" / f"{name}.png", wall_scene.photo(wall_scene.CAMERAS[name]))
            metrics = {"mean": {}} | ({"inpainter": "telea"} if method == "inpaint_2d" else {})
            (place / "metrics.json").write_text(json.dumps(metrics))
            if method != "inpaint_2d":
                save_ply(place / "scene.ply", wall if method == "full" else everything)
            stages = {"poses": str(poses.relative_to(tmp_path)), "evaluate": str(place.relative_to(tmp_path))}
            if method == "full":
                reference = tmp_path / scene / "reference"
                save_image(reference / "references/a2.png", wall_scene.photo(wall_scene.CAMERAS["a2"]))
                stages["reference"] = str(reference.relative_to(tmp_path))
            runs.append({"scene": scene, "method": method, "state": "done", "stages": stages})
    record = {
        "scene": FOLDER_COMPARISON,
        "scenes": ["x", "y"],
        "methods": list(METHODS),
        "runs": runs,
        "data": str(tmp_path),
    }
    (tmp_path / FOLDER_COMPARISON).mkdir()
    (tmp_path / FOLDER_COMPARISON / "compare.json").write_text(json.dumps(record))
    return tmp_path / FOLDER_COMPARISON


def test_the_pages_of_a_study(comparison_folder):
    page = study.make(comparison_folder, [], frames=6)
    key = json.loads((comparison_folder / study.KEY).read_text())
    assert len(key["pairs"]) == 4 and len(key["checks"]) == 2
    text = page.read_text()
    assert not re.search("no_sds|inpaint_2d|full\\b", text), "who made what is not on the page"
    assert not list(page.parent.rglob("*key*"))
    record = json.loads(re.search(r"const study = (\{.*\});", text)[1])
    assert {trial["id"] for trial in record["trials"]} == {*key["pairs"], *key["checks"]}
    for trial in record["trials"]:
        assert all((page.parent / clip).stat().st_size > 0 for clip in trial["clips"])
        assert (page.parent / trial["reference"]).exists()
        if trial["id"] in key["pairs"] and key["pairs"][trial["id"]]["method"] == "no_sds":
            films = [cv2.VideoCapture(str(page.parent / clip)) for clip in trial["clips"]]
            assert [film.get(cv2.CAP_PROP_FRAME_COUNT) for film in films] == [6, 6]
            ours, theirs = (film.read()[1].astype(float) for film in films)
            assert theirs[..., 2].max() > ours[..., 2].max() - 60 and np.abs(ours - theirs).max() > 60  # the red square
    again = study.make(comparison_folder, [], frames=6).read_text()
    assert again == text, "the same seed, the same study"
    with pytest.raises(ValueError, match="no_sdss was not compared"):
        study.make(comparison_folder, ["no_sdss"])


def test_images_where_no_encoder_is(comparison_folder, monkeypatch):
    monkeypatch.setattr(turntable, "CODEC", "none"[:4])
    page = study.make(comparison_folder, ["no_sds"], frames=6)
    names = [path.name for path in (page.parent / "clips").iterdir()]
    assert names and all(name.endswith(".png") for name in names)
    with open_page(page.as_uri()) as browser:
        browser.fill("#name", "someone")
        browser.click("#begin")
        browser.wait_for_function("document.querySelectorAll('.pair img').length == 2")
        assert (
            browser.evaluate("document.querySelector('.pair img').naturalWidth") == 3 * wall_scene.WIDTH + 2 * study.GAP
        )


def answer_trial(browser, key: dict, trial: dict) -> None:
    """Answer a trial: `full` is better overall, the other more faithful. In a check, the correct clip is better."""
    ours = key["pairs"].get(trial["id"], {}).get("full") or key["checks"][trial["id"]]["right"]
    left = browser.get_attribute("#left video", "src")
    place = int(left != ours)
    browser.check(f"input[name=overall][value='{place}']")
    assert browser.is_disabled("#next"), "two questions"
    faithful = place if trial["id"] in key["checks"] else 1 - place
    browser.check(f"input[name=faithful][value='{faithful}']")


@pytest.mark.parametrize("width", [390, 1280])
def test_a_whole_session(comparison_folder, tmp_path, width):
    page = study.make(comparison_folder, [], frames=6)
    key = json.loads((comparison_folder / study.KEY).read_text())
    with open_page(page.as_uri(), width) as browser:
        assert browser.is_disabled("#begin")
        browser.fill("#name", "Ada L.")
        browser.click("#begin")
        order = browser.evaluate("order.map(each => each.trial)")
        assert len(order) == 6
        for number, trial in enumerate(order):
            if number == 3:  # the session continues after a reload
                browser.reload()
                browser.fill("#name", "Ada L.")
                browser.click("#begin")
                assert browser.evaluate("order.map(each => each.trial.id)") == [each["id"] for each in order]
            assert browser.evaluate("answers.answers.length") == number
            answer_trial(browser, key, trial)
            if number == 0:
                assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth")
                browser.screenshot(path=str(tmp_path / f"study-{width}.png"), full_page=True)
            browser.wait_for_function("!document.getElementById('next').disabled", timeout=60_000)
            browser.click("#next")
        with browser.expect_download() as saved:
            browser.click("#save")
        assert saved.value.suggested_filename == "answers-Ada_L_.json"
        saved.value.save_as(tmp_path / "answers.json")
        other = browser.evaluate("shuffledTrials('Grace').map(each => each.trial.id + each.turned)")
        assert other != browser.evaluate("shuffledTrials('Ada L.').map(each => each.trial.id + each.turned)")
    found, left_out = votes.count_votes([json.loads((tmp_path / "answers.json").read_text())], key)
    assert left_out == []
    shares = {(each.method, each.question): (each.share, each.votes) for each in found}
    assert shares == {(m, q): (float(q == "overall"), 2) for m in METHODS[1:] for q in votes.QUESTIONS}


# --------------------------------------------------------------------------------------------------------------- votes


def simulate_votes(participants: int, truth: float, seed: int, spread: float = 0.15) -> tuple[list[dict], dict]:
    """Return votes on 12 pairs by participants who prefer the method with probabilities around `truth`.

    Every tenth participant fails a check and always prefers the other method.
    """
    draws = np.random.default_rng(seed)
    pairs = {f"p{n}": {"scene": str(n), "method": "other", "full": f"ours{n}"} for n in range(12)}
    key = {"study": "s", "pairs": pairs, "checks": {"c": {"right": "good"}}}
    answers = []
    for number in range(participants):
        bad = number % 10 == 9
        own = 0.0 if bad else np.clip(truth + spread * draws.uniform(-1, 1), 0, 1)
        trials = [{"trial": "c", "overall": "bad" if bad else "good"}]
        for name, pair in pairs.items():
            trials.append({"trial": name, "overall": pair["full"] if draws.random() < own else "theirs"})
        answers.append({"study": "s", "participant": str(number), "answers": trials})
    return answers, key


def test_a_known_preference_is_given_back_within_the_interval():
    answers, key = simulate_votes(40, 0.7, 1)
    (found,), left_out = votes.count_votes(answers, key)
    assert found.low < 0.7 < found.high and found.high - found.low < 0.2
    assert (found.votes, found.participants) == (36 * 12, 36) and len(left_out) == 4
    assert left_out[0] == "9: 1 of 1 attention checks failed"
    assert "| other | looks better overall | " in votes.preference_table([found])


def test_the_interval_holds_the_truth_as_often_as_it_says(monkeypatch):
    monkeypatch.setattr(votes, "RESAMPLES", 600)
    hits = 0
    for seed in range(150):
        (found,), _ = votes.count_votes(*simulate_votes(30, 0.65, seed))
        hits += found.low <= 0.65 <= found.high
    assert 0.88 <= hits / 150 <= 0.99


def test_all_agree_and_what_is_refused():
    answers, key = simulate_votes(10, 1.0, 0, 0.0)
    (found,), _ = votes.count_votes(answers, key)
    assert found.share == 1 and 0.6 < found.low < 0.8 and found.high == 1  # nine people
    with pytest.raises(ValueError, match="two files of one participant"):
        votes.count_votes(answers + answers[:1], key)
    with pytest.raises(ValueError, match="another study"):
        votes.count_votes(answers, key | {"study": "t"})
    answers[0]["answers"] = answers[0]["answers"][1:]
    assert votes.count_votes(answers, key)[1][0] == "0: not to its end"

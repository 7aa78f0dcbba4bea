"""The commands `compare` and `report` on a toy pipeline: resuming, failures, tables, intervals, Pareto front, pages."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from scenes.browser import open_page
from scenes.processes import run_module
from scenes.toy_projects import COMPARE_FILES, make_request, write_files, write_project

from reffusion.io.arrays import save_json, save_text
from reffusion.io.images import save_image, save_mask
from report import before_after, charts, compare_pictures, job, job_data, results, scenes_page, trace_charts
from report import compare as page
from report.paired_statistics import confidence_half_width, paired_difference, pareto_front
from runner import Refused
from runner.fleet.compare import compare

pytestmark = pytest.mark.integration

REPO = Path(__file__).resolve().parent.parent

PUBLISHED = 'method,metric,value,protocol\nsomebody,psnr_box,19.5,"ten scenes, 1600 px"\n'


def finished_stages(root: Path) -> list[str]:
    return sorted((root / "runs/ran.txt").read_text().splitlines())


def read_page(made: dict[str, Path]) -> str:
    """Return the HTML of a comparison's page without its pictures, which may contain any word."""
    return unescape(re.sub(r'src="[^"]*"', "", made["html"].read_text()))


def cells(*texts: str) -> str:
    return "".join(f"<td>{text}</td>" for text in texts)


def methods_by_name(job_folder: Path) -> dict[str, dict]:
    return {row["method"]: row for row in results.summarize_methods(results.load_comparison(job_folder))}


@pytest.fixture(scope="module")
def compared_project(tmp_path_factory) -> Path:
    """Return a project after `compare` ran all variants on the toy scene; the variant `bad` fails."""
    root = write_project(tmp_path_factory.mktemp("compared"))
    assert compare(make_request(root)) == 1
    return root


@pytest.fixture(scope="module")
def pages(compared_project) -> dict[str, Path]:
    return page.make(compared_project / "runs/toy")


@pytest.fixture
def job_folder(compared_project, tmp_path) -> Path:
    """Return the toy scene's folder in a copy of the compared runs, which a test may change."""
    shutil.copytree(compared_project / "runs", tmp_path / "runs")
    return tmp_path / "runs/toy"


# -------------------------------------------------------------------------------------------------------- the runs


def test_every_variant_once_and_what_is_equal_is_shared(compared_project):
    own = ["toy distill", "toy evaluate", "toy poses"]
    assert finished_stages(compared_project) == sorted(
        [*own, "toy@better distill", "toy@better evaluate", "toy@none evaluate"]
    )
    copy = compared_project / "runs/toy@twin/distill"  # copied from the variant `better`, which has the same parameters
    assert (copy / "gain.txt").read_text() == "3" and (copy / "receipt.json").exists()
    assert not list((compared_project / "runs").glob("*/.copying*")) and not list(
        (compared_project / "runs").glob("toy@twin/.*")
    )


def test_a_failed_variant_shows_and_stops_no_other(compared_project, pages):
    table = methods_by_name(compared_project / "runs/toy")
    assert [name for name, row in table.items() if row["state"] == "failed"] == ["bad"]
    assert table["bad"]["psnr_box"] is None and table["bad"]["seconds"] is None and table["none"]["psnr_box"] == 22.5
    text = read_page(pages)
    assert "<td>bad (failed)</td>" in text and "a gain below 0 | cannot be" in text


def test_the_same_job_is_no_row_of_figures(compared_project, pages):
    twin = methods_by_name(compared_project / "runs/toy")["twin"]
    assert twin["same_as"] == "better" and twin["psnr_box"] is None and twin["seconds"] is None
    text = read_page(pages)
    assert "<td>twin = better</td>" in text and "twin is the very same job as better here." in text
    assert "best in SSIM: better;" in text


def test_methods_are_compared_in_a_profile_of_their_own(tmp_path):
    """pipeline.yaml names another profile for comparisons; the scene's own run is one more method, `default`."""
    root = write_project(tmp_path)
    pipeline = COMPARE_FILES["pipeline.yaml"].replace(
        "profiles: {laptop: {}}", "profiles: {laptop: {}, terms: {distill: {gain: 2}}}"
    )
    pipeline = pipeline.replace("variants:\n", "comparisons: {laptop: terms}\nvariants:\n  full: {}\n")
    write_files(root, {"pipeline.yaml": pipeline})
    assert compare(make_request(root), only="better default") == 0
    table = methods_by_name(root / "runs/toy")
    assert list(table) == ["full", "better", "default"]
    assert [table[name]["gaussians"] for name in table] == [102, 103, 101]
    assert (root / "runs/toy/profile").read_text() == "laptop\n"
    assert not (root / "runs/toy@full/poses").exists(), "shared with the scene's own run"
    assert (root / "runs/toy@full/profile").read_text() == "terms\n"
    write_files(root, {"pipeline.yaml": pipeline.replace("{laptop: terms}", "{laptop: nothing}")})
    with pytest.raises(Refused, match="comparisons names unknown profile 'nothing'"):
        compare(make_request(root))


def test_the_best_in_lpips_comes_first_and_ties_are_ties(job_folder):
    for method, value in (("toy", 0.2), ("toy@better", 0.1), ("toy@none", 0.10001)):
        path = job_folder.parent / method / "evaluate/metrics.json"
        metrics = json.loads(path.read_text())
        metrics["mean"]["lpips_vgg_box"] = value
        path.write_text(json.dumps(metrics))
    assert list(methods_by_name(job_folder)) == ["better", "none", "full", "bad", "twin"]
    text = read_page(page.make(job_folder))
    assert "best in LPIPS (vgg): better and none;" in text and text.count("<b>0.1000</b>") == 2


def test_a_folder_of_scenes_killed_and_started_again_nothing_runs_twice(tmp_path):
    """Compares `full` and `better` on three scenes, and is killed in the second scene, which is slow at first."""
    root = write_project(tmp_path)
    write_files(root, {"data/toy-2/number.txt": "20", "data/published.csv": PUBLISHED})
    slow = root / "data/toy-1/scene.yaml"
    slow.write_text("stages: {distill: {pause: 60}}")
    command = [sys.executable, "-m", "runner", "compare", "--data", str(root / "data"), "--root", str(root)]
    command += ["--profile", "laptop", "--variants", "better", "--cores", "64"]
    environment = {**os.environ, "PYTHONPATH": str(REPO)}
    process = subprocess.Popen(command, cwd=REPO, env=environment, stdout=subprocess.PIPE, text=True)
    assert any("compare: full on toy-1, 3 of 6" in line for line in process.stdout)
    for _ in range(1200):
        if list((root / "runs/toy-1").glob(".partial-distill-*")):
            break
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait(30)
    before = [f"toy{end}" for end in (" distill", " evaluate", " poses", "@better distill", "@better evaluate")]
    assert finished_stages(root) == sorted([*before, "toy-1 poses"])
    home = root / "runs/compare"
    assert methods_by_name(home)["full"]["state"] == "1 of 3 done"  # a partial comparison can be loaded
    slow.unlink()
    assert compare(make_request(root, ""), "better", data=root / "data") == 0
    ends = (" distill", " evaluate", " poses", "@better distill", "@better evaluate")
    assert finished_stages(root) == sorted(f"{scene}{end}" for scene in ("toy", "toy-1", "toy-2") for end in ends)
    row = methods_by_name(home)["full"]
    assert row["scenes"] == 3 and row["psnr_box"] == pytest.approx(21.5 + 1.15 + (1 + 2 + 3) / 3)
    assert row["psnr_box_interval"] == pytest.approx(4.302653 / np.sqrt(3), rel=1e-6)  # deviation 1, Student's t of 2
    made = page.make(home)
    text = read_page(made)
    assert "<h1>data, 3 scenes: methods compared</h1>" in text and cells("full", "24.65 ± 2.48") in text
    assert cells("better", "25.95", "27.95", "26.95", "26.95") in text  # the three scenes, and their mean
    assert cells("somebody", "published", "PSNR, dB", "19.5", "ten scenes, 1600 px") in text
    assert cells("full", "here", "PSNR, dB", "24.65 ± 2.48") in text
    assert len(list((home / "compare").glob("toy*.png"))) == 3
    for wrong, message in (("psnr_box,x", "'x' is no number"), ("psnr,1", "metric 'psnr' is none of")):
        (root / "data/published.csv").write_text(f"method,metric,value,protocol\na,{wrong},b\n")
        with pytest.raises(ValueError, match=re.escape(message)):
            page.make(home)


@pytest.mark.slow
def test_three_made_scenes_of_spin_nerfs_layout_by_the_real_stages(tmp_path, generate):
    """Runs the command of `make data=FOLDER compare` at tiny sizes, kills it in the second scene, and runs it again."""
    from lab.scenes import list_spinnerf

    for seed, name in enumerate(("1", "2", "book")):
        generate.generate(tmp_path / "data" / name, seed, generate.KINDS["mini"])
    assert sum("8 training and 3 test views" in line for line in list_spinnerf.summarize_scenes(tmp_path / "data")) == 3
    small = "fit.iterations=60 personalize.steps=4 personalize.optimizer.batch=1 distill.iterations=4"
    command = [sys.executable, "-m", "reffusion.command", "compare", "--data", str(tmp_path / "data")]
    command += [
        "--runs",
        str(tmp_path / "runs"),
        "--profile",
        "laptop",
        "--variants",
        "masked",
        "--set",
        small,
        "--cores",
        "64",
    ]
    process = subprocess.Popen(command, cwd=REPO, stdout=subprocess.PIPE, text=True)
    assert any("compare: full on 2, 3 of 6" in line for line in process.stdout)
    while not list((tmp_path / "runs/2").glob(".partial-fit-*")):
        assert process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait(30)
    dates = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").glob("1*/*/receipt.json")}
    home = tmp_path / "runs/compare"
    assert len(dates) > 8 and methods_by_name(home)["full"]["state"] == "1 of 3 done"
    subprocess.run(command, cwd=REPO, check=True)
    assert {path: path.stat().st_mtime_ns for path in dates} == dates
    table = methods_by_name(home)
    assert all(row["scenes"] == 3 and row["psnr_box_interval"] > 0 for row in table.values())
    assert table["full"]["psnr_box"] > table["masked"]["psnr_box"] and page.make(home)["html"].is_file()


def test_refused_before_any_work(tmp_path):
    root = write_project(tmp_path)
    for arguments, options, message in [
        (("beter",), {}, "variants: unknown variant 'beter'; did you mean 'better'"),
        (("", 4), {}, "seeds=4 asks for the scenes toy to toy-3: unknown scene 'toy-2'"),
        (("", 0), {}, "seeds=0"),
        ((), {"variant": "better"}, "variants=better"),
        ((), {"set": "distill.gian=1"}, "did you mean 'gain'"),
        (("", 1, root / "data"), {}, "all scenes of a folder"),
        (("", 1, root / "stages/none"), {"scene": ""}, "no folders of scenes there"),
    ]:
        with pytest.raises(Refused, match=re.escape(message)):
            compare(make_request(root, **{"scene": "toy", **options}), *arguments)
    (root / "pipeline.yaml").write_text(COMPARE_FILES["pipeline.yaml"].replace("{gain: 3}", "{gain: much}"))
    with pytest.raises(Refused, match=r"variant better: distill.gain = 'much'"):
        compare(make_request(root))
    assert not list((root / "runs").glob("*/*/receipt.json"))
    with pytest.raises(ValueError, match="make scene=toy compare"):
        page.make(root / "runs/toy")


# ------------------------------------------------------------------------------------------------- tables and pages


def test_the_table_survives_its_csv(compared_project, pages):
    home = compared_project / "runs/toy"
    table = results.summarize_methods(results.load_comparison(home))
    with open(pages["csv"], newline="") as file:
        saved = list(csv.DictReader(file))
    assert [{k: "" if v is None else str(v) for k, v in row.items()} for row in table] == saved
    full = table[0]
    assert full["method"] == "full" and full["psnr_box"] == 23.65 and full["lpips_vgg_box"] is None
    receipts = [json.loads(p.read_text()) for p in home.glob("*/receipt.json")]
    assert full["seconds"] == pytest.approx(sum(r["seconds"] for r in receipts)) and full["own_seconds"] == 0
    assert full["peak_memory_mb"] == max(r["peak_memory_mb"] for r in receipts)
    better = json.loads((home.parent / "toy@better/distill/receipt.json").read_text())["seconds"]
    assert better <= table[1]["own_seconds"] < table[1]["seconds"]
    assert table[1]["gaussians"] == 103 and table[1]["consistency"] == 0.03
    assert table[1]["psnr_box_minus_full"] == pytest.approx(2 * 1.15)


def test_the_page_needs_no_other_file(pages):
    html = pages["html"].read_text()
    sources = re.findall(r'src="([^"]*)"', html)
    assert len(sources) == 5 and all(source.startswith("data:image/png;base64,") for source in sources)
    text = re.sub(r'src="[^"]*"', "", html)  # encoded pictures may contain any word
    assert "http" not in text and "<script" not in text and "@import" not in text
    assert html.count("no weights") == 1 and "2D inpainter a brush" in html and "perceptual" not in html
    assert "better *" in text and "full *" not in text and "OpenCV's brush stands in for LaMa" in unescape(text)


def test_without_ground_truth(job_folder):
    for evaluate in job_folder.parent.glob("*/evaluate"):
        metrics = json.loads((evaluate / "metrics.json").read_text())
        (evaluate / "metrics.json").write_text(json.dumps(metrics | {"mean": dict.fromkeys(metrics["mean"])}))
        rows = [line.split(",")[:5] for line in (evaluate / "per_view.csv").read_text().splitlines()]
        (evaluate / "per_view.csv").write_text("".join(",".join(row) + "\n" for row in rows))
    html = page.make(job_folder)["html"].read_text()
    assert "No box metrics: the scene has no ground truth." in html and "minus full" not in html
    row = methods_by_name(job_folder)["better"]
    assert row["psnr_box"] is None and row["psnr_box_minus_full"] is None and row["consistency"] == 0.03
    assert (job_folder / "compare/tradeoff.png").exists() and not (job_folder / "compare/differences.png").exists()
    assert row["psnr_outside"] is None and "outside" not in html


def test_without_ground_truth_held_out_views_are_compared_outside_their_masks(job_folder):
    for evaluate in job_folder.parent.glob("*/evaluate"):
        gain = 2.0 if "@better" in str(evaluate.resolve()) or "@twin" in str(evaluate.resolve()) else 1.0
        metrics = json.loads((evaluate / "metrics.json").read_text())
        mean = dict.fromkeys(metrics["mean"]) | {"psnr_outside": 30 + gain, "ssim_outside": 0.9, "flip_outside": 0.1}
        (evaluate / "metrics.json").write_text(json.dumps(metrics | {"mean": mean}))
        lines = [f"{view},10,8,30,22,{30 + gain + 0.1 * gain * k}" for k, view in enumerate("abcd")]
        (evaluate / "per_view.csv").write_text("\n".join(["view,left,top,right,bottom,psnr_outside", *lines, ""]))
    made = page.make(job_folder)
    row = methods_by_name(job_folder)["better"]
    assert row["psnr_outside"] == 32 and row["psnr_box"] is None
    assert row["psnr_outside_minus_full"] == pytest.approx(1.15) and row["psnr_outside_interval_views"] > 0
    text = read_page(made)
    assert "outside: PSNR ↑" in text and cells("+1.15 ± 0.21") in text and "best in PSNR outside: better" in text
    assert "should leave as they are" in text
    runs = results.load_comparison(job_folder)
    title = lambda: compare_pictures._cells([runs.runs["full", "toy"]], runs.runs["full", "toy"], "a")[0][0]
    assert title() == "ground truth"
    (job_folder / "raw_masks/masks").mkdir(parents=True)
    (job_folder / "raw_masks/masks/a.png").touch()  # so the test view `a` shows the object
    runs.runs["full", "toy"].folders["raw_masks"] = job_folder / "raw_masks"
    assert title() == "photograph, with the object"
    assert (job_folder / "compare/differences.png").exists()


def test_the_best_method_is_one_of_those_with_all_scenes(job_folder):
    comparison = results.load_comparison(job_folder)
    row = lambda name, scenes, psnr: dict.fromkeys(results.COLUMNS) | {
        "method": name, "scenes": scenes, "psnr_box": psnr, "state": "done"
    }  # fmt: skip
    table = [row("full", 2, 20.0), row("none", 2, 21.0), row("better", 1, 30.0)]
    assert "best in PSNR: none." in page.summary(comparison, table)


def test_a_photograph_with_the_object_is_no_ground_truth(job_folder):
    """The test view has a mask from clicks, so its photograph shows the object."""
    files = job_data.load_job(job_folder)
    assert "truth" in before_after.find_pictures(files, "a")
    save_mask(job_folder / "masks/raw/a.png", np.ones((30, 40), bool))
    files.folders["masks"] = job_folder / "masks"
    found = before_after.find_pictures(files, "a")
    assert "photograph" in found and "truth" not in found


def test_the_slider_compares_renders_first(tmp_path):
    """A photograph is sharper than any render, so it is the third choice."""
    for name, kinds in (("x", ("renders_fit", "renders")), ("y", ("renders",))):
        write_receipt = lambda stage, home=tmp_path / name: save_json(
            home / stage / "receipt.json", {"params": {}, "needs": {}, "seconds": 1.0}
        )
        for stage in ("poses", "raw_masks", "evaluate"):
            write_receipt(stage)
        save_json(tmp_path / name / "poses/views.json", {"train": ["a"], "test": []})
        for path in ("poses/images", *(f"evaluate/{kind}" for kind in kinds)):
            save_image(tmp_path / name / path / "a.png", np.zeros((30, 40, 3), np.uint8))
        save_text(tmp_path / name / "evaluate/per_view.csv", "view\n")
    section = lambda name: "".join(before_after.before_after_section(job_data.load_job(tmp_path / name)))
    assert '<b class="l">with the object</b><b class="r">result</b>' in section("x")
    assert ">photograph</option>" in section("x")
    assert '<b class="l">photograph</b><b class="r">result</b>' in section("y")


def test_several_scenes(job_folder):
    """`better` gains 2.0, 2.2, 2.4 and 2.6 dB in the views of one scene, and 1 dB more in those of the other."""
    for name in ("toy", "toy@better"):
        shutil.copytree(job_folder.parent / name, job_folder.parent / name.replace("toy", "toy-1"))
    path = job_folder.parent / "toy-1@better/evaluate/per_view.csv"
    header, *lines = [line.split(",") for line in path.read_text().splitlines()]
    for line in lines:
        line[header.index("psnr_box")] = str(float(line[header.index("psnr_box")]) + 1)
    path.write_text("".join(",".join(line) + "\n" for line in [header, *lines]))
    record = json.loads((job_folder / "compare.json").read_text()) | {
        "scenes": ["toy", "toy-1"],
        "methods": ["full", "better"],
    }
    runs = [run for run in record["runs"] if run["method"] in record["methods"]]
    for run in runs.copy():
        stages = {stage: folder.replace("toy", "toy-1") for stage, folder in run["stages"].items()}
        runs.append(run | {"scene": "toy-1", "stages": stages})
    (job_folder / "compare.json").write_text(json.dumps(record | {"runs": runs}))
    row = methods_by_name(job_folder)["better"]
    views = np.array([2.0, 2.2, 2.4, 2.6, 3.0, 3.2, 3.4, 3.6])
    assert row["scenes"] == 2 and row["psnr_box_minus_full"] == pytest.approx(2.8)
    assert row["psnr_box_interval_views"] == pytest.approx(2.364624 * views.std(ddof=1) / np.sqrt(8), rel=1e-6)
    assert row["psnr_box_interval_scenes"] == pytest.approx(12.706205 * 0.5, rel=1e-6)
    assert "+2.80 ± 0.49 (± 6.35)" in read_page(page.make(job_folder))


# ------------------------------------------------------------------------------------------------------- statistics


def test_the_interval_is_students():
    """97.5 % quantiles from the printed table of Student's t: 2.776445 at 4 degrees of freedom, 12.706205 at 1."""
    values = np.array([1.0, 2, 3, 4, 5])
    assert confidence_half_width(values) == pytest.approx(2.776445 * np.sqrt(2.5) / np.sqrt(5), rel=1e-6)
    assert confidence_half_width(values[:1]) is None and confidence_half_width(np.full(7, 0.3)) == pytest.approx(
        0, abs=1e-12
    )
    found = paired_difference([values, values[:3] - 2])
    assert found.pairs == 8 and found.mean == pytest.approx(15 / 8)
    assert found.scenes == pytest.approx(12.706205 * np.std([3, 0], ddof=1) / np.sqrt(2), rel=1e-6)
    assert paired_difference([]) is None and paired_difference([np.zeros(0)]) is None
    assert paired_difference([values]).scenes is None and paired_difference([values]).views == confidence_half_width(
        values
    )


def test_the_interval_over_scenes_is_around_the_mean_of_their_means():
    """The scenes have one, one and seven views, so the mean of all views differs from the mean of scene means."""
    found = paired_difference([np.array([1.0]), np.array([2.0]), np.full(7, 6.0)])
    assert found.mean == 5 and found.scenes_mean == 3
    _, grid = charts.new_figure(2)
    charts._interval(grid[0, 0], found, 0, 1, np.inf)
    ends = grid[0, 0].lines[0].get_xdata()
    assert np.mean(ends) == pytest.approx(3) and np.ptp(ends) == pytest.approx(2 * found.scenes)


def test_pareto_front_against_all_pairs():
    random = np.random.default_rng(0)
    for count in range(1, 40):
        points = random.integers(0, 12, (count, 2)).astype(float)  # with many ties
        beaten = [any((q <= p).all() and (q < p).any() for q in points) for p in points]
        assert (pareto_front(*points.T) == ~np.array(beaten)).all()
    assert not len(pareto_front([], []))


def test_the_median_of_curves():
    steps = np.array([1.0, 10, 100])
    lines = [np.column_stack([steps[:n], np.full(n, value)]) for n, value in ((3, 1.0), (2, 2.0), (3, 4.0), (3, 9.0))]
    # The curve that ends at step 10 keeps its last value up to step 100.
    moments, quartiles = trace_charts.quartile_band(lines)
    assert moments[0] == pytest.approx(1) and moments[-1] == pytest.approx(100)
    assert np.allclose(quartiles.T, np.percentile([1, 2, 4, 9], [25, 50, 75]))


# --------------------------------------------------------------------------------------------------- a job's report


def record_plan(root: Path, runs: Path, *options: str) -> None:
    command = ("plan", "--record", "--scene", "toy", "--root", root, "--runs", runs, *options)
    assert run_module("runner", *command).returncode == 0


def test_report_of_a_job(compared_project, job_folder):
    record_plan(compared_project, job_folder.parent)
    path = job.make(job_folder)
    html = path.read_text()
    assert path == job_folder / "report.html" and not list(job_folder.glob("report*/*"))
    sources = re.findall(r'src="([^"]*)"', html)
    assert len(sources) == 4 * 2 + 2 and all(source.startswith("data:image/") for source in sources)
    assert html.count("data:image/png") == 2, "the whole job, and the trace of distill"
    assert "101 Gaussians; 23.65 dB and FLIP 0.150" in html
    targets = re.findall(r'href="([^"]*)"', html)
    assert len(targets) == 3 and all((path.parent / target).exists() for target in targets)
    assert (
        html.index('class="compare"')
        < html.index("23.65 dB")
        < html.index("Masks")
        < html.index("<details><summary><b>")
    )
    folded = html[html.index("<details><summary><b>") :]
    assert "What was left out or taken over, and why" in folded and folded.count("data:image/png") == 2
    assert "http" not in re.sub(r'src="[^"]*"', "", html), "whose letters may hold any word"
    assert "make scene=" in html and "profile=laptop all" in html and "set by hand" not in html
    receipt = json.loads((job_folder / "distill/receipt.json").read_text())
    receipt["params"]["gain"] = 2  # as a run with set="distill.gain=2" writes it
    (job_folder / "distill/receipt.json").write_text(json.dumps(receipt))
    html = job.make(job_folder).read_text()
    assert "set by hand" in html and "profile=laptop set=distill.gain=2 all" in html


def test_report_of_a_variant_says_what_was_left_out(compared_project, job_folder):
    record_plan(compared_project, job_folder.parent, "--variant", "none")
    html = job.make(job_folder.with_name("toy@none")).read_text()
    assert re.search(r"<td>distill</td><td[^>]*>left.out</td><td[^>]*>no gain</td>", html)
    assert "shared with toy" in html and "distill: error against seconds" not in html
    assert "profile=laptop variant=none all" in html


def test_report_with_pieces_missing(job_folder):
    shutil.rmtree(job_folder / "evaluate")
    with open(job_folder / "distill/trace.jsonl", "a") as file:
        file.write('{"seconds": 1.0, "iteration": 9}\n')
    html = job.make(job_folder).read_text()
    assert "It is not evaluated yet." in html and "None yet: " in html and "Not drawn: " in html
    assert "Still to run, or to run again: fit, evaluate." in html
    (job_folder / "distill/trace.jsonl").unlink()
    assert "Not drawn" not in job.make(job_folder).read_text()
    for stage in ("distill", "poses"):
        shutil.rmtree(job_folder / stage)
    with pytest.raises(ValueError, match="no stage has been done; run `make scene=toy all`"):
        job.make(job_folder)


def test_report_of_many_scenes(job_folder):
    jobs = [
        job_data.load_job(path)
        for path in (job_folder, job_folder.with_name("toy@better"), job_folder.with_name("toy@twin"))
    ]
    path = scenes_page.make(jobs, job_folder.parent / "report")
    rows = [line.split(",") for line in (path.parent / "stages.csv").read_text().splitlines()]
    found = {(stage, quantity): [float(value) for value in values] for stage, quantity, *values in rows[1:]}
    assert found["distill", "reference_psnr"] == [3, 26, 29, 29]
    assert found["whole job", "flip_box"] == pytest.approx([3, 0.075, 0.075, 0.1125])
    assert (path.parent / "stages.png").exists() and "29 [26, 29]" in path.read_text()


def test_the_report_advises_what_to_paint_and_repeats_the_warnings(job_folder):
    (job_folder / "reference/to_paint").mkdir(parents=True)
    (job_folder / "reference/receipt.json").write_text((job_folder / "distill/receipt.json").read_text())
    (job_folder / "reference/to_paint/ranked.txt").write_text("# views\n1. b  40%\n2. a  30%  (painted)\n3. c  2%\n")
    (job_folder / "distill/warnings.json").write_text('["the photographs are blurred"]')
    advice = job.make(job_folder).read_text().partition("what would help</h2>")[2].partition("</ul>")[0]
    assert (
        "The view b shows 40 % of the part that is made up." in advice
        and "to_paint/b.png" in advice
        and "painted/b.png" in advice
    )
    assert advice.count("<li>") == 2 and "the photographs are blurred" in advice


def test_a_job_that_failed_is_still_reported(job_folder):
    """No plan is recorded, so the report of the variant uses the stages of the scene's own run that exist."""
    for stage in ("distill", "evaluate"):
        shutil.rmtree(job_folder / stage)
    assert "in 1 stages. It is not evaluated yet." in job.make(job_folder.with_name("toy@bad")).read_text()


@pytest.mark.parametrize("width", [1280, 390])
def test_the_report_is_walked_through_in_a_browser(compared_project, job_folder, width):
    record_plan(compared_project, job_folder.parent)
    with open_page(job.make(job_folder).as_uri(), width) as page:
        view, left, right = page.locator(".compare select").all()
        names = [option.inner_text() for option in view.locator("option").all()]
        visible_views = lambda: [pair.get_attribute("data-view") for pair in page.locator(".pair:visible").all()]
        assert len(names) > 1 and visible_views() == names[:1]
        page.get_by_label("next view").click()
        assert visible_views() == [names[1]]
        first = "document.querySelector('.pair:not([hidden])')"
        at = lambda: float(page.evaluate(f"{first}.style.getPropertyValue('--at')").rstrip("%"))
        stage = page.locator(".pair:visible .stage").bounding_box()
        page.mouse.click(stage["x"] + 0.8 * stage["width"], stage["y"] + 0.5 * stage["height"])
        assert at() == pytest.approx(80, abs=4)
        right.select_option(left.input_value())
        assert page.locator(".pair:visible img.left.right").count() == 1
        assert page.evaluate("document.documentElement.scrollWidth") <= width, "nothing is wider than the screen"

"""Report on a scene's job: errors against time, seconds, pictures, and skipped stages with the reasons.

A *job* is all stages of one scene, or of one variant of a scene, that have run.

python -m report.job --scene X --runs runs          runs/X/report.html, one file
python -m report.job --data FOLDER --runs runs      runs/report/index.html, of all scenes in the folder
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from tempfile import TemporaryDirectory

from reffusion.io.arrays import load_json
from reffusion.io.scene import load_warnings
from report import (
    before_after,
    cli,
    coverage,
    inline_images,
    job_parameters,
    job_pictures,
    page,
    scenes_page,
    trace_charts,
    verdict,
)
from report.job_data import JobFiles, load_job
from report.sheet import scene_home

WORDS = {
    "skip": "left\u00a0out", "provided": "brought", "cached": "done", "run": "to\u00a0run", "stale": "to\u00a0run",
    "missing": "cannot\u00a0run", "pending": "pending",
}  # fmt: skip
STYLE = """
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(14rem, 46%), 1fr)); gap: .6rem }
.grid figure { margin: 0; break-inside: avoid } .grid img { width: 100%; margin: 0 }
figcaption { overflow-wrap: anywhere }
img.chart { max-width: none; width: max(100%, 40rem) } summary { cursor: pointer; padding: .4rem 0; color: #0a5a8c }
td.bar { background: linear-gradient(#bcd9ec, #bcd9ec) no-repeat left; min-width: 6rem; print-color-adjust: exact }
@media print { img.chart { width: 100% } .wide { overflow: visible } }
"""
RESULTS = {
    "evaluate/scene.ply": "the result as Gaussians, in the scene's own frame",
    "evaluate/renders": "renders of the result",
    "evaluate/metrics.json": "scores, with their protocol",
    "evaluate/per_view.csv": "scores of every view",
    "evaluate/side_by_side": "with the object, ground truth, result",
    "reference/references": "the references",
    "personalize/pytorch_lora_weights.safetensors": "LoRA of the prior",
    "fit/gaussians.ply": "the scene with the object, normalized frame",
}


def make(home: Path) -> Path:
    """Write the report of a job to `home`/report.html and return its path. The page needs no other file.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>.

    Raises:
        ValueError: no stage has been done.
    """
    job = load_job(home)
    with TemporaryDirectory() as charts:
        curves = whole_job_section(job, Path(charts)) + stage_sections(job, Path(charts))
    parts = [
        page.heading(home.name, 1),
        *([page.paragraph(" ".join(sentences))] if (sentences := verdict.describe_result(job)) else []),
        *unfinished_note(job),
        *before_after.before_after_section(job),
        *result_section(job),
        *advice_section(job),
        *job_pictures.masks_section(job),
        *job_pictures.references_section(job),
        *files_section(job),
        page.folded("Depth, before and after", job_pictures.depth_section(job)),
        page.folded("What was covered", coverage.coverage_section(job)),
        page.folded("Errors against seconds", curves),
        *([page.folded("What was left out or taken over, and why", skipped_section(job))] if job.plan else []),
        page.folded("Parameters other than their defaults", job_parameters.parameters_section(job)),
        page.folded("Seconds, memory and machine of each stage", receipts_section(job)),
        page.folded("To do it again", job_parameters.reproduce_section(job)),
    ]
    path = home / "report.html"
    title = f"{home.name}: what was done"
    path.write_text(page.document(title, parts, STYLE + before_after.STYLE, before_after.SCRIPT), encoding="utf-8")
    return path


def summarize_result(job: JobFiles) -> str:
    """Return one sentence on the result: number of Gaussians, mean scores in the box, as far as known.

    The sentence also names views that are scored although their photographs contradict their poses.
    """
    mean, counts = job.metrics.get("mean", {}), job.metrics.get("gaussians", {})
    if not job.metrics:
        return "It is not evaluated yet."
    count = counts.get(job.metrics.get("result"))
    gaussians = f"{count:,} Gaussians" if count else "The result"
    if mean.get("psnr_box") is None:
        return f"{gaussians}; no ground truth, so no scores."
    suspects = ", ".join(job.metrics.get("suspects") or ())
    warning = f"; photographs that contradict their poses: {suspects}" if suspects else ""
    return (
        f"{gaussians}; {mean['psnr_box']:.2f} dB and FLIP {mean['flip_box']:.3f} in the box of the test views{warning}."
    )


# --------------------------------------------------------------------------------------------------------- sections


def unfinished_note(job: JobFiles) -> list[str]:
    """Return a paragraph with the names of the stages that still have to run; empty if there are none.

    Without a recorded plan only the stages `poses`, `fit` and `evaluate` are considered.
    """
    due = [stage for stage, entry in job.plan.items() if entry["word"] not in ("cached", "skip", "provided")]
    if not job.plan:
        due = [stage for stage in ("poses", "fit", "evaluate") if stage not in job.folders]
    return [page.paragraph(f"Still to run, or to run again: {', '.join(due)}.")] if due else []


def result_section(job: JobFiles) -> list[str]:
    """Return HTML parts with the job's time, one sentence on the result, and the scores, if there are any."""
    seconds = sum(receipt["seconds"] for receipt in job.receipts.values())
    done = f"{page.format_duration(seconds)} in {len(job.receipts)} stages"
    return [page.paragraph(f"{done}. {summarize_result(job)}"), *score_table(job)]


def advice_section(job: JobFiles) -> list[str]:
    """Return the section on what would make the result better, and on what the capture lacks; may be empty.

    It has what the user can paint or mark (`verdict.give_advice`), notes on the frames of a video and on structure
    from motion, and the warnings of all stages.
    """
    record = scene_home(job.home) / "frames" / "frames.json"
    lines = verdict.give_advice(job) + ([load_json(record)["said"]] if record.is_file() else [])
    if "poses" in job.folders:
        sfm = job.folders["poses"] / "sfm.json"
        lines += [load_json(sfm)["summary"]] if sfm.is_file() else []
    lines += [line for folder in job.folders.values() for line in load_warnings(folder)]
    return [page.heading("What to know, and what would help"), page.bullets(lines)] if lines else []


def whole_job_section(job: JobFiles, out: Path) -> list[str]:
    """Return HTML parts with the chart of the whole job over time.

    Args:
        out: folder for the chart's file.
    """
    draw_job(job, out / "job.png")
    parts = [
        inline_images.chart_element(out / "job.png", "PSNR and stages against seconds"),
    ]
    if any(stage in job.traces for stage in ("fit", "distill")):
        words = (
            "Curves: each stage's own error, on training views or references. Test views are scored only at the end."
        )
        parts.append(page.paragraph(words, quiet=True))
    return parts


def draw_job(job: JobFiles, path: Path, ceiling: float | None = None) -> None:
    """Draw the PSNR and the stages of a job against seconds into the PNG `path`.

    Curves are those of the stages' traces. Points are means over the test views in the box of the object, of the
    initialization and of the result. Below them each stage's time is a bar.

    Args:
        ceiling: PSNR in dB of a dashed line, see `trace_charts.draw_job_chart`.
    """
    seconds = {stage: receipt["seconds"] for stage, receipt in job.receipts.items()}
    lines = {stage: series.get("", []) for stage, series in job.traces.items()}
    result = job.metrics.get("result", "")
    box = {"initialize": job.metrics.get("initialize", {}).get("psnr_box")}
    box |= {result: job.metrics.get("mean", {}).get("psnr_box")}
    trace_charts.draw_job_chart(seconds, {stage: own for stage, own in lines.items() if own}, box, path, ceiling)


def score_table(job: JobFiles) -> list[str]:
    """Return HTML parts with a table of mean scores over the test views; empty without scores.

    The rows are the initialization, if it was scored, and the result.
    """
    after, initial = job.metrics.get("mean", {}), job.metrics.get("initialize", {})
    names = [name for name, value in after.items() if value is not None]
    if not names:
        return []
    lines = [
        [title, *(page.format_number(values.get(n), 2 if "psnr" in n else 4) for n in names)]
        for title, values in (("initialization", initial), ("result", after))
        if any(values.get(name) is not None for name in names)
    ]
    return [page.table(["mean over test views", *names], lines)]


def stage_sections(job: JobFiles, out: Path) -> list[str]:
    """Return headings and charts of all stages with a trace, and the reasons why traces could not be read.

    Args:
        out: folder for the charts' files.
    """
    parts = []
    for stage, series in job.traces.items():
        path = out / f"{stage}.png"
        if names := trace_charts.draw_stage_chart(stage, series, path):
            parts += [
                page.heading(f"{stage}: error against seconds", 3),
                inline_images.chart_element(path, ", ".join(names)),
            ]
    parts += [page.paragraph(f"Not drawn: {why}", quiet=True) for why in job.unread]
    return parts


def skipped_section(job: JobFiles) -> list[str]:
    """Return HTML parts with a table of stages and reasons, by the recorded plan.

    The stages are those that were skipped, are provided by the scene, or still have to run or cannot run, and finished
    stages with a remark.
    """
    rows = [
        [stage, WORDS.get(entry["word"], entry["word"]), "; ".join([entry["reason"], *entry["notes"]])]
        for stage, entry in job.plan.items()
        if entry["word"] != "cached" or entry["reason"]
    ]
    return [page.table(["stage", "", "reason"], rows, text=(1, 2))] if rows else [page.paragraph("Nothing.")]


def receipts_section(job: JobFiles) -> list[str]:
    """Return HTML parts with a table of seconds, memory and machine of each stage, and the versions of libraries.

    The seconds of a stage that was resumed are those of its last try only; the table says so.
    """
    total = sum(receipt["seconds"] for receipt in job.receipts.values())
    rows = []
    for stage, r in job.receipts.items():
        share = f"{100 * r['seconds'] / total:.0f}%" if total else "–"
        resumed = "last try only" if r.get("resumed") else ""
        place = [r.get("device", "cpu"), r.get("machine", ""), r["profile"], r.get("date", "")[:16].replace("T", " ")]
        rows.append([stage, f"{r['seconds']:.1f}", share, f"{r['peak_memory_mb']:,}", *place, resumed])
    header = ["stage", "seconds", "share", "peak MB", "device", "machine", "profile", "made", ""]
    versions = {name: v for r in job.receipts.values() for name, v in r.get("versions", {}).items()}
    with_versions = ", ".join(f"{name} {version}" for name, version in versions.items())
    table = page.table(header, rows, text=(4, 5, 6, 7, 8))
    return [table, page.paragraph(f"With {with_versions}.", quiet=True) if with_versions else ""]


def files_section(job: JobFiles) -> list[str]:
    """Return the section with links to the result files that exist, relative to `job.home`."""
    targets = {"turntable.webm: video around the capture": "turntable.webm"}
    targets = targets if (job.home / "turntable.webm").is_file() else {}
    for name, words in RESULTS.items():
        stage, rest = name.split("/")
        path = job.folders.get(stage, Path()) / rest
        if stage in job.folders and path.exists():
            targets[f"{name}: {words}"] = os.path.relpath(path, job.home)
    return [page.heading("Files"), page.links(targets)]


@cli.command
def main() -> None:
    """Run `reffusion report`: write the report of a scene, or of all scenes in a folder, and print its path."""
    parser = argparse.ArgumentParser(prog="reffusion report", description=__doc__.split("\n")[0])
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--scene", type=Path, help="name of the scene, or path of its folder")
    what.add_argument("--data", type=Path, help="a folder of scenes")
    parser.add_argument("--variant", default="", help="variant of the scene")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    arguments = parser.parse_args()
    suffix = f"@{arguments.variant}" if arguments.variant else ""
    if arguments.scene:
        print(make(cli.run_folder(arguments)))
        return
    folders = sorted(path for path in arguments.data.iterdir() if path.is_dir()) if arguments.data.is_dir() else []
    homes = [home for path in folders if (home := arguments.runs / (path.name + suffix)).is_dir()]
    if not homes:
        raise ValueError(f"data={arguments.data}: none of its scenes has a folder in {arguments.runs}")
    print(scenes_page.make([load_job(home) for home in homes], arguments.runs / f"report{suffix}"))


if __name__ == "__main__":
    main()

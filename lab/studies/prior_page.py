"""Page of the measurements of `lab/studies/prior.py`: tables, charts and sheets of pictures.

The benchmark measures the diffusion prior on holes at three *scales*: the reference's own hole (`reference`), whole
unseen views (`whole`), and windows around the hole in unseen views (`window`). It does so before and after the prior is
personalized to the reference.

python -m lab.studies.prior_page runs/prior-report
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.io.arrays import load_json, save_text
from reffusion.io.images import load_image, save_image
from report import charts, cli, page
from report.sheet import compose_sheet, enlarge

ENLARGE = 3  # whole factor; held-out pictures have 64 px
SCALES = ("reference", "whole", "window")
SHEETS = {
    "inpainting": "Held-out pictures, filled",
    "photographs": "Held-out photographs, whole and in windows, filled",
    "reference": "The reference's own hole, filled from pure noise three times, before and after personalization",
    "whole": "Unseen views of the scene, whole, before and after personalization",
    "window": "Unseen views, windows around the hole",
}
SCORES = {"psnr": "PSNR, dB", "ssim": "SSIM", "flip": "FLIP", "energy": "gradient energy", "lpips": "LPIPS"}


def make(folder: Path) -> Path:
    """Write prior.md, sheets and charts into the benchmark's folder; return the page's path.

    Raises:
        ValueError: the folder has no measurements (prior.json).
    """
    if not (folder / "prior.json").exists():
        raise ValueError(f"{folder / 'prior.json'}: missing; first `python -m lab.studies.prior --out {folder}`")
    measured = load_json(folder / "prior.json")
    lines = [f"# {measured['prior']}, measured", ""]
    for name in ("inpainting", "photographs"):
        if name in measured:
            lines += [inpainting_table(measured[name]["scores"])]
            lines += save_sheet(folder, name, measured[name]["columns"])
    if measured.get("sampler"):
        lines += ["## Numbers of sampler steps", "", sampler_table({"held out": measured["sampler"]})]
    if "personalization" in measured:
        personal = measured["personalization"]
        save_charts(personal, folder / "charts.png")
        lines += ["## Personalization", "", personalization_table(personal), "![](charts.png)", ""]
        lines += ["Every seed's samples:", "", seeds_table(personal["seeds"])]
        if personal["sampler"]["reference"]:
            lines += ["Personalized, with other numbers of sampler steps:", "", sampler_table(personal["sampler"])]
        for scale in SCALES:
            lines += save_sheet(folder, scale, personal["columns"])
    save_text(folder / "prior.md", "\n".join(lines))
    return folder / "prior.md"


def save_sheet(folder: Path, name: str, columns: list[str]) -> list[str]:
    """Join the rows of pictures in the folder `folder`/`name` into `folder`/`name`.png.

    Args:
        columns: titles of the columns. Each file in the folder is one row of as many pictures of equal width.

    Returns:
        Lines in Markdown that show the sheet.
    """
    paths = sorted((folder / name).glob("*.png"))
    rows = [np.split(load_image(path), len(columns), 1) for path in paths]
    cells = [[enlarge(picture, ENLARGE) for picture in row] for row in rows]
    save_image(folder / f"{name}.png", compose_sheet(cells, columns, [path.stem for path in paths]))
    return [f"## {SHEETS[name]}", "", f"![]({name}.png)", ""]


def inpainting_table(scores: dict[str, dict[str, dict[str, float]]]) -> str:
    """Return a Markdown table of scores inside the hole, with a row for each kind of picture and method.

    Args:
        scores: method -> kind of picture -> scores (keys of `SCORES`, "psnr_error" and "pictures", their number).
    """
    rows = []
    kinds = dict.fromkeys(kind for by_kind in scores.values() for kind in by_kind)
    for kind in kinds:
        for name, by_kind in scores.items():
            row = by_kind[kind]
            rows.append([f"{kind}: {name}", str(row["pictures"]), *format_scores(row)])
    return page.markdown_table(["inside the hole", "pictures", *SCORES.values()], rows)


def format_scores(row: dict[str, float]) -> list[str]:
    """Return the `SCORES` of a row as texts; PSNR with its standard error."""
    psnr = f"{row['psnr']:.2f} ± {row['psnr_error']:.2f}"
    return [psnr if column == "psnr" else f"{row[column]:.3f}" for column in SCORES]


def personalization_table(personal: dict[str, Any]) -> str:
    """Return a Markdown table of errors and scores at each scale, before and after personalization.

    The clean-latent error and the variance of the SDS gradient are means over all measured timesteps.

    Args:
        personal: the entry "personalization" of prior.json.
    """
    rows = []
    for scale in SCALES:
        for when, row in personal[scale].items():
            figures = [f"{np.mean(row[key]):.4f}" for key in ("error", "variance")]
            rows.append([f"{scale}, {when}", *figures, *format_scores(row["samples"])])
    header = [f"holes, {personal['steps']} steps", "clean-latent error", "variance of the SDS gradient"]
    return page.markdown_table([*header, *SCORES.values()], rows)


def sampler_table(by_name: dict[str, dict[str, dict[str, float]]]) -> str:
    """Return a Markdown table with a row for each set of holes and number of sampler steps.

    Args:
        by_name: set of holes -> number of steps -> scores and "seconds" per picture.
    """
    rows = [
        [f"{name}, {count}", *format_scores(row), f"{1000 * row['seconds']:.0f}"]
        for name, by_count in by_name.items()
        for count, row in by_count.items()
    ]
    return page.markdown_table(["holes, sampler steps", *SCORES.values(), "CPU ms each"], rows)


def seeds_table(seeds: dict[str, dict[str, Any]]) -> str:
    """Return a Markdown table with the mean and the range of scores over seeds, with a row for each scale and state.

    The states are before personalization, after, and after personalization to a wrong reference. A state that was not
    measured with every seed is left out.

    Args:
        seeds: seed -> state ("before", "after", "wrong") -> scale -> scores.
    """
    table = []
    whens = [when for when in ("before", "after", "wrong") if all(when in scores for scores in seeds.values())]
    for scale in SCALES:
        for when in whens:
            rows = [scores[when][scale] for scores in seeds.values()]
            cells = [format_range([row[column] for row in rows], 2 if column == "psnr" else 3) for column in SCORES]
            table.append([f"{scale}, {when}", *cells])
    header = [f"holes, {len(seeds)} seeds: mean (lowest to highest)", *SCORES.values()]
    return page.markdown_table(header, table)


def format_range(values: list[float], digits: int) -> str:
    """Return the mean as text, followed by the range from the lowest to the highest value if there are several."""
    mean = f"{np.mean(values):.{digits}f}"
    return f"{mean} ({min(values):.{digits}f} to {max(values):.{digits}f})" if len(values) > 1 else mean


def save_charts(personal: dict[str, Any], path: Path) -> None:
    """Draw the clean-latent error against personalization steps, and error and SDS variance against the timestep.

    The first chart is for the reference's own hole, the others are for unseen views before and after personalization.

    Args:
        personal: the entry "personalization" of prior.json.
        path: PNG to write.
    """
    figure, grid = charts.new_figure(3.2, 1, 3)
    left, *others = grid[0]
    steps = [row["iteration"] for row in personal["trace"]]
    left.plot(steps, [row["clean_latent_mse"] for row in personal["trace"]], "k.-")
    left.set(
        title="the reference's own hole", xlabel="personalization step", ylabel="clean-latent error", ylim=(0, None)
    )
    for axes, key, title in zip(others, ("error", "variance"), ("clean-latent error", "variance of SDS"), strict=True):
        for scale, style in (("whole", "-"), ("window", "--")):
            for when, color in (("before", "tab:grey"), ("after", "tab:blue")):
                values = personal[scale][when][key]
                axes.plot(personal["timesteps"], values, style, color=color, label=f"{scale}, {when}")
        axes.set(title=f"{title}, unseen views", xlabel="timestep", ylim=(0, None))
    others[0].legend(fontsize="small")
    charts.save_chart(figure, path)


@cli.command
def main() -> None:
    """Write the page of the measurements in a folder, and print its path."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="what lab/studies/prior.py wrote to")
    print(make(parser.parse_args().folder))


if __name__ == "__main__":
    main()

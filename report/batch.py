"""Page of a batch: runs/results.html, one row per scene with its scores or the reason of its failure, and a picture.

A batch runs all scenes of a folder and records them in runs/results.json. `make data=FOLDER batch` writes this page at
its end.

python -m report.batch --runs runs
"""

from __future__ import annotations

import argparse
from html import escape
from pathlib import Path
from typing import Any

from reffusion.io.arrays import load_json
from reffusion.io.images import load_image
from report import cli, inline_images, page
from report.compare import DIGITS, SHORT

LONGEST = 240  # longer side of a picture, px
MAX_PICTURES = 200  # more pictures would make a page of tens of MB


def make(record: Path) -> Path:
    """Write the page of a batch beside the batch's record, and return the page's path.

    The page has the name of the record with the ending .html. Pictures are embedded in the page, and each scene's name
    links to the scene's report.html if this file exists.

    Args:
        record: runs/results.json, or runs/results@<variant>.json.

    Raises:
        ValueError: the record does not exist, because no batch has been run.
    """
    if not record.is_file():
        raise ValueError(f"{record} is missing; `make data=FOLDER batch` writes it")
    results = load_json(record)
    runs = results["runs"]
    names = [name for name in SHORT if any(run.get("mean", {}).get(name) is not None for run in runs)]
    states = [run["state"] for run in runs]
    count = f"{states.count('done')} of {len(runs)} scenes done, {states.count('failed')} failed"
    parts = [page.heading(f"Batch of {Path(results['data']).name}", 1), page.paragraph(count)]
    header = ["scene", *(SHORT[name] for name in names), "seconds", ""]
    lines = [_line(run, names, record.parent, number < MAX_PICTURES) for number, run in enumerate(runs)]
    head = "".join(f"<th>{escape(word)}</th>" for word in header)
    parts.append(f'<div class="wide"><table><tr>{head}</tr>{"".join(lines)}</table></div>')
    parts.append(
        page.paragraph("Scores: means over the test views, in the box around the mask. Seconds: of this call.", True)
    )
    path = record.with_suffix(".html")
    path.write_text(page.document("Batch", parts), encoding="utf-8")
    return path


def _line(run: dict[str, Any], names: list[str], runs: Path, with_picture: bool) -> str:
    """Return a table row of the scores `names`, seconds and picture, or of the state or error if a run is not done."""
    name, home = escape(run["scene"]), run.get("home", run["scene"])
    if (runs / home / "report.html").is_file():
        name = f'<a href="{escape(home)}/report.html">{name}</a>'
    if run["state"] == "done":
        mean = run.get("mean", {})
        cells = [page.format_number(mean.get(each), DIGITS.get(each, 4)) for each in names]
        middle = "".join(f"<td>{cell}</td>" for cell in [*cells, page.format_number(run.get("seconds"))])
    else:
        reason = f"failed: {run['error']}" if run["state"] == "failed" else run["state"]
        middle = f'<td class="text" colspan="{len(names) + 1}">{escape(reason)}</td>'
    image = _picture(runs / home, run["scene"]) if with_picture and run["state"] == "done" else ""
    return f"<tr><td>{name}</td>{middle}<td>{image}</td></tr>\n"


def _picture(home: Path, scene: str) -> str:
    """Return the result's first rendered view by name, reduced to `LONGEST` px, as an `img` element; "" without one."""
    first = next(iter(sorted((home / "evaluate" / "renders").glob("*.png"))), None)
    if first is None:
        return ""
    return f'<img src="{inline_images.photo_address(load_image(first), LONGEST)}" alt="{escape(scene)}">'


@cli.command
def main() -> None:
    """Run `reffusion batch-page`: write the page of a batch, and print its path."""
    parser = argparse.ArgumentParser(prog="reffusion batch-page", description=__doc__.split("\n")[0])
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--variant", default="", help="of the scenes")
    arguments = parser.parse_args()
    end = f"@{arguments.variant}" if arguments.variant else ""
    print(make(arguments.runs / f"results{end}.json"))


if __name__ == "__main__":
    main()

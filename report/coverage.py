"""Section of the report on coverage: which shares of the removed object's pixels are made up, or stay uncovered.

*Made up* are the pixels of the invent mask I, whose content the reference and the diffusion prior decide. *Uncovered*
are pixels where the Gaussians after the stage `initialize` are still partly transparent (alpha below 0.9). *Mask* means
the consistent mask C, the pixels of a training view that show the removed object.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

from reffusion.io.images import load_mask
from report import page
from report.job_data import JobFiles
from report.results import load_view_scores

HEADER = ("view", "mask, of the picture", "made up, of the mask", "uncovered, of the mask")
MIN_UNCOVERED = 0.01  # a view is listed if a larger share is uncovered or unseen; `initialize` warns of the same views


def coverage_section(job: JobFiles) -> list[str]:
    """Return HTML parts: a summary, a table of the shares of all views, and a note on unseen pixels."""
    shares = view_shares(job)
    if not shares:
        return [page.paragraph("Not known yet: the stage `masks` has not run.")]
    covered = any(open_ is not None for _, _, open_ in shares.values())
    text = (
        f"{_mean([made for _, made, _ in shares.values()]):.0%} of the removed region is made up, averaged over views"
    )
    if covered:
        uncovered = [name for name, (_, _, open_) in shares.items() if (open_ or 0) > MIN_UNCOVERED]
        text += f"; uncovered places: in {len(uncovered)} views" + (
            f", {', '.join(uncovered[:8])}" if uncovered else ""
        )
    else:
        text += "; what stays uncovered is known after the stage `initialize`"
    rows = sorted(shares.items(), key=lambda each: (-(each[1][2] or 0), -each[1][1]))
    table = _table([(name, values) for name, values in rows])
    parts = [page.paragraph(f"{text}."), f"<details><summary>all {len(rows)} views</summary>{table}</details>"]
    return parts + _unseen(job)


def view_shares(job: JobFiles) -> dict[str, tuple[float, float, float | None]]:
    """Return three shares in [0, 1] for each view with a non-empty consistent mask, sorted by name.

    Returns:
        View name -> (the mask's share of the picture, the made-up share of the mask, the uncovered share of the mask).
        The first two are computed from the masks on disk, the last one is read from the facts of the stage `initialize`
        and None before this stage. The dictionary is empty before the stage `masks`.
    """
    masks, open_ = job.folders.get("masks", Path()), job.facts("initialize").get("uncovered", {})
    shares = {}
    for path in sorted((masks / "consistent").glob("*.png")) if "masks" in job.folders else ():
        hidden, invent = load_mask(path), load_mask(masks / "invent" / path.name)
        if hidden.any():
            shares[path.stem] = (hidden.mean(), (invent & hidden).sum() / hidden.sum(), open_.get(path.stem))
    return shares


def _mean(values: list[float]) -> float:
    """Return the mean of at least one value."""
    return sum(values) / len(values)


def _table(rows: list[tuple[str, tuple[float, float, float | None]]]) -> str:
    """Return an HTML table of (view, its three shares), a row each."""
    lines = ["<tr>" + "".join(f"<th>{words}</th>" for words in HEADER) + "</tr>"]
    for name, shares in rows:
        cells = "".join(_bar(share) for share in shares)
        lines.append(f"<tr><td>{escape(name)}</td>{cells}</tr>")
    return f'<div class="wide"><table>{"".join(lines)}</table></div>'


def _bar(share: float | None) -> str:
    """Return a table cell with a share in [0, 1] as a percentage on a bar, or with a dash if the share is None."""
    if share is None:
        return "<td>–</td>"
    part = f"{min(100 * share, 100):.1f}%"
    return f'<td class="bar" style="background-size: {part} 100%">{100 * share:.1f} %</td>'


def _unseen(job: JobFiles) -> list[str]:
    """Return a paragraph on test views with over 1 % of pixels outside the mask unseen in training; [] if none."""
    rows = load_view_scores(job.folders["evaluate"] / "per_view.csv") if "evaluate" in job.folders else {}
    shares = {name: row["unseen_share"] for name, row in rows.items() if row.get("unseen_share", 0) > MIN_UNCOVERED}
    if not shares:
        return []
    listed = ", ".join(f"{name} {share:.0%}" for name, share in sorted(shares.items(), key=lambda s: -s[1])[:12])
    words = f"Pixels outside the mask that no training view saw, in {len(shares)} of {len(rows)} test views:"
    return [page.paragraph(f"{words} {listed}.")]

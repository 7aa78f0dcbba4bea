"""Building blocks of plain HTML pages, which load neither fonts nor other content from the network."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path

STYLE = """
body { font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #222; max-width: 60rem }
body { margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.6rem; margin-bottom: .2rem } h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem }
table { border-collapse: collapse; font-size: .85rem; font-variant-numeric: tabular-nums; margin: .6rem 0 }
th, td { padding: .25rem .6rem; text-align: right; border-bottom: 1px solid #ddd; vertical-align: top }
th, td { white-space: nowrap } th:first-child, td:first-child { text-align: left; padding-left: 0 }
th { font-weight: 600; border-bottom: 1px solid #888 }
.text { text-align: left !important; white-space: normal } tr.ours td { background: #eef5fa }
img { max-width: 100%; display: block; margin: .4rem 0 } p, li { max-width: 50rem }
@media (max-width: 40rem) { body { margin: 1rem auto } th, td { padding: .2rem .4rem } .text { min-width: 9rem } }
@media print { body { max-width: none; margin: 0; font-size: 11pt }
  h2 { break-after: avoid } img { break-inside: avoid } }
.wide { overflow-x: auto } .quiet { color: #666; font-size: .9rem } a { color: #0a5a8c } li { overflow-wrap: anywhere }
pre { white-space: pre-wrap; overflow-wrap: anywhere; font-size: .85rem; background: #f3f3f3; padding: .6rem }
"""


def document(title: str, body: Sequence[str], style: str = "", script: str = "") -> str:
    """Return a whole HTML page.

    Args:
        title: plain text.
        body: parts of the body, HTML.
        style: CSS to add after `STYLE`.
        script: JavaScript to run at the end of the page.
    """
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    head += f"<title>{escape(title)}</title><style>{STYLE}{style}</style>"
    top = f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>'
    end = [f"<script>{script}</script>"] if script else []
    return "\n".join([top, *body, *end, "</body></html>\n"])


def heading(text: str, level: int = 2) -> str:
    """Return an HTML heading of plain text."""
    return f"<h{level}>{escape(text)}</h{level}>"


def folded(title: str, parts: Sequence[str]) -> str:
    """Return a section of a page that is closed until the reader opens it.

    Args:
        title: plain text, always visible.
        parts: the content, HTML.
    """
    return "\n".join([f"<details><summary><b>{escape(title)}</b></summary>", *parts, "</details>"])


def paragraph(text: str, quiet: bool = False) -> str:
    """Return an HTML paragraph of plain text; `quiet` is small and gray."""
    return f'<p class="quiet">{escape(text)}</p>' if quiet else f"<p>{escape(text)}</p>"


def bullets(texts: Sequence[str]) -> str:
    """Return an HTML list of plain texts; "" without texts."""
    return "<ul>" + "".join(f"<li>{escape(text)}</li>" for text in texts) + "</ul>" if texts else ""


def table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    bold: Sequence[Sequence[bool]] = (),
    text: Sequence[int] = (),
    marked: int | None = None,
) -> str:
    """Return an HTML table.

    Args:
        header: plain text, one cell per column.
        rows: plain text, [rows][columns].
        bold: [rows][columns], True for cells in bold type; empty for none.
        text: indices of the columns with words, which are aligned to the left.
        marked: index of the row with a colored background; None for no row.
    """
    alignment = lambda column: ' class="text"' if column in text else ""
    lines = ["<tr>" + "".join(f"<th{alignment(n)}>{escape(cell)}</th>" for n, cell in enumerate(header)) + "</tr>"]
    for number, row in enumerate(rows):
        cells = []
        for column, cell in enumerate(row):
            inside = f"<b>{escape(cell)}</b>" if bold and bold[number][column] else escape(cell)
            cells.append(f"<td{alignment(column)}>{inside}</td>")
        lines.append(("<tr class=ours>" if number == marked else "<tr>") + "".join(cells) + "</tr>")
    return '<div class="wide"><table>\n' + "\n".join(lines) + "\n</table></div>"


def picture(path: Path, alt: str, embed: bool = False) -> str:
    """Return the HTML element of a PNG file.

    Args:
        embed: True puts the file's content into the page. False refers to the file by name, beside the page.
    """
    source = f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}" if embed else escape(path.name)
    return f'<img src="{source}" alt="{escape(alt)}">'


def code(line: str) -> str:
    """Return a command line as a preformatted HTML block that can be copied."""
    return f"<pre><code>{escape(line)}</code></pre>"


def links(targets: dict[str, str]) -> str:
    """Return an HTML list of links from {link text, plain: relative address}."""
    lines = [f'<li><a href="{escape(to)}">{escape(name)}</a></li>' for name, to in targets.items()]
    return "<ul>" + "".join(lines) + "</ul>"


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; `|` in a cell is replaced by `/`."""
    lines = [header, ["---"] * len(header), *rows]
    return "".join("| " + " | ".join(cell.replace("|", "/") for cell in line) + " |\n" for line in lines)


def format_number(value: float | None, digits: int = 0) -> str:
    """Return a number as text with `digits` decimals and commas between thousands, or a dash for None."""
    return "–" if value is None else f"{value:,.{digits}f}"


def format_duration(seconds: float | None) -> str:
    """Return a duration as text, e.g. "48 s", "5 min 20 s" or "1 h 5 min", or a dash for None."""
    if seconds is None:
        return "–"
    if seconds < 100:
        return f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"

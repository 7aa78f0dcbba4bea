"""Run all cases, print a table and write a JSON file. The exit status is 1 if a case is out of its bound or raises.

python -m lab.stability [--out runs/stability.json] [--only TEXT]    (TEXT: a part of the names of cases)
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import torch

from lab.stability import Row, all_cases, run


def format_row(row: Row) -> str:
    """Return a row of the printed table."""
    measured = "failed" if row.measured is None else f"{row.measured:.3g}"
    return f"{'ok ' if row.ok else 'BAD'} {row.case:<58} {measured:>10} <= {row.bound:<9.3g} {row.quantity}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/stability.json"))
    parser.add_argument("--only", default="", help="only cases whose name contains this")
    arguments = parser.parse_args()
    cases = [case for case in all_cases() if arguments.only in case.name]
    if not cases:
        parser.error(f"no case's name contains {arguments.only!r}")
    torch.set_num_threads(1)  # the scenes are so small that more threads gain nothing
    rows = []
    for case in cases:
        rows.append(run(case))
        print(format_row(rows[-1]), flush=True)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps([row._asdict() for row in rows], indent=1) + "\n")
    bad = [row.case for row in rows if not row.ok]
    print(f"{len(rows) - len(bad)} of {len(rows)} cases within bound; {arguments.out}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())

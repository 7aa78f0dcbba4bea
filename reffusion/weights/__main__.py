"""`python -m reffusion.weights`: downloads the weights of LPIPS if they are missing. `make` runs this once."""

from __future__ import annotations

import sys

from reffusion.weights.local import lpips_need


def main() -> None:
    """Download the weights of LPIPS if they are missing, and announce this in one line.

    A failure only prints a warning.
    """
    need = lpips_need()
    if need.problem is None:
        return
    print(f"fetching the weights of LPIPS, a score ({need.bytes / 1e6:.0f} MB, once)", flush=True)
    try:
        need.fetch()
    except ValueError as error:
        print(f"warning: scores are without LPIPS: {error}; `make weights` tries again", file=sys.stderr)


if __name__ == "__main__":
    main()

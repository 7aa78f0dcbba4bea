"""Check that this machine is ready for CUDA jobs. gsplat's extension is built if necessary, and loaded.

python -m lab.gpu.ready      (--before: only check whether installing gsplat makes sense)
"""

from __future__ import annotations

import argparse
import os
import sys
import time

import psutil

from reffusion.io.machine import Machine, detect, find_missing

COMPILER_GB = 1.0  # memory of one compiler process, GB; gsplat's largest file takes 0.85 GB


def refusal_reasons(machine: Machine, before_install: bool) -> list[str]:
    """Return the reasons why CUDA jobs cannot run on a machine, one line each; empty if they can.

    Args:
        machine: the machine.
        before_install: True if gsplat need not be installed yet.
    """
    if machine.driver is None and machine.gpu is None:
        return ["there is no NVIDIA driver on this machine: nothing to do; profile=laptop needs no GPU"]
    return find_missing(machine, splats=not before_install)


def compiler_jobs(cores: int, free_gb: float) -> int:
    """Return the number of compilers that may run at once, 1 to 8, by cores and free memory (GB)."""
    return max(1, min(8, cores, int(free_gb / COMPILER_GB)))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", action="store_true", help="check driver and torch only, load nothing")
    before = parser.parse_args().before
    if reasons := refusal_reasons(detect(), before):
        print(f"error: {'; '.join(reasons)}", file=sys.stderr)
        return 2
    if before:
        return 0
    os.environ.setdefault("MAX_JOBS", str(compiler_jobs(os.cpu_count() or 1, psutil.virtual_memory().available / 1e9)))
    began = time.monotonic()
    import torch

    if not torch.cuda.is_available():
        print("error: torch finds no GPU, though there is a driver: look at CUDA_VISIBLE_DEVICES", file=sys.stderr)
        return 2
    import gsplat
    from gsplat.cuda import _backend

    if _backend._C is None:
        print("error: gsplat's extension was not built; see its messages above", file=sys.stderr)
        return 2
    print(f"gsplat {gsplat.__version__} is ready on {torch.cuda.get_device_name()}: {time.monotonic() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())

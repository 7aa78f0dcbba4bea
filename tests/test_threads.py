"""The choice of the number of threads for a long computation on the CPU."""

import os
import subprocess
import sys
import time
from pathlib import Path

import torch

from reffusion.io.machine import idle_seconds
from reffusion.prior.threads import CALIBRATION_STEPS, MIN_STEPS, RECENT_STEPS, Threads

STEPS = 12


def record_parts(seconds, steps=MIN_STEPS, device="cpu", idle=time.perf_counter):
    """Run `STEPS` steps, and return the number of parallel parts in each step.

    Args:
        seconds: number of parts -> duration of a step in seconds.
        steps: number of steps that is announced.
        idle: function that returns the idle time of the cores in seconds.
    """
    before, found = torch.get_num_threads(), []
    torch.set_num_threads(2)
    try:
        with Threads(steps, torch.device(device), idle) as threads:
            for _ in range(STEPS):
                with threads.step():
                    found.append(threads.now)
                    of_torch = set(threads.map(lambda _: torch.get_num_threads(), range(4)))
                    assert of_torch == ({1} if steps >= MIN_STEPS and device == "cpu" else {2})
                    time.sleep(seconds[found[-1]])
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    return found


def test_all_threads_are_used_while_they_pay():
    assert record_parts({1: 0.1, 2: 0.0}) == [1] * CALIBRATION_STEPS + [2] * (STEPS - CALIBRATION_STEPS)


def test_one_thread_is_used_where_the_others_hold_it_up():
    assert record_parts({1: 0.0, 2: 0.1}) == [1] * CALIBRATION_STEPS + [2] * RECENT_STEPS + [1] * (
        STEPS - CALIBRATION_STEPS - RECENT_STEPS
    )


def test_a_core_that_others_use_is_left_to_them():
    assert record_parts({1: 0.01, 2: 0.0}, idle=lambda: 0.5 * time.perf_counter()) == [1] * STEPS
    assert record_parts({1: 0.1, 2: 0.0}, idle=lambda: float("inf"))[-1] == 2  # where the idle time is unknown
    assert 0 < idle_seconds() < float("inf")


def test_little_work_and_gpus_are_left_to_torch():
    assert (
        record_parts({1: 0.0, 2: 0.0}, steps=MIN_STEPS - 1)
        == [1] * STEPS
        == record_parts({1: 0.0, 2: 0.0}, device="meta")
    )


def test_the_benchmark_sets_one_thread_before_numpy_and_torch_are_loaded():
    """NumPy and PyTorch read the number once. With two threads, CPU seconds would include time spent waiting."""
    probe = """
import os, sys
class Watch:
    def find_spec(self, name, *_):
        if name in ("numpy", "torch"):
            print(name, os.environ.get("OMP_NUM_THREADS"), os.environ.get("OPENBLAS_NUM_THREADS"))
sys.meta_path.insert(0, Watch())
import lab.bench.__main__
"""
    others = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    root = Path(__file__).resolve().parent.parent
    done = subprocess.run(
        [sys.executable, "-c", probe], cwd=root, env=others, capture_output=True, text=True, check=True
    )
    assert sorted(set(done.stdout.splitlines())) == ["numpy 1 1", "torch 1 1"]

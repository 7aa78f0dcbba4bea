"""How many threads the steps of a long work on the CPU take."""

import time

import torch

from reffusion.prior.threads import MEASURED, RECENT, WORTH, Threads


def used(seconds, steps=WORTH, device="cpu", count=12):
    """The threads of each of `count` steps, which take `seconds[threads]`."""
    before, found = torch.get_num_threads(), []
    torch.set_num_threads(2)
    try:
        with Threads(steps, torch.device(device)) as threads:
            for done in range(count):
                with threads.step(done):
                    found.append(torch.get_num_threads())
                    time.sleep(seconds[found[-1]])
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    return found


def test_all_threads_are_used_while_they_pay():
    assert used({1: 0.02, 2: 0.002}) == [2] + [1] * len(MEASURED) + [2] * 9


def test_one_thread_is_used_where_the_others_hold_it_up():
    slow = len(MEASURED) + 1 + RECENT
    assert used({1: 0.002, 2: 0.02}) == [2] + [1] * len(MEASURED) + [2] * RECENT + [1] * (12 - slow)


def test_little_work_and_gpus_are_not_measured():
    assert used({1: 0.0, 2: 0.001}, steps=WORTH - 1) == [2] * 12 == used({1: 0.0, 2: 0.001}, device="meta")

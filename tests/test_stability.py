"""The stability suite: every case is within its bound, and every planted fault is caught."""

import json
import sys

import numpy as np
import pytest
import torch

from lab.stability import __main__ as command
from lab.stability import all_cases, random_scenes, run
from lab.stability.cases import Case
from lab.stability.faults import FAULTS, is_caught

CASES = {case.name: case for case in all_cases()}
LONG = [case.name for case in random_scenes.CASES]  # a tenth of their scenes runs here, all run in `make stability`
SCENES = 100


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("name", [name for name in CASES if name not in LONG])
def test_case(name):
    row = run(CASES[name])
    assert row.ok, f"{row.quantity}: {row.measured}, bound {row.bound}"


@pytest.mark.parametrize("case", random_scenes.CASES, ids=lambda case: case.name)
def test_a_tenth_of_the_random_scenes(case):
    *arguments, count = case.measure.args
    assert count == 10 * SCENES
    assert case.measure.func(*arguments, SCENES) <= case.bound


def test_names_are_unique():
    assert len(CASES) == len(all_cases())


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_fault_is_caught_and_gone_again(fault):
    assert is_caught(fault)
    assert run(CASES[fault.caught_by]).ok


def test_command_writes_the_table_and_fails_by_exit_code(tmp_path, monkeypatch, capsys):
    cases = [
        Case("fine", "of one", np.float64(1.0), lambda: np.float64(0.5)),
        Case("too much", "of one", 1.0, lambda: 2.0),
    ]
    cases += [Case("no number", "of one", 1.0, lambda: float("nan")), Case("raises", "of one", 1.0, lambda: 1 / 0)]
    monkeypatch.setattr(command, "all_cases", lambda: cases)
    out = tmp_path / "runs" / "stability.json"
    monkeypatch.setattr(sys, "argv", ["stability", "--out", str(out)])
    assert command.main() == 1
    rows = json.loads(out.read_text())
    assert [set(row) for row in rows] == [{"case", "quantity", "bound", "measured", "ok"}] * 4
    assert [(row["case"], row["measured"], row["ok"]) for row in rows] == [
        ("fine", 0.5, True), ("too much", 2.0, False), ("no number", None, False), ("raises", None, False)
    ]  # fmt: skip
    monkeypatch.setattr(sys, "argv", ["stability", "--out", str(out), "--only", "fine"])
    assert command.main() == 0 and "1 of 1 cases" in capsys.readouterr().out

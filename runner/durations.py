"""Expected durations of stages and jobs: from earlier runs of the scene, or else from the table `durations`.

The table of pipeline.yaml has rates of the CPU, measured on two cores. The receipts of other scenes on this machine
tell how much slower or faster this machine is. Durations on a GPU: gpu_costs.py.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from runner.files import MACHINE, read_receipt
from runner.keys import flatten_params
from runner.plan import TO_DO, Decision
from runner.resolve import ResolvedJob
from runner.text import format_seconds

CORES = 2  # cores on which the table was measured
PARALLEL_SHARE = 0.75  # share of a stage's time on one core that more cores divide among them
MAX_RECEIPTS = 200  # receipts that are read for the speed of this machine
PRIOR_SECONDS = 60  # the table's own weight beside the receipts, as if a machine as fast had worked for so long


def earlier_receipts(job: ResolvedJob, stage: str) -> list[dict[str, Any]]:
    """Return the receipts of a stage in the scene's own run and in its variants, as far as there are any."""
    places = [job.runs / job.base.name, *job.runs.glob(f"{job.base.name}@*")]
    return [receipt for place in places if (receipt := read_receipt(place / stage))]


def expected_seconds(job: ResolvedJob, stage: str) -> float | None:
    """Return the expected seconds of a stage on this machine; None if they are unknown.

    They are those of the last run of this scene or a variant of it, on this machine and with this profile. Of a run
    that was interrupted and resumed, that is the time of the last attempt alone. Before the first run they are those of
    the table, times the slowness of this machine.
    """
    here = [r for r in earlier_receipts(job, stage) if r.get("machine") == MACHINE and r.get("profile") == job.profile]
    if here:
        return max(here, key=lambda r: r["date"])["seconds"]
    typical = typical_seconds(job, stage)
    return None if typical is None else typical * _slowness(job)


def typical_seconds(job: ResolvedJob, stage: str) -> float | None:
    """Return the seconds of a stage by the table `durations`, on as many cores as this machine has.

    None if the table has no entry for the stage in this profile, the stage runs on a GPU, or the number of views is
    unknown.
    """
    rates = job.pipeline.durations.get(job.profile, {}).get(stage)
    capture = next((info.facts for info in job.stages.values() if "views" in info.facts), None)
    if rates is None or capture is None or job.params[stage].get("device") == "cuda":
        return None
    train, test, *_ = map(len, capture["views"])
    steps = flatten_params(job.params)[f"{stage}.{rates.steps}"] if rates.steps else 0
    seconds = rates.base + rates.view * train + rates.test * test + rates.step * steps
    seconds += 0 if capture["brings_poses"] else rates.placed * train
    cores = len(os.sched_getaffinity(0))
    return seconds * _relative_time(cores) / _relative_time(CORES)


def _relative_time(cores: int) -> float:
    """Return the time on `cores` cores as a share of that on one (Amdahl's law)."""
    return 1 - PARALLEL_SHARE + PARALLEL_SHARE / cores


def _slowness(job: ResolvedJob) -> float:
    """Return how many times longer stages take on this machine than the table says; 1 before the first stage."""
    paths = sorted(job.runs.glob("*/*/receipt.json"))[-MAX_RECEIPTS:]
    receipts = [receipt for path in paths if (receipt := read_receipt(path.parent))]
    known = [
        r for r in receipts if r.get("typical_seconds") and r.get("machine") == MACHINE and not r.get("resumed", False)
    ]
    seconds, typical = (sum(r[name] for r in known) + PRIOR_SECONDS for name in ("seconds", "typical_seconds"))
    return seconds / typical


def job_seconds(job: ResolvedJob, decisions: Mapping[str, Decision]) -> tuple[float, float] | None:
    """Return the least and the greatest expected seconds of a plan's stages that are still to run.

    The least omits the stages that ordinary scenes may leave out, which is not known yet.

    Returns:
        None if the duration of one of these stages is unknown.
    """
    least = greatest = 0.0
    for stage, decision in decisions.items():
        if decision.status not in TO_DO:
            continue
        seconds = expected_seconds(job, stage)
        if seconds is None:
            return None
        greatest += seconds
        least += 0.0 if decision.is_open else seconds
    return least, greatest


def format_range(seconds: tuple[float, float]) -> str:
    """Format a range of durations, as one duration if both ends read the same."""
    least, greatest = map(format_seconds, seconds)
    return greatest if least == greatest else f"{least} to {greatest}"

"""Expected durations of stages and jobs: from earlier runs of the scene, or else from the table `durations`.

The table of pipeline.yaml has rates that were measured on two cores and on one kind of GPU. The receipts of other
scenes on this machine tell how much slower or faster this machine is.
"""

import functools
import os
import re
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from runner.files import MACHINE, read_receipt
from runner.keys import flatten_params
from runner.plan import FINAL, TO_DO, Decision
from runner.resolve import ResolvedJob, has_cuda
from runner.text import format_seconds

CORES = 2  # cores on which the table was measured
PARALLEL_SHARE = 0.75  # share of a stage's time on one core that more cores divide among them
MAX_RECEIPTS = 200  # receipts that are read for the speed of this machine
PRIOR_SECONDS = 60  # the table's own weight beside the receipts, as if a machine as fast had worked for so long


def receipts_of_variants(job: ResolvedJob, stage: str) -> list[dict[str, Any]]:
    """Return the existing receipts of a stage in the scene's own run and then in its variants."""
    places = [job.base, *job.runs.glob(f"{job.base.name}@*")]
    return [receipt for place in places if (receipt := read_receipt(place / stage))]


def expected_seconds(job: ResolvedJob, stage: str) -> float | None:
    """Return the expected seconds of a stage; None if they are unknown.

    If the job names a GPU, this is the time in the table for this GPU. Otherwise it is the time of the stage's last run
    in this scene or a variant, on this machine and with this profile; of a resumed run only the last attempt counts.
    Before the first run it is the time in the table, times the slowness of this machine.
    """
    typical = typical_seconds(job, stage)
    if job.gpu:
        return typical
    alike = {"machine": MACHINE, "profile": job.profile}.items()
    if here := [receipt for receipt in receipts_of_variants(job, stage) if alike <= receipt.items()]:
        return max(here, key=lambda receipt: receipt["date"])["seconds"]
    return None if typical is None else typical * _slowness(job)


def typical_seconds(job: ResolvedJob, stage: str) -> float | None:
    """Return the seconds of a stage by the table `durations`, with this machine's number of cores or its GPU.

    None if the table has no rates for the stage in this profile and on its device, the GPU is not in the table, or the
    number of views is unknown.
    """
    rates = job.pipeline.durations.get(job.profile, {}).get(stage)
    capture = next((info.facts for info in job.stages.values() if "views" in info.facts), None)
    device = job.params[stage].get("device", "cpu")
    if rates is None or capture is None or rates.device != device:
        return None
    cores = len(os.sched_getaffinity(0))
    factor = job.pipeline.gpus.get(_gpu(job)) if device == "cuda" else _time_share(cores) / _time_share(CORES)
    if factor is None:
        return None
    train, test, *_ = map(len, capture["views"])
    steps = flatten_params(job.params)[f"{stage}.{rates.steps}"] if rates.steps else 0
    size = capture["megapixels"] / rates.megapixels if rates.megapixels else 1.0
    seconds = rates.base + rates.test * test + size * (rates.view * train + rates.step * steps)
    return factor * (seconds + (0 if capture["brings_poses"] else rates.placed * train))


def _time_share(cores: int) -> float:
    """Return the time on `cores` cores as a share of that on one (Amdahl's law)."""
    return 1 - PARALLEL_SHARE + PARALLEL_SHARE / cores


def _gpu(job: ResolvedJob) -> str:
    """Return the key in `pipeline.gpus` of the job's GPU or this machine's; "" if there is none."""
    if job.gpu or not has_cuda():
        return job.gpu or ""
    plain = lambda text: re.sub(r"[^a-z0-9]", "", text.lower())
    return next((name for name in job.pipeline.gpus if plain(name) in plain(_gpu_names())), "")


@functools.cache
def _gpu_names() -> str:
    """Return what nvidia-smi prints as names of this machine's GPUs; "" if it gives no answer."""
    with suppress(OSError, subprocess.TimeoutExpired):
        query = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        return subprocess.run(query, capture_output=True, text=True, timeout=10).stdout
    return ""


def _slowness(job: ResolvedJob) -> float:
    """Return how many times longer stages take on this machine than the table says; 1 before the first stage."""
    paths = sorted(job.runs.glob("*/*/receipt.json"))[-MAX_RECEIPTS:]
    receipts = [found for path in paths if (found := read_receipt(path.parent)) and found.get("machine") == MACHINE]
    known = [receipt for receipt in receipts if receipt.get("typical_seconds") and not receipt.get("resumed")]
    seconds, typical = (sum(r[name] for r in known) + PRIOR_SECONDS for name in ("seconds", "typical_seconds"))
    return seconds / typical


def seconds_by_stage(job: ResolvedJob, decisions: Mapping[str, Decision]) -> dict[str, float | None]:
    """Return the expected seconds of the stages of a plan that are still to run; None where they are unknown.

    If the job names another machine's GPU, these are the stages that would run there.
    """
    due = lambda status: status in TO_DO or (bool(job.gpu) and status not in FINAL)
    return {stage: expected_seconds(job, stage) for stage, each in decisions.items() if due(each.status)}


def format_total_time(seconds: Mapping[str, float | None]) -> str:
    """Return the total of stage -> seconds as text, with the names of stages of unknown time (None); "" if it is 0."""
    unknown = ", ".join(stage for stage, known in seconds.items() if known is None)
    total = sum(filter(None, seconds.values()))
    return (format_seconds(total) + (f" and the time of {unknown}" if unknown else "")) if total else ""

"""Expected time and memory of a job's stages on a GPU, which the stages estimate and `plan` prints."""

from __future__ import annotations

from runner import Refused
from runner.plan import FINAL, Decision
from runner.process import ask_stages
from runner.resolve import ResolvedJob, has_cuda
from runner.text import format_seconds


def cost_table(job: ResolvedJob, decisions: dict[str, Decision], gpu: str | None) -> str:
    """Return a table with the expected time and memory of each stage of a plan that would run on CUDA.

    Args:
        job: the job.
        decisions: the plan, stage -> decision. Stages that need not run are left out.
        gpu: name of the GPU; None for this machine's.

    Returns:
        The lines of the table, with the sum of the times in the last one. "" if there is no estimate: the machine has
        no GPU and `gpu` is None, or no stage can be estimated. If `gpu` is named and no stage would run on CUDA, a
        line that says so.

    Raises:
        Refused: the GPU is unknown.
    """
    remaining = [stage for stage, decision in decisions.items() if decision.status not in FINAL]
    on_gpu = [stage for stage in remaining if job.params.get(stage, {}).get("device") == "cuda"]
    if not (on_gpu and (gpu or has_cuda())):
        return f"  gpu={gpu}: no stage of this plan runs on CUDA" if gpu else ""
    rows, questions = [], [job.question(stage) | {"gpu": gpu or ""} for stage in on_gpu]
    for stage, answer in zip(on_gpu, ask_stages(job.root, questions), strict=True):
        if "unknown gpu" in answer:
            raise Refused(answer["unknown gpu"])
        if answer.get("cost"):
            rows.append((stage, answer["cost"]))
    if not rows:
        return ""
    lines = [f"    {stage:<12} {format_seconds(cost['seconds']):>8} {cost['gb']:6.1f} GB" for stage, cost in rows]
    total = sum(cost["seconds"] for _, cost in rows)
    head = f"  on {rows[0][1]['gpu']}: {rows[0][1]['basis']}"
    return "\n".join([head, *lines, f"    {'together':<12} {format_seconds(total):>8}"])

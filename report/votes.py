"""Result of a preference study: how often the full method was preferred to each other method.

The confidence intervals hold for other participants of the same kind. `report.study` makes the study's page.

python -m report.votes ANSWERS.json ... --key runs/X/study-key.json (`reffusion study-votes`)
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest, bootstrap

from reffusion.io.arrays import load_json
from reffusion.seeding import seed_for
from report import page

QUESTIONS = {"overall": "looks better overall", "faithful": "more faithful to the reference"}
LEVEL = 0.95
RESAMPLES = 5000


@dataclass(frozen=True)
class Preference:
    """Share of votes in which the full method was preferred to another method, for one question.

    Attributes:
        method: the other method.
        question: key of `QUESTIONS`.
        share: share of votes for the full method, in [0, 1].
        low: lower end of the share's 95 % confidence interval.
        high: upper end of this interval.
        votes: number of votes.
        participants: number of participants who voted.
    """

    method: str
    question: str
    share: float
    low: float
    high: float
    votes: int
    participants: int


def count_votes(answers: list[dict[str, Any]], key: dict[str, Any]) -> tuple[list[Preference], list[str]]:
    """Count the votes of all participants who finished the study and passed all attention checks.

    Args:
        answers: contents of the files that the study's page saved, one per participant.
        key: content of study-key.json, which says which method made which clip.

    Returns:
        The preferences for each method and question that somebody answered, and a sentence for each excluded
        participant with the reason.

    Raises:
        ValueError: answers belong to another study or to an unknown pair, or two files are of one participant.
    """
    accepted, excluded, names = [], [], set()
    for entry in answers:
        name = entry["participant"]
        if entry["study"] != key["study"]:
            raise ValueError(f"{name}: answers to another study than this key's")
        if name in names:
            raise ValueError(f"{name}: two files of one participant; keep one")
        names.add(name)
        checks = [answer for answer in entry["answers"] if answer["trial"] in key["checks"]]
        right = [answer["overall"] == key["checks"][answer["trial"]]["right"] for answer in checks]
        if len(right) < len(key["checks"]):
            excluded.append(f"{name}: not to its end")
        elif not all(right):
            excluded.append(f"{name}: {right.count(False)} of {len(right)} attention checks failed")
        else:
            accepted.append([answer for answer in entry["answers"] if answer["trial"] not in key["checks"]])
    methods = list(dict.fromkeys(pair["method"] for pair in key["pairs"].values()))
    preferences = [_preference(accepted, key, method, question) for method in methods for question in QUESTIONS]
    return [each for each in preferences if each], excluded


def _preference(
    accepted: list[list[dict[str, Any]]], key: dict[str, Any], method: str, question: str
) -> Preference | None:
    """Return the preference of the accepted participants for a method and question; None if nobody answered."""
    # `key` is the content of study-key.json. `accepted` has the answers of each participant, without attention checks.
    counts = []
    for each in accepted:
        pairs = [(answer, _pair(key, answer["trial"])) for answer in each if question in answer]
        won = [answer[question] == pair["full"] for answer, pair in pairs if pair["method"] == method]
        if won:
            counts.append((sum(won), len(won)))
    if not counts:
        return None
    wins, totals = np.array(counts, float).T
    low, high = share_interval(wins, totals, seed_for(0, "votes", method, question))
    share = float(wins.sum() / totals.sum())
    return Preference(method, question, share, low, high, int(totals.sum()), len(counts))


def _pair(key: dict[str, Any], trial: str) -> dict[str, str]:
    """Return the entry of a pair of clips in the key; raises ValueError if there is none."""
    if trial not in key["pairs"]:
        raise ValueError(f"{trial}: no pair of this study")
    return key["pairs"][trial]


def share_interval(wins: np.ndarray, totals: np.ndarray, seed: int) -> tuple[float, float]:
    """Return the 95 % confidence interval (low, high) of the share of votes won, in [0, 1].

    The interval is a bootstrap over participants, because the votes of one participant are not independent. If all
    votes agree, a bootstrap would give an interval of width zero. In this case, and for a single participant, the
    result is Wilson's interval with one vote per participant.

    Args:
        wins: [n] number of votes for the full method of each participant.
        totals: [n] number of all votes of each participant, at least 1.
        seed: seed of the bootstrap.
    """
    people, share = len(wins), wins.sum() / totals.sum()
    agreed = (wins.min() == 0 and wins.max() == 0) or bool((wins == totals).all())
    if people < 2 or agreed:
        wilson = binomtest(round(share * people), people).proportion_ci(LEVEL, "wilson")
        return float(wilson.low), float(wilson.high)
    ratio = lambda won, all_votes, axis=-1: won.sum(axis) / all_votes.sum(axis)
    interval = bootstrap(
        (wins, totals),
        ratio,
        paired=True,
        vectorized=True,
        confidence_level=LEVEL,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def preference_table(preferences: list[Preference]) -> str:
    """Return the preferences as a Markdown table, one row each."""
    header = ["preferred to", "question", "share", "95 % interval", "votes", "participants"]
    percent = lambda part: f"{100 * part:.1f} %"
    rows = [
        [
            each.method,
            QUESTIONS[each.question],
            percent(each.share),
            f"{percent(each.low)} to {percent(each.high)}",
            str(each.votes),
            str(each.participants),
        ]
        for each in preferences
    ]
    return page.markdown_table(header, rows)


def main() -> None:
    """Run `reffusion study-votes`: print the table of preferences and the excluded participants."""
    parser = argparse.ArgumentParser(prog="reffusion study-votes", description=__doc__.split("\n")[0])
    parser.add_argument("answers", type=Path, nargs="+", help="files saved by the page")
    parser.add_argument("--key", type=Path, required=True, help="runs/X/study-key.json")
    arguments = parser.parse_args()
    try:
        preferences, excluded = count_votes([_read(path) for path in arguments.answers], load_json(arguments.key))
    except (ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None
    print(preference_table(preferences), end="")
    for words in excluded:
        print(f"left out: {words}")


def _read(path: Path) -> dict[str, Any]:
    """Return the content of a file of answers; raises ValueError if it is no such file."""
    content = load_json(path)
    if not isinstance(content, dict) or not {"study", "participant", "answers"} <= set(content):
        raise ValueError(f"{path}: not a file of answers that the study's page saved")
    return content


if __name__ == "__main__":
    main()

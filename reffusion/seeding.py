"""Random seeds and generators that depend on a seed and on labels, but not on earlier random draws."""

from __future__ import annotations

import hashlib

import torch


def seed_for(seed: int, *labels: object) -> int:
    """Return a 63-bit seed that is determined by `seed` and all labels, e.g. `seed_for(0, "sds", iteration)`.

    A step that draws its random numbers from its own seed draws the same numbers in a resumed run as in an
    uninterrupted run.

    Args:
        labels: values that identify the use of the seed, such as names and numbers. Their `repr` is hashed.
    """
    text = repr((seed, *labels)).encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little") >> 1


def generator(seed: int, *labels: object, device: str = "cpu") -> torch.Generator:
    """Return a new torch.Generator on `device`, seeded with `seed_for(seed, *labels)`."""
    return torch.Generator(device).manual_seed(seed_for(seed, *labels))


def epoch_index(turn: int, count: int, seed: int, *labels: object) -> int:
    """Return the index of the item to use at a turn, so that an epoch of `count` turns uses each item once.

    Every epoch has its own random order of the items.

    Args:
        turn: number of the turn since the start, from 0.
        count: number of items.
        seed, labels: determine the orders, see `seed_for`.
    """
    order = torch.randperm(count, generator=generator(seed, *labels, turn // count))
    return int(order[turn % count])

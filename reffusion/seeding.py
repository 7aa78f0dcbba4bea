"""Random generators that depend on a seed and on labels, never on what was drawn before."""

from __future__ import annotations

import hashlib

import torch


def seed_for(seed: int, *labels: object) -> int:
    """A 63-bit seed that depends on every label: `seed_for(0, "sds", iteration)`.

    Drawing each step's randomness from its own seed makes a resumed run equal to an unbroken one.
    """
    text = repr((seed, *labels)).encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little") >> 1


def generator(seed: int, *labels: object, device: str = "cpu") -> torch.Generator:
    """A fresh generator on `device` for this seed and these labels."""
    return torch.Generator(device).manual_seed(seed_for(seed, *labels))


def epoch_index(turn: int, count: int, seed: int, *labels: object) -> int:
    """Index of the item, of `count`, whose turn it is: each item once per epoch, in a new order in every epoch."""
    order = torch.randperm(count, generator=generator(seed, *labels, turn // count))
    return int(order[turn % count])

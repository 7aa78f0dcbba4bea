"""Stiff and extreme cases, each with a bound: `python -m benchmarks.stability` (docs/stability.md)."""

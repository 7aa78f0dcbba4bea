"""Measurements: suites `bench`, `stability` and `gpu`; `studies`, one question each. `python -m benchmarks.<suite>`."""

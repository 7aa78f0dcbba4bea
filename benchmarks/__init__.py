"""Measurements: suites `bench`, `stability` and `gpu` (`python -m benchmarks.SUITE`); `studies`: one question each."""

"""The laboratory: made scenes, training of the embedded prior, suites that measure, and studies of one question each.

Each suite runs by its name: `python -m lab.bench`, `lab.stability`, `lab.gpu.check`.
"""

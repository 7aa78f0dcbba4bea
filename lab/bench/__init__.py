"""Work-precision diagrams of the kernels, compared with their baselines.

- points.py: a measured point, a diagram, the recommended setting.
- splat.py: the rasterizer against its float64 oracle.
- solvers.py: the bilateral solver and the completion.
- alignment.py: plain and robust alignment.
- draw.py: charts. gate.py: baselines.
"""

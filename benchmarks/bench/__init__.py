"""Work-precision diagrams of the kernels: measured, drawn and held to their baselines.

- points.py: a measured point, a diagram, the choice of a default.
- splat.py: the rasterizer against its float64 oracle.
- solvers.py: the bilateral solver and the completion.
- alignment.py: plain and robust alignment.
- personalization.py: LoRA over steps, rank and learning rate (slow).
- draw.py: pictures. gate.py: baselines.
"""

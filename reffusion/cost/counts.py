"""TFLOP and GB of the parts of a step: made by `python -m benchmarks.gpu.counts`."""

COUNTS = {
    "SD2 unet": {"tflop": 0.80447, "gb": 5.23992},
    "SD2 encode": {"tflop": 1.11666, "gb": 9.78252},
    "SD2 decode": {"tflop": 2.51452, "gb": 16.87799},
    "SD2 encode and back": {"tflop": 2.26768, "gb": 22.58958},
    "SD2 personalize a sample": {"tflop": 4.22926, "gb": 42.21354},
    "SDXL unet": {"tflop": 6.76171, "gb": 25.18095},
    "SDXL encode": {"tflop": 4.87895, "gb": 18.16081},
    "SDXL decode": {"tflop": 10.47039, "gb": 29.04944},
    "critic 256": {"tflop": 11.30763, "gb": 101.70744},
    "critic 512": {"tflop": 23.5985, "gb": 157.41477},
    "depth network": {"tflop": 0.16747, "gb": 2.20598},
    "loss, a million pixels": {"tflop": 0.00117, "gb": 4.243},
    "Adam, a million Gaussians": {"tflop": 0.0, "gb": 10.86},
}

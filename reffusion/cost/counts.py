"""TFLOP and GB of the parts of a step: made by `python -m benchmarks.gpu.counts`."""

COUNTS = {
    "SD2 unet": {"tflop": 0.80447, "gb": 5.63314},
    "SD2 encode": {"tflop": 1.11666, "gb": 9.78252},
    "SD2 decode": {"tflop": 2.51452, "gb": 16.87799},
    "SD2 encode and back": {"tflop": 2.26768, "gb": 22.58958},
    "SD2 personalize a sample": {"tflop": 4.22926, "gb": 43.62944},
    "SDXL unet": {"tflop": 6.76171, "gb": 33.08821},
    "SDXL encode": {"tflop": 4.87895, "gb": 38.71378},
    "SDXL decode": {"tflop": 10.47039, "gb": 66.91807},
    "critic 256": {"tflop": 11.30763, "gb": 101.70744},
    "critic 512": {"tflop": 23.5985, "gb": 157.41477},
    "depth network": {"tflop": 0.16747, "gb": 2.47347},
    "loss, a million pixels": {"tflop": 0.00117, "gb": 4.243},
    "Adam, a million Gaussians": {"tflop": 0.0, "gb": 10.86},
}

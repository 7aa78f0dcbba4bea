"""The compiled rasterizer, built for other processors than this machine's."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import llvmlite.binding
import pytest

pytestmark = pytest.mark.integration

ROOT = Path(__file__).resolve().parent.parent
TARGETS = {"x86-64": ("x86-64", "+sse2"), "avx2": ("haswell", "+avx,+avx2,+fma,+bmi,+bmi2,+f16c,+popcnt,+sse4.2")}
CHECK = """
import sys
sys.path.insert(0, "tests")
import numba
import test_splat as t
from reffusion.kernels import vectors
from reffusion.splat import forward

assert vectors.LANES == 8
for options in ({"channels": 0}, {"channels": 2, "sh_degree": 1}):
    t.assert_matches_reference(t.random_cloud(60, -2.5), t.off_center_camera(37, 70), **options)
t.test_needles(300.0)
t.test_accumulate_is_the_gradient_of_features()
assembly = "".join(forward._blend.inspect_asm().values())
print("ymm", "ymm" in assembly, "fma", "vfmadd" in assembly, "zmm", "zmm" in assembly)
"""


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="needs an x86-64 processor")
@pytest.mark.parametrize("target", [pytest.param(name, marks=pytest.mark.slow) for name in ("x86-64", "avx2")])
def test_other_processors(target, tmp_path):
    """Values and gradients equal the reference, and the machine code uses the target's instruction set."""
    have = llvmlite.binding.get_host_cpu_features()
    if target == "avx2" and not (have.get("avx2") and have.get("fma")):
        pytest.skip("this processor has no AVX2")
    for folder in ("reffusion", "tests"):  # a copy, so that kernels of another target do not enter the cache here
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__"))
    name, features = TARGETS[target]
    environment = {**os.environ, "NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features, "PYTHONPATH": str(tmp_path)}
    environment.pop("NUMBA_DISABLE_JIT", None)
    done = subprocess.run(
        [sys.executable, "-c", CHECK], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    vectors = target == "avx2"
    assert done.stdout.split() == ["ymm", str(vectors), "fma", str(vectors), "zmm", "False"]

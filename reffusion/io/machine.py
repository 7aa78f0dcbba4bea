"""Detection of the hardware and software for CUDA on this machine, and of what is missing.

Only small files are read and nvidia-smi is run. torch is not imported, so that `plan` is fast.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import os
import re
import shutil
import subprocess
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

DRIVER = Path("/proc/driver/nvidia/version")  # text with the version of the loaded driver
TOOLKIT = Path("/usr/local/cuda")  # the usual folder of the CUDA toolkit
# Major version of CUDA -> major version of the oldest Linux driver that runs it (NVIDIA, CUDA compatibility).
OLDEST_DRIVER = {11: 450, 12: 525, 13: 580}
INSTALL = "`make gpu` installs it"


@dataclass(frozen=True)
class Machine:
    """The parts of this machine that CUDA needs. None means that a part is missing or unknown.

    Attributes:
        gpu: name of the first visible GPU.
        gigabytes: memory of this GPU, in 1e9 bytes.
        driver: major version of the NVIDIA driver.
        torch_cuda: the CUDA version for which torch was built, e.g. "13.0"; "" if torch was built without CUDA.
        gsplat: True if the package gsplat is installed.
        extension: True if the installed package contains its compiled CUDA kernels.
        nvcc: the CUDA version of the compiler nvcc; "" if nvcc exists and its version is unknown.
    """

    gpu: str | None = None
    gigabytes: float | None = None
    driver: int | None = None
    torch_cuda: str | None = None
    gsplat: bool = False
    extension: bool = False
    nvcc: str | None = None


@functools.cache
def detect() -> Machine:
    """Detect what this machine has for CUDA. A few files are read, and nvidia-smi is run if it exists.

    The result of the first call is returned by all later calls of the process.
    """
    gpu, gigabytes, driver = _query_gpu()
    package = _package("gsplat")
    extension = package is not None and any(package.glob("csrc*.so"))
    return Machine(gpu, gigabytes, driver or _driver(DRIVER), _torch_cuda(), package is not None, extension, _nvcc())


def find_missing(here: Machine, memory_gb: float = 0.0, splats: bool = True, memory_param: str = "") -> list[str]:
    """Return what prevents this machine from running a stage on CUDA, one line each with the remedy.

    The list is empty if nothing is known to be missing. Unknown parts are left out, and so is a missing
    NVIDIA driver, which the command `plan` reports before.

    Args:
        here: this machine, from `detect`.
        memory_gb: GPU memory in GB that the stage's parameters allow it to use; 0: no limit.
        splats: True if the stage renders Gaussians, and thus needs gsplat.
        memory_param: name of the parameter that holds `memory_gb`, for the message.
    """
    found = []
    if here.torch_cuda == "":
        found.append(f"this torch is built without CUDA: {INSTALL}, or pip install torch from its CUDA index")
    cuda_major = _major(here.torch_cuda)
    oldest = OLDEST_DRIVER.get(cuda_major, 0) if cuda_major else 0
    if here.driver is not None and here.driver < oldest:
        found.append(
            f"the NVIDIA driver is {here.driver}, and torch's CUDA {here.torch_cuda} needs {oldest} or later: "
            f"update the driver{_older_torch(cuda_major)}"
        )
    if splats and not here.gsplat:
        found.append(f"gsplat is not installed: {INSTALL}")
    elif splats and not here.extension:
        found += _cannot_build(here, cuda_major)
    if memory_gb and here.gigabytes is not None and memory_gb > here.gigabytes:
        found.append(
            f"{memory_param} is {memory_gb:g}, and {here.gpu or 'this GPU'} has {here.gigabytes:.0f} GB: "
            f'set="{memory_param}={int(0.8 * here.gigabytes)}"'
        )
    return found


def _cannot_build(here: Machine, cuda_major: int | None) -> list[str]:
    """Return why gsplat's CUDA kernels cannot be compiled here, in at most one line; `cuda_major` is that of torch."""
    # The wheel of gsplat contains only sources, which nvcc compiles when gsplat is first loaded.
    if here.nvcc is None:
        toolkit = f"CUDA toolkit {cuda_major}" if cuda_major else "the CUDA toolkit"
        return [
            f"gsplat has no compiled extension, and there is no nvcc to build it: install {toolkit} (or name it in "
            "CUDA_HOME), then `make gpu`"
        ]
    if cuda_major and here.nvcc and _major(here.nvcc) != cuda_major:
        return [
            f"gsplat has no compiled extension, and nvcc {here.nvcc} cannot build it for torch's CUDA "
            f"{here.torch_cuda}: install CUDA toolkit {cuda_major}, then `make gpu`{_older_torch(cuda_major)}"
        ]
    return []


def _older_torch(cuda_major: int | None) -> str:
    """Return the other remedy for a driver or a compiler that is too old for torch's CUDA, if there is one."""
    return ", or `make gpu cuda=12`" if cuda_major and cuda_major > 12 else ""


def _major(version: str | None) -> int | None:
    """Return the major number of a version such as "13.0"; None for None or ""."""
    return int(version.split(".")[0]) if version else None


def _query_gpu() -> tuple[str | None, float | None, int | None]:
    """Return the first visible GPU's name, memory in GB and driver's major version; all None if nvidia-smi fails."""
    command = shutil.which("nvidia-smi") or shutil.which("nvidia-smi", path="/usr/lib/wsl/lib")
    if not command:
        return None, None, None
    fields = ["--query-gpu=name,memory.total,driver_version", "--format=csv,noheader,nounits"]
    first = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")[0]
    with suppress(OSError, ValueError, subprocess.TimeoutExpired):
        proc = subprocess.run(
            [command, *([f"--id={first}"] if first else []), *fields], capture_output=True, text=True, timeout=10
        )
        name, memory, driver = (word.strip() for word in proc.stdout.splitlines()[0].split(",")) if proc.stdout else ()
        return name, float(memory) * 2**20 / 1e9, int(driver.split(".")[0])
    return None, None, None


def _driver(path: Path) -> int | None:
    """Read the driver's major version from the file that the NVIDIA kernel module provides; None if unknown."""
    with suppress(OSError):
        # The line is like `NVRM version: NVIDIA UNIX x86_64 Kernel Module  580.65.06  Sun ...`, or that of the open
        # kernel modules.
        if found := re.search(r"Kernel Module\D*?(?:for \S+)?\s+(\d+)\.\d", path.read_text()):
            return int(found[1])
    return None


def _package(name: str) -> Path | None:
    """Return the folder of an installed package, without importing the package; None if it is not installed."""
    spec = importlib.util.find_spec(name)
    return Path(spec.origin).parent if spec and spec.origin else None


def _torch_cuda() -> str | None:
    """Return the CUDA version of torch, read without importing torch; "" if built without CUDA, None if not found."""
    folder = _package("torch")
    with suppress(OSError):
        text = (folder / "version.py").read_text() if folder else ""
        if found := re.search(r"^cuda\b[^=]*=\s*(?:'([\d.]+)'|\"([\d.]+)\"|None)", text, re.MULTILINE):
            return found[1] or found[2] or ""
    return None


def _nvcc() -> str | None:
    """Return the version of the CUDA toolkit that torch would use; "" if it is unknown, None if there is no nvcc."""
    # Like torch, look at CUDA_HOME, CUDA_PATH, nvcc on the path, and /usr/local/cuda, in this order.
    on_path = shutil.which("nvcc")
    named = os.environ.get("CUDA_HOME") or os.environ.get("CUDA_PATH")
    home = Path(named) if named else Path(on_path).resolve().parent.parent if on_path else TOOLKIT
    if not (home / "bin" / "nvcc").is_file():
        return "" if on_path else None
    with suppress(OSError, ValueError, KeyError):
        return str(json.loads((home / "version.json").read_text())["cuda"]["version"])
    return ""

"""The machine: which device a computation runs on and what it is called."""

import functools
import os
import platform
from pathlib import Path

import torch

from gelflow.errors import InputError

CPU_INFO = Path("/proc/cpuinfo")


def chosen_device(device: str) -> str:
    """The device, "cpu" or "cuda", that an option stands for; "auto" is a CUDA device where there is one.

    InputError where a CUDA device is asked for and there is none, and for other words.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"device {device!r}; allowed: auto, cpu, cuda")
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise InputError("--device cuda: no CUDA device was found; use --device cpu")
    return ("cuda" if available else "cpu") if device == "auto" else device


@functools.cache
def has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 (AVX-512 BF16, AMX), as Linux tells; False where nothing does."""
    return CPU_INFO.is_file() and " avx512_bf16 " in CPU_INFO.read_text(encoding="utf-8")


def hardware(device: str) -> str:
    """Name of a device, "cpu" or "cuda", for tables: processor and usable cores, or CUDA device."""
    if device == "cuda":
        return torch.cuda.get_device_name()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    # Linux tells the processor's model; elsewhere its architecture has to do.
    lines = CPU_INFO.read_text(encoding="utf-8").splitlines() if CPU_INFO.is_file() else []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return f"{next(models, '') or platform.machine()}, {cores} {'core' if cores == 1 else 'cores'}"

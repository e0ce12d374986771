"""The machine: which device a computation runs on, what it is called, and how much memory the process has held."""

import os
import platform
from pathlib import Path

from gelflow.errors import InputError

CPU_INFO, PROCESS_STATUS = Path("/proc/cpuinfo"), Path("/proc/self/status")


def chosen_device(device: str) -> str:
    """The device, "cpu" or "cuda", that an option stands for; "auto" is a CUDA device where there is one.

    InputError where a CUDA device is asked for and there is none.
    """
    import torch

    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise InputError("--device cuda: no CUDA device was found; use --device cpu")
    return ("cuda" if available else "cpu") if device == "auto" else device


def hardware(device: str) -> str:
    """Name of a device, "cpu" or "cuda", for tables: processor and usable cores, or CUDA device."""
    if device == "cuda":
        import torch

        return torch.cuda.get_device_name()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    # Linux tells the processor's model; elsewhere its architecture has to do.
    model = _entry(CPU_INFO, "model name") or platform.machine()
    return f"{model}, {cores} {'core' if cores == 1 else 'cores'}"


def process_memory(peak: bool) -> float | None:
    """This process's resident memory in bytes, at its peak or now; None on systems other than Linux."""
    entry = _entry(PROCESS_STATUS, "VmHWM" if peak else "VmRSS")
    return None if entry is None else float(entry.split()[0]) * 1024


def _entry(path: Path, field: str) -> str | None:
    """What follows the first `field:` of a file under /proc; None where it is not there."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((line.partition(":")[2].strip() for line in lines if line.partition(":")[0].strip() == field), None)

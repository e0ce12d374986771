"""What times were measured on, in words."""

import os
import platform
from pathlib import Path

CPU_INFO = Path("/proc/cpuinfo")


def hardware(device: str) -> str:
    """A device's name for tables: of the processor and its usable cores, or of the CUDA device.

    Args:
        device: "cpu" or "cuda".
    """
    if device == "cuda":
        import torch

        return torch.cuda.get_device_name()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{_processor()}, {cores} {'core' if cores == 1 else 'cores'}"


def _processor() -> str:
    """Model of the processor where Linux tells it, else its architecture."""
    try:
        lines = CPU_INFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()

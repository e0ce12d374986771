"""What the benchmark ran on, in a line."""

import os
import platform
from importlib.metadata import version
from pathlib import Path

from synth import __version__
from synth.simulate.linear import has_pardiso

PACKAGES = ("numpy", "scipy", "warp-lang", "pytetwild")


def machine_line() -> str:
    """Processor, cores, how busy the machine was, and versions."""
    parts = [f"{processor()}, {os.cpu_count()} cores"]
    if hasattr(os, "getloadavg"):
        parts.append(f"load {os.getloadavg()[2]:.1f} over the last 15 minutes, this run included")
    parts.append("Pardiso" if has_pardiso() else "SuperLU, no Pardiso")
    parts.append(f"synth {__version__}")
    parts += [f"{name} {version(name)}" for name in PACKAGES]
    return ", ".join(parts)


def processor() -> str:
    """Its name where the system tells."""
    told = Path("/proc/cpuinfo")
    if told.is_file():
        for line in told.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()

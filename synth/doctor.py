"""What this machine can run and how to install the rest."""

import json
import os
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from platform import machine, python_version, system

from rich.console import Console
from rich.table import Table
from rich.text import Text


@dataclass(frozen=True)
class Finding:
    """One line: what was looked for; "ok", "slow", "none" (not needed) or "missing"; and what to do about it."""

    what: str
    state: str
    detail: str


def run_doctor(as_json: bool) -> int:
    """Print the findings; 1 when something that `generate` or the trainer needs is missing."""
    findings = [
        Finding("machine", "ok", f"Python {python_version()}, {system()} {machine()}, {os.cpu_count()} cores"),
        _rendering(),
        _gpu(),
        _package("meshing", "pytetwild", "the gel's tetrahedra"),
        _package("simulation", "warp-lang", "finite elements, float64"),
        _solver(),
        _package("flow files", "OpenEXR", "reading and writing flow.exr"),
        _package("images", "opencv-contrib-python-headless", "PNG files, and the classical methods of gelflow"),
        _package("training (gelflow)", "torch", "the network; on a GPU where its CUDA build finds one"),
    ]
    if as_json:
        print(json.dumps([vars(finding) for finding in findings]))
    else:
        table = Table("what", "state", "detail")
        colours = {"ok": "green", "slow": "yellow", "none": "yellow", "missing": "red"}
        for finding in findings:
            table.add_row(finding.what, Text(finding.state, style=colours[finding.state]), Text(finding.detail))
        Console().print(table)
    return 1 if any(finding.state == "missing" for finding in findings) else 0


def _rendering() -> Finding:
    from synth.render.variant import choose_variant

    variant = choose_variant("cpu")
    try:
        number = variant.load().__version__
    except ImportError as error:
        return Finding("rendering on the CPU", "missing", f"{error}: pip install mitsuba")
    detail = f"Mitsuba {number}, {variant.name}: {variant.reason}"
    if variant.hint is not None:
        return Finding("rendering on the CPU", "slow", f"{detail}; {variant.hint}")
    return Finding("rendering on the CPU", "ok", detail)


def _gpu() -> Finding:
    from synth.render.variant import cuda_trouble

    trouble = cuda_trouble("cuda_ad_rgb")
    if trouble is None:
        return Finding("rendering on a GPU", "ok", "an NVIDIA GPU with OptiX")
    return Finding("rendering on a GPU", "none", f"{trouble}; the CPU does it, some fifty times slower")


def _solver() -> Finding:
    try:
        from synth.simulate.linear import has_pardiso

        pardiso = has_pardiso()
    except ImportError as error:
        return Finding("linear solver", "missing", f"{error}: see the lines above")
    if pardiso:
        return Finding("linear solver", "ok", f"Pardiso (pypardiso {version('pypardiso')})")
    return Finding("linear solver", "slow", "SciPy's SuperLU, ten times slower; on x86-64: pip install pypardiso")


def _package(what: str, name: str, use: str) -> Finding:
    try:
        return Finding(what, "ok", f"{name} {version(name)}: {use}")
    except PackageNotFoundError:
        return Finding(what, "missing", f"pip install {name}")

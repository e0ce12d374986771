"""What this machine can run, and how to get the rest."""

import json
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

from rich.console import Console
from rich.table import Table

from synth.errors import InputError


@dataclass(frozen=True)
class Finding:
    """One line: what was looked for, "ok", "slow" or "missing", and what to do about it."""

    what: str
    state: str
    detail: str


def run_doctor(as_json: bool) -> int:
    """Print the findings; 1 when something that `generate` needs is missing."""
    findings = [
        finding for check in (_python, _rendering, _gpu, _meshing, _solver, _learning, _opencv) for finding in check()
    ]
    if as_json:
        print(json.dumps([vars(finding) for finding in findings]))
    else:
        table = Table("what", "state", "detail")
        colours = {"ok": "green", "slow": "yellow", "missing": "red"}
        for finding in findings:
            table.add_row(finding.what, f"[{colours[finding.state]}]{finding.state}[/]", finding.detail)
        Console().print(table)
    return 1 if any(finding.state == "missing" for finding in findings) else 0


def _python() -> list[Finding]:
    return [
        Finding("machine", "ok", f"Python {platform.python_version()}, {platform.system()}, {os.cpu_count()} cores")
    ]


def _rendering() -> list[Finding]:
    def look() -> Finding:
        from synth.render.variant import choose_variant

        variant = choose_variant("cpu")
        name = variant.load().__version__
        state = "ok" if variant.hint is None else "slow"
        detail = f"Mitsuba {name}, {variant.name}: {variant.reason}" + (f"; {variant.hint}" if variant.hint else "")
        return Finding("rendering on the CPU", state, detail)

    return [_guarded("rendering on the CPU", look, "pip install mitsuba")]


def _gpu() -> list[Finding]:
    def look() -> Finding:
        from synth.render.variant import choose_variant

        try:
            return Finding("rendering on a GPU", "ok", choose_variant("cuda").reason)
        except InputError as error:
            return Finding("rendering on a GPU", "slow", str(error))

    return [_guarded("rendering on a GPU", look, "an NVIDIA driver with OptiX")]


def _meshing() -> list[Finding]:
    return [_package("meshing", "pytetwild", "the gel's tetrahedra")]


def _solver() -> list[Finding]:
    from synth.simulate.linear import has_pardiso

    warp = _package("simulation", "warp-lang", "finite elements, float64")
    if has_pardiso():
        return [warp, Finding("linear solver", "ok", f"Pardiso (pypardiso {version('pypardiso')})")]
    return [
        warp,
        Finding("linear solver", "slow", "SciPy's SuperLU, about ten times slower; on x86-64: pip install pypardiso"),
    ]


def _learning() -> list[Finding]:
    return [_package("training (gelflow)", "torch", "CPU or CUDA as torch.cuda.is_available() tells")]


def _opencv() -> list[Finding]:
    return [_package("flow files", "OpenEXR", "reading and writing flow.exr")]


def _package(what: str, name: str, use: str) -> Finding:
    try:
        return Finding(what, "ok", f"{name} {version(name)}: {use}")
    except PackageNotFoundError:
        return Finding(what, "missing", f"pip install {name}")


def _guarded(what: str, look: Callable[[], Finding], remedy: str) -> Finding:
    try:
        return look()
    except ImportError as error:
        return Finding(what, "missing", f"{error}; {remedy}")

"""The scale benchmark's results as CSV, Markdown and a few lines for the terminal."""

import csv
import io
import os
import tracemalloc
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from synth import __version__
from synth.bench.machine import processor
from synth.bench.scale_measure import Cell
from synth.dataset.sample import SAMPLE_FILES
from synth.dataset.storage import replace_file
from synth.pipeline.threads import cores
from synth.simulate.linear import has_pardiso

JOBS = (5_000, 500_000, 50_000_000)
PACKAGES = ("mitsuba", "drjit", "warp-lang", "numpy", "OpenEXR")
_COUNTED = 50_000
"""Samples of which the index's memory is measured."""


def record(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """A plain dictionary per run."""
    return [
        {
            "width": cell.setting.width,
            "height": cell.setting.height,
            "workers": cell.setting.workers,
            "variant": cell.variant,
            "pairs": cell.pairs,
            "seconds": round(cell.seconds, 3),
            "startup_s": round(cell.startup_s, 3),
            "pairs_per_second": round(cell.pairs_per_second, 4),
            "growth": round(cell.growth, 4),
            "draws_growth": round(cell.draws_growth, 4),
            "bytes_per_pair": round(cell.bytes_per_pair),
            **{f"{stage}_s": round(value, 4) for stage, value in cell.stages.items()},
            **{f"{stage}_limit_s": round(value, 4) for stage, value in cell.limits.items()},
        }
        for cell in cells
    ]


def summary(cells: Sequence[Cell]) -> list[str]:
    """For the terminal."""
    best = fastest(cells)
    return [
        f"{best.setting.width} x {best.setting.height}: {best.pairs_per_second:.2f} pairs/s with "
        f"{best.setting.by} and {best.variant}; "
        f"{JOBS[0]} pairs in {_duration(_seconds(best, JOBS[0]))}, {_bytes(JOBS[0] * best.bytes_per_pair)}"
    ]


def write_report(out: Path, scene: str, cells: Sequence[Cell], left_out: int, command: str) -> None:
    """Write OUT/scale.csv and OUT/scale.md.

    Raises:
        InputError: the storage refuses.
    """
    rows = record(cells)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    replace_file(out / "scale.csv", text.getvalue().encode("utf-8"))
    replace_file(out / "scale.md", report(scene, cells, left_out, command).encode("utf-8"))


def fastest(cells: Sequence[Cell]) -> Cell:
    """Of the largest images."""
    largest = max(cell.setting.width * cell.setting.height for cell in cells)
    return max(
        (cell for cell in cells if cell.setting.width * cell.setting.height == largest),
        key=lambda cell: cell.pairs_per_second,
    )


def report(scene: str, cells: Sequence[Cell], left_out: int, command: str) -> str:
    """The Markdown."""
    parts = [
        f"# Pairs per second: {scene}",
        f"Made by `{command}` on {_machine()}; rendered with {cells[0].variant}.",
        f"{left_out} runs were left out for lack of time." if left_out else "",
        "## Workers and image size",
        "Beyond start-up, which is the time until each worker has made its first trajectory. A worker takes one core; "
        "without workers one process makes everything and renders on all cores. The last two columns: "
        "time(2 n) / time(n), and the same of the work that the stages' own clocks counted, which differs from 2 as "
        "the draws of the two halves differ; where cost is linear the two agree, with several workers within a "
        "trajectory of each.",
        _throughput(cells),
        "## Where the time goes",
        "Seconds per pair of one worker, beside what the innermost part of a stage takes alone on one core for the "
        "same frames and bytes. The rest of `render` is building and moving the scene; the rest of `write` is "
        "encoding; `other` is drawing, meshing, and the driver.",
        _stages(cells),
        "## Larger jobs",
        _larger(fastest(cells)),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _throughput(cells: Sequence[Cell]) -> str:
    alone = {(c.setting.width, c.setting.height): c.pairs_per_second for c in cells if c.setting.workers == 1}
    lines = [
        "| image | workers | pairs | start-up s | pairs/s | against one worker | growth | of the draws |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for cell in cells:
        one = alone.get((cell.setting.width, cell.setting.height))
        gain = f"{cell.pairs_per_second / one:.2f}" if one else "–"
        lines.append(
            f"| {cell.setting.width} x {cell.setting.height} | {cell.setting.workers or 'none'} | {cell.pairs} "
            f"| {cell.startup_s:.1f} | {cell.pairs_per_second:.3f} | {gain} | {cell.growth:.3f} "
            f"| {cell.draws_growth:.3f} |"
        )
    return "\n".join(lines)


def _stages(cells: Sequence[Cell]) -> str:
    lines = ["| image | stage | s per pair | share | alone | times that |", "| --- | --- | ---: | ---: | ---: | ---: |"]
    for cell in cells:
        if cell.setting.workers != 1:
            continue
        total = cell.seconds / cell.pairs
        rows = {**cell.stages, "other": max(0.0, total - sum(cell.stages.values()))}
        for stage, seconds in rows.items():
            limit = cell.limits.get(stage)
            beside = f"{limit:.4f} | {seconds / limit:.2f}" if limit else "– | –"
            size = f"{cell.setting.width} x {cell.setting.height}"
            lines.append(f"| {size} | {stage} | {seconds:.4f} | {seconds / total:.0%} | {beside} |")
    return "\n".join(lines) if len(lines) > 2 else "No run had one worker."


def _larger(cell: Cell) -> str:
    """What is extrapolated from the fastest run of the largest images."""
    index = index_bytes()
    lines = [
        f"Extrapolated from {cell.pairs} pairs of {cell.setting.width} x {cell.setting.height} with "
        f"{cell.setting.by}, {cell.pairs_per_second:.3f} pairs/s and {_bytes(cell.bytes_per_pair)} a pair "
        f"in {len(SAMPLE_FILES)} files. The index that a run keeps in memory takes {index:.0f} bytes a finished pair; "
        "nothing else grows.",
        "",
        "| pairs | this machine | machines for a day | storage | files | index |",
        "| ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for pairs in JOBS:
        seconds = _seconds(cell, pairs)
        lines.append(
            f"| {pairs:,} | {_duration(seconds)} | {max(1.0, seconds / 86400):,.0f} "
            f"| {_bytes(pairs * cell.bytes_per_pair)} | {pairs * len(SAMPLE_FILES):,} | {_bytes(pairs * index)} |"
        )
    longest = max(cell.stages, key=lambda stage: cell.stages[stage])
    share = cell.stages[longest] / sum(cell.stages.values())
    stream = _bytes(cell.pairs_per_second * cell.bytes_per_pair)
    lines += [
        "",
        f"The first bottleneck is `{longest}` ({share:.0%} of the work); the disk takes {stream}/s meanwhile.",
    ]
    return "\n".join(lines)


def index_bytes() -> float:
    """Memory of a run for each finished sample: two tables of the lines' places while it opens, two sets of indices."""
    tracemalloc.start()
    places = {index: (index * 1000, 1000 + index % 7) for index in range(1000, 1000 + _COUNTED)}
    kept = (places, dict(places), set(places), set(places))
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return size / len(kept[0])


def _seconds(cell: Cell, pairs: int) -> float:
    return cell.startup_s + pairs / cell.pairs_per_second


def _machine() -> str:
    parts = [f"{processor()}, {cores()} cores"]
    if hasattr(os, "getloadavg"):
        parts.append(f"load {os.getloadavg()[2]:.1f} over the last 15 minutes, this run included")
    parts += ["Pardiso" if has_pardiso() else "SuperLU, no Pardiso", f"synth {__version__}"]
    for package in PACKAGES:
        try:
            parts.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return ", ".join(parts)


def _duration(seconds: float) -> str:
    for unit, length in (("years", 365.25 * 86400), ("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"


def _bytes(count: float) -> str:
    for unit, size in (("PB", 1e15), ("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count / 1e3:.1f} kB"

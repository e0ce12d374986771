"""`synth bench scale`: pairs per second against workers and image size, and what larger jobs would take."""

import os
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from synth.errors import InputError

if TYPE_CHECKING:
    from synth.bench.scale_measure import Setting


def run_scale(
    scene: str,
    out: Path,
    n: int,
    sizes: Sequence[str],
    workers: Sequence[int],
    device: Literal["auto", "cpu", "cuda"],
    seed: int,
    minutes: float | None,
    as_json: bool,
) -> int:
    """Measure and write OUT/scale.csv and OUT/scale.md.

    Args:
        scene: name or file.
        out: directory; the pairs are made in it, too, and removed.
        n: each run makes 2 n pairs, and a trajectory per worker before them.
        sizes: "WIDTHxHEIGHT"; none: the scene's own, and half of it.
        workers: process counts; none: 1, 2, 4 ... as many as there are cores.
        device: that renders.
        seed: of the draws.
        minutes: begin no further run after them.
        as_json: print the rows instead of the summary.

    Returns:
        0, or 1 when runs were left out for lack of time.

    Raises:
        InputError: wrong arguments, a scene that cannot be built, storage that refuses.
    """
    from synth.bench.scale_measure import Cell, measure
    from synth.bench.scale_report import record, summary, write_report
    from synth.dataset.jsontext import to_line
    from synth.dataset.storage import storage_errors

    settings = _settings(scene, sizes, workers)
    with storage_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    deadline = None if minutes is None else time.monotonic() + 60 * minutes
    cells: list[Cell] = []
    for setting in settings:
        if cells and deadline is not None and time.monotonic() > deadline:
            break
        cells.append(measure(scene, setting, n, device, seed, out / "scale-run"))
        cell = cells[-1]
        print(
            f"synth: {setting.width} x {setting.height}, {setting.workers} workers: {cell.pairs} pairs in "
            f"{cell.seconds:.1f} s, {cell.pairs_per_second:.2f} pairs/s ({len(cells)} of {len(settings)})",
            file=sys.stderr,
            flush=True,
        )
    write_report(out, scene, cells, len(settings) - len(cells), _command(scene, n, sizes, workers, device, seed))
    if as_json:
        print(to_line(record(cells)), end="")
    else:
        print("\n".join([*summary(cells), f"written: {out / 'scale.md'}"]))
    return 0 if len(cells) == len(settings) else 1


def _settings(scene: str, sizes: Sequence[str], workers: Sequence[int]) -> "list[Setting]":
    from synth.bench.scale_measure import Setting
    from synth.template import load_scene

    camera = load_scene(scene).corners[0].sensor.camera
    pixels = [_size(size) for size in sizes] or [(camera.width // 2, camera.height // 2), (camera.width, camera.height)]
    cores = os.cpu_count() or 1
    counts = list(workers) or [2**k for k in range(cores.bit_length()) if 2**k <= cores]
    return [Setting(width, height, count) for width, height in pixels for count in counts]


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if found is None or int(found[1]) < 8 or int(found[2]) < 8:
        raise InputError(f"--size {text}: give WIDTHxHEIGHT in px, each from 8 on, such as 640x480")
    return int(found[1]), int(found[2])


def _command(scene: str, n: int, sizes: Sequence[str], workers: Sequence[int], device: str, seed: int) -> str:
    """For the report."""
    parts = [f"python -m synth bench scale --scene {Path(scene).name} --n {n}"]
    parts += [f"--size {size}" for size in sizes] + [f"--workers {count}" for count in workers]
    parts += [f"--device {device}"] * (device != "auto") + [f"--seed {seed}"] * (seed != 0)
    return " ".join(parts)

"""`synth bench scale`: pairs per second against workers and image size, and what larger jobs would take."""

import re
import shlex
import sys
import tempfile
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
    assignments: Sequence[str],
    minutes: float | None,
    as_json: bool,
) -> int:
    """Measure and write OUT/scale.csv and OUT/scale.md.

    Args:
        scene: name or file.
        out: directory; the pairs are made in it, too, and removed.
        n: each run makes 2 n pairs, and a trajectory per worker before them.
        sizes: "WIDTHxHEIGHT"; none: the scene's own, and half of it.
        workers: process counts, beside a run without workers; none: 1, 2, 4 ... as many as there are cores.
        device: that renders.
        seed: of the draws.
        assignments: "key=value", changes of the scene.
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
    from synth.dataset.storage import report_folder

    settings = _settings(scene, assignments, sizes, workers)
    report_folder(out, "scale")
    deadline = None if minutes is None else time.monotonic() + 60 * minutes
    cells: list[Cell] = []
    for setting in settings:
        if cells and deadline is not None and time.monotonic() > deadline:
            break
        folder = Path(tempfile.mkdtemp(prefix="scale-run-", dir=out))
        cells.append(measure(scene, assignments, setting, n, device, seed, folder))
        cell = cells[-1]
        print(
            f"synth: {setting.width} x {setting.height}, {setting.by}: {cell.pairs} pairs in "
            f"{cell.seconds:.1f} s, {cell.pairs_per_second:.2f} pairs/s ({len(cells)} of {len(settings)})",
            file=sys.stderr,
            flush=True,
        )
    command = _command(scene, n, sizes, workers, device, seed, assignments)
    write_report(out, scene, cells, len(settings) - len(cells), command)
    if as_json:
        print(to_line(record(cells)), end="")
    else:
        print("\n".join([*summary(cells), f"written: {out / 'scale.md'}"]))
    return 0 if len(cells) == len(settings) else 1


def _settings(scene: str, assignments: Sequence[str], sizes: Sequence[str], workers: Sequence[int]) -> "list[Setting]":
    from synth.bench.scale_measure import Setting
    from synth.pipeline.threads import cores
    from synth.scene.template import load_scene

    camera = load_scene(scene, assignments).corners[0].sensor.camera
    pixels = [_size(size) for size in sizes] or [(camera.width // 2, camera.height // 2), (camera.width, camera.height)]
    if wrong := [count for count in workers if count < 1]:
        raise InputError(f"--workers {wrong[0]}: at least 1; there is a run without workers anyway")
    counts = list(workers) or [2**k for k in range(cores().bit_length())]
    return [Setting(width, height, count) for width, height in pixels for count in (None, *counts)]


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if found is None or int(found[1]) < 8 or int(found[2]) < 8:
        raise InputError(f"--size {text}: give WIDTHxHEIGHT in px, each from 8 on, such as 640x480")
    return int(found[1]), int(found[2])


def _command(
    scene: str,
    n: int,
    sizes: Sequence[str],
    workers: Sequence[int],
    device: str,
    seed: int,
    assignments: Sequence[str],
) -> str:
    """For the report."""
    options = [("--scene", Path(scene).name), ("--n", n)]
    options += [("--size", size) for size in sizes] + [("--workers", count) for count in workers]
    options += [("--device", device)] * (device != "auto") + [("--seed", seed)] * (seed != 0)
    options += [("--set", assignment) for assignment in assignments]
    return "python -m synth bench scale " + shlex.join(str(part) for option in options for part in option)

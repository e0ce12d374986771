"""`synth bench render`: image error against time, what "auto" picks, and what render noise does to optical flow."""

import re
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from synth.errors import InputError

if TYPE_CHECKING:
    from synth.bench.render_findings import Results


def run_render(
    scene: str,
    out: Path,
    size: str | None,
    reference: int,
    seeds: int,
    seed: int,
    device: Literal["auto", "cpu", "cuda"],
    as_json: bool,
) -> int:
    """Measure and write OUT/render.csv, render_flow.csv, render_auto.csv, render.png and render.md.

    The tables are written row by row.

    Args:
        scene: name or file.
        out: directory.
        size: "WIDTHxHEIGHT" of the pictures whose errors are measured; None: half the scene's own.
        reference: samples per pixel of what they are held against.
        seeds: of each state of the pair whose flow is measured.
        seed: of the draw.
        device: that renders.
        as_json: print the results instead of the summary.

    Returns:
        0, or 1 when a check failed: full paths have a bias, or "auto" leaves too much noise.

    Raises:
        InputError: wrong arguments, a scene that cannot be pressed or rendered, storage that refuses.
    """
    from synth.bench.render_picture import plots
    from synth.bench.render_report import report, summary
    from synth.bench.render_rows import AUTO_FILE, FLOW_FILE, IMAGE_FILE, cell_row, choice_row, effect_record
    from synth.dataset.jsontext import to_line
    from synth.dataset.storage import refuse_foreign, replace_file, storage_errors

    if seeds < 3:
        raise InputError(f"--seeds {seeds}: the jackknife needs at least 3")
    with storage_errors(out):
        out.mkdir(parents=True, exist_ok=True)  # before minutes of work, not after
    others = [out / name for name in (FLOW_FILE, AUTO_FILE, "render.png", "render.md")]
    refuse_foreign(out / IMAGE_FILE, b"variant,window,", *others)
    results = _measure(scene, out, _size(size) if size else None, reference, seeds, seed, device)
    command = f"python -m synth bench render --scene {shlex.quote(Path(scene).name)} --out DIR"
    command += f" --size {size}" * (size is not None) + f" --reference {reference} --seeds {seeds}"
    command += f" --seed {seed}" * (seed != 0) + f" --device {device}" * (device != "auto")
    replace_file(out / "render.png", plots(results))
    replace_file(out / "render.md", report(results, command).encode("utf-8"))
    checks = results.checks()
    if as_json:
        answer: dict[str, Any] = {
            "cells": [cell_row(cell) for cell in results.cells],
            "start_up": [vars(one) for one in results.start_ups],
            "flow": [effect_record(effect) for effect in results.effects],
            "auto": [choice_row(choice) for choice in results.choices],
            "checks": checks,
            "absent": results.absent,
        }
        print(to_line(answer), end="")
    else:
        print("\n".join([*summary(results), f"written: {out / 'render.md'}"]))
    return 0 if all(checks.values()) else 1


def _measure(
    scene: str,
    out: Path,
    size: tuple[int, int] | None,
    samples: int,
    seeds: int,
    seed: int,
    device: Literal["auto", "cpu", "cuda"],
) -> "Results":
    """Everything, each row on the disk as soon as it is there."""
    from synth.bench.render_auto import choices
    from synth.bench.render_findings import Results
    from synth.bench.render_flow import effects, truth
    from synth.bench.render_measure import measure, reference, settings, start_up, variants
    from synth.bench.render_rows import AUTO_FILE, FLOW_FILE, IMAGE_FILE, cell_row, choice_row, effect_rows, write_rows
    from synth.bench.render_subject import press
    from synth.planning import job_variant
    from synth.scene.template import load_scene

    began = time.perf_counter()
    template = load_scene(scene, ['render.light="path_traced"'])  # `bench light` compares it with the other kind
    fastest = job_variant(template, device)
    every, absent = variants(device, fastest.is_mono)
    _say(f"{template.name}: pressing")
    subject = press(template, seed, size)
    small, own, render = subject.small, subject.own, subject.scene.render
    found = Results(subject, reference(small, fastest, samples, render.max_depth, _say), truth(own), absent=absent)
    for cell in measure(small, settings(every, small.sensor, render.max_depth, samples), found.reference, absent, _say):
        found.cells.append(cell)
        write_rows(out / IMAGE_FILE, [cell_row(cell) for cell in found.cells])
    if not found.cells:
        raise InputError(f"{template.source}: nothing could be rendered: {'; '.join(absent)}")
    able = {cell.setting.variant.name for cell in found.cells}
    few = render.model_copy(update={"samples_per_pixel": 1})
    found.start_ups += [start_up(small, variant, few) for variant in every if variant.name in able]
    rows: list[dict[str, Any]] = []
    for effect in effects(own, found.exact, fastest, render.max_depth, seeds, _say):
        found.effects.append(effect)
        rows += effect_rows(effect)
        write_rows(out / FLOW_FILE, rows)
    camera = small.sensor.camera
    for choice in choices(template, seed, (camera.width, camera.height), fastest, _say):
        found.choices.append(choice)
        write_rows(out / AUTO_FILE, [choice_row(one) for one in found.choices])
    found.seconds = time.perf_counter() - began
    return found


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None or int(match[1]) < 16 or int(match[2]) < 16:
        raise InputError(f"--size {text}: give WIDTHxHEIGHT in px, each from 16 on, such as 160x120")
    return int(match[1]), int(match[2])


def _say(line: str) -> None:
    print(f"synth: {line}", file=sys.stderr, flush=True)

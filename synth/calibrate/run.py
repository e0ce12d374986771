"""`synth calibrate`: what the command does."""

import copy
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from synth.arrays import FloatArray, Points
from synth.calibrate.ball_fit import Balls
from synth.calibrate.comparison import Comparison, compare, picture, render_gel
from synth.calibrate.dot_grid import DotGridFit
from synth.calibrate.frames import Frames, at_rest, read_frames
from synth.calibrate.measured import FILE, FLAT, fit_measured
from synth.calibrate.measured import written as measured_files
from synth.calibrate.report import contact_line, contact_numbers, fitted_content, numbers, summary
from synth.calibrate.rest_map import measured_rest_map, with_rest_map
from synth.calibrate.sensor_fit import SensorFit, find_bare, find_grid, fit_sensor
from synth.calibrate.verdict import verdict
from synth.dataset.atomic_files import refuse_foreign, replace_file, storage_errors
from synth.dataset.images import encode_png
from synth.errors import InputError
from synth.render.variant import LLVM_HINT, choose_variant
from synth.scene import Dots, NoPattern, Render, Sensor
from synth.scene.template import Template, checked_template, load_scene, replaced
from synth.scene.validation import validated
from synth.surface import GelSurface

SCENE, PICTURE, NUMBERS, MAP = "scene.toml", "calibration.png", "calibration.json", "rest_map.png"
MARK = "Fitted by `synth calibrate"
"""How the scene that is written begins."""
_SPACINGS = 4.0
"""Most that a spacing may differ from the preset's, as a factor: further off, a lens is not like the preset's."""


def run_calibrate(
    scene: str,
    frames: Sequence[Path],
    judge: Sequence[Path],
    out: Path,
    assignments: Sequence[str],
    spacing_mm: float | None,
    steps: int,
    as_json: bool,
    rest_map: bool = False,
    pressed: tuple[Sequence[Path], Sequence[Path], float | None] = ((), (), None),
    measured: bool = False,
) -> int:
    """Fit a preset to frames of a user's sensor; write OUT/scene.toml, calibration.png and calibration.json.

    With `rest_map` also OUT/rest_map.png, which the scene then names, and comparisons with it; with `measured` light as
    measured, in two more files.

    Arguments are the options of the command (`synth.cli`), `pressed` frames of a ball to fit, others to judge, and its
    radius; returns 0 if the fit is good, 1 if it is not. InputError where frames, preset or storage are at fault, or
    this machine has no differentiable variant.
    """
    started = time.perf_counter()
    template = load_scene(scene, assignments)
    _check_places(template, out)
    variant = choose_variant("auto")
    if not variant.is_vectorised:
        raise InputError(f"calibration differentiates the rendering, which needs LLVM or an NVIDIA GPU: {LLVM_HINT}")
    given, others = _read(frames, judge)
    start, balls = start_sensor(template, given.size), _balls(template, given, *pressed)
    if measured and balls is None:
        raise InputError("--measured: needs presses of a ball, which tell light on slopes; give --ball and --radius-mm")
    if spacing_mm is not None:
        _check_spacing(spacing_mm, start, scene)
    with storage_errors(out):
        out.mkdir(parents=True, exist_ok=True)  # before minutes of work, not after
    print("synth: fitting the sensor to the frames", file=sys.stderr, flush=True)
    fit = fit_sensor(start, given, variant, spacing_mm, steps, balls)
    render, light = render_settings(template), None
    if measured and balls is not None:
        fit, light = fit_measured(fit, given, balls.judged, variant)
        render = render.model_copy(update={"light": "separated"})
    show = partial(render_gel, fit.sensor, render, variant, light)
    rows, grids = _compared(fit, show(), given, others)
    shown, contacts = _contacts(fit, balls, show)
    found = verdict(rows, grids, fit.sensor, spacing_mm is not None, fit.pressed)
    if light is not None:
        for name, written in zip((FILE, FLAT), measured_files(light), strict=True):
            replace_file(out / name, written)
    content = _checked_content(template, fit, out, scene)
    if light is not None:
        content["render"] = content.get("render", {}) | {"light": "separated"}
    if rest_map:
        gamma = fit.sensor.camera.gamma
        factors = measured_rest_map(rows["frames"], gamma)
        rows |= {f"{name}, with the rest map": with_rest_map(row, factors, gamma) for name, row in rows.items()}
        content["sensor"]["camera"]["rest_map"] = MAP
        replace_file(out / MAP, encode_png(factors))
    record = numbers(template.name, frames, fit, start, rows, contacts, found, given, time.perf_counter() - started)
    comment = f"# {MARK} --scene {scene}` to {len(frames)} frame(s); numbers in {NUMBERS}.\n"
    replace_file(out / SCENE, (comment + tomli_w.dumps(content)).encode())
    replace_file(out / PICTURE, picture(rows | shown, found.lines()[0]))
    replace_file(out / NUMBERS, (json.dumps(record, indent=1) + "\n").encode())
    text = "\n".join([*summary(record), f"written: {out / SCENE}", *found.lines()])
    print(json.dumps(record) if as_json else text)
    return 0 if found.good else 1


def _balls(
    template: Template, given: Frames, fitted: Sequence[Path], judged: Sequence[Path], radius_mm: float | None
) -> Balls | None:
    """The frames of a ball, None without any."""
    if not fitted and not judged and radius_mm is None:
        return None
    if not fitted or radius_mm is None or not 0.3 <= radius_mm <= 100:
        raise InputError(
            "--ball and --radius-mm belong together: frames of one ball, and its radius from 0.3 to 100 mm"
        )
    frames = {str(path): read_frames([path]) for path in (*fitted, *judged)}
    for name, one in frames.items():
        if one.size != given.size:
            raise InputError(f"{name}: has {one.size} pixels, the frames at rest have {given.size}")
    only_judged = frozenset(map(str, judged)) - frozenset(map(str, fitted))
    friction = template.corners[0].contact.friction
    return Balls({name: one.encoded for name, one in frames.items()}, radius_mm, friction, only_judged)


def _contacts(
    fit: SensorFit, balls: Balls | None, show: Callable[[tuple[GelSurface, Points]], FloatArray]
) -> tuple[dict[str, Comparison], list[dict[str, Any]]]:
    """Each press rendered and compared within its circle, by what its numbers say, and these numbers."""
    shown, contacts = {}, []
    if balls is not None and fit.pressed is not None:
        for press, changed in zip(fit.pressed.presses, fit.pressed.fitted, strict=True):
            frame = balls.frames[press.name]
            bare = fit.bare & find_bare(fit.sensor, frame) & (press.contact.away(frame.shape) < 1)
            row = compare(frame, show(fit.pressed.series.pressed(press.pose)), bare, fit.sensor)
            contacts.append(contact_numbers(press, changed, row))
            shown[contact_line(contacts[-1]).replace(": ", "\n").replace("; ", "\n")] = row
    return shown, contacts


def middle(kind: str, arguments: list[Any]) -> Any:
    """The middle of a distribution; of a choice, its first option."""
    match kind:
        case "uniform":
            return (arguments[0] + arguments[1]) / 2
        case "log_uniform":
            return float(np.sqrt(arguments[0] * arguments[1]))
        case _:
            return arguments[0]


def start_sensor(template: Template, size: tuple[int, int]) -> Sensor:
    """The preset's sensor at the middle of its distributions, with a camera that makes frames of the given size.

    Focal lengths and principal point scale with the width; the principal point keeps its place relative to the middle.
    A pattern, mirror, aperture or further camera that calibration does not know is an InputError.
    """
    content = copy.deepcopy(replaced(template.content["sensor"], middle))
    sensor = validated(content, template.label, Sensor, "sensor")
    if not isinstance(sensor.pattern, Dots | NoPattern):
        raise InputError(
            f"{template.label}: sensor.pattern.kind = {sensor.pattern.kind!r}: calibration needs a pattern that "
            "leaves smooth coating to see the lights by; allowed are 'dots' and 'none'"
        )
    if sensor.mirrors or sensor.further_cameras or sensor.measured_light:
        raise InputError(
            f"{template.label}: calibration knows one camera without mirrors or measured_light: remove them"
        )
    if sensor.camera.aperture_mm:
        raise InputError(
            f"{template.label}: sensor.camera.aperture_mm = {sensor.camera.aperture_mm}: calibration fits one blur "
            "for the whole image; take the aperture out of the preset"
        )
    camera, (width, height) = sensor.camera, size
    scale = width / camera.width
    view = {
        "width": width,
        "height": height,
        "fx": camera.fx * scale,
        "fy": camera.fy * scale,
        "cx": width / 2 + (camera.cx - camera.width / 2) * scale,
        "cy": height / 2 + (camera.cy - camera.height / 2) * scale,
        "blur_px": camera.blur_px * scale,
        "rest_map": None,  # of other frames and lights
    }
    return sensor.model_copy(update={"camera": camera.model_copy(update=view)})


def render_settings(template: Template) -> Render:
    return validated(replaced(template.content.get("render", {}), middle), template.label, Render, "render")


def _check_places(template: Template, out: Path) -> None:
    """Refuses round gels, and to write over what is not calibrate's own."""
    gel = template.corners[0].sensor.gel
    if gel.shape != "box":
        raise InputError(f"{template.label}: sensor.gel.shape: calibrate fits flat gels only, not a {gel.shape}")
    refuse_foreign(out / SCENE, MARK.encode(), out / PICTURE, out / NUMBERS, out / MAP, out / FILE, out / FLAT)
    if (out / SCENE).resolve() == template.source.resolve():
        raise InputError(f"--out {out}: its {SCENE} is what --scene starts from and would be lost; give another --out")


def _read(frames: Sequence[Path], judge: Sequence[Path]) -> tuple[Frames, dict[str, Frames]]:
    """The frames to fit, and the others by path; all of one size."""
    given, others = read_frames(frames), {str(path): read_frames([path]) for path in judge}
    for name, other in others.items():
        if other.size != given.size:
            raise InputError(f"{name}: has {other.size} pixels, the frames that are fitted have {given.size}")
    return given, others


def _check_spacing(spacing_mm: float, start: Sensor, scene: str) -> None:
    """Refuses what the dots' columns of this kind of sensor cannot be apart."""
    given = f"--spacing-mm = {spacing_mm:g}"
    if not isinstance(start.pattern, Dots):
        raise InputError(f"{given}: --scene {scene} has no dots; leave it out")
    usual = start.pattern.spacing_mm[0]
    if not usual / _SPACINGS <= spacing_mm <= usual * _SPACINGS:
        raise InputError(
            f"{given}: must be from {usual / _SPACINGS:.3g} to {usual * _SPACINGS:.3g} mm, the dots of --scene {scene} "
            f"being {usual:.3g} mm apart; take a preset that is more like your sensor, or change it with --set"
        )


def _compared(
    fit: SensorFit, rendered: FloatArray, given: Frames, others: dict[str, Frames]
) -> tuple[dict[str, Comparison], dict[str, DotGridFit | None]]:
    """Comparisons with the picture (H, W, 3) and grids of dots, of the fitted frames and of others, by name."""
    rows, grids = {"frames": compare(given.encoded, rendered, fit.bare, fit.sensor)}, {"frames": fit.grid}
    for path, other in others.items():
        name = f"not fitted: {Path(path).name}"
        name = f"not fitted: {path}" if name in rows else name
        _, grids[name], bare = find_grid(fit.sensor, other.encoded**fit.sensor.camera.gamma, None)
        rows[name] = compare(other.encoded, rendered, bare, fit.sensor)
        if fit.grid is None:
            still, rest = at_rest(other.encoded, given.encoded)
            if not still.any():
                raise InputError(f"{path}: shows the gel nowhere as the fitted frames do; give frames of the same gel")
            rows[name] = replace(rows[name], outside=still, rest=rest)
    return rows, grids


def _checked_content(template: Template, fit: SensorFit, out: Path, scene: str) -> dict[str, Any]:
    """The fitted scene's content, refused with its reason where the schema does not allow what was found."""
    content = fitted_content(template, fit, os.path.relpath(template.source.parent.resolve(), out.resolve()))
    try:
        checked_template(content, out / SCENE)
    except InputError as error:
        problem = str(error).replace(f"{out / SCENE}: ", "")
        raise InputError(
            f"the frames do not fit --scene {scene}: they give {problem}; they must be pictures of this kind of sensor "
            "with its gel undeformed"
        ) from error
    return content

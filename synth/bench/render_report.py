"""`bench render` as Markdown and a few lines for the terminal; rows of CSV are in `synth.bench.render_rows`."""

import os
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from synth import __version__
from synth.bench.machine import processor
from synth.bench.render_answers import answers
from synth.bench.render_error import LEVELS
from synth.bench.render_findings import Results, pareto_front
from synth.bench.render_flow import FLOW_SAMPLES, NOISE_DRAWS, SEEN_PX, is_seen, is_unseen
from synth.bench.render_measure import REPEATS, Cell

PACKAGES = ("mitsuba", "drjit", "numpy", "opencv-contrib-python-headless")


def report(results: Results, command: str) -> str:
    """The Markdown.

    Args:
        results: of a whole run.
        command: that made it.
    """
    scene, camera = results.subject.scene, results.subject.small.sensor.camera
    parts = [
        f"# Image error against rendering time: {scene.name}",
        f"Made by `{command}` on {_machine()}, in {results.seconds / 60:.1f} min.",
        _measured(results),
        "## Answers",
        "\n".join(f"- {line}" for line in answers(results)),
        "![Image error against time; flow error against samples per pixel](render.png)",
        "## Image error against time",
        f"{camera.width} x {camera.height} px. Bold: no other row is both cheaper and more exact (Pareto front). "
        f"*rmse*, *noise* and *systematic* in levels of {LEVELS}; systematic is in brackets where it is less than two "
        "standard errors from 0. Bias: of the picture's mean signal, ± one standard error.",
        _cells([cell for cell in results.cells if cell.is_error], results),
        "## Without window",
        "Refractive index 1 is another picture: refraction no longer bends the view, and no light is lost or spread at "
        "the face. The first columns are the difference from the reference, not an error.",
        _cells([cell for cell in results.cells if not cell.is_error], results),
        "## Start-up",
        "Of a fresh process, s: importing Mitsuba and choosing the variant; building the scene; the first frame beyond "
        "a later one (kernels come from Dr.Jit's cache on the disk where it has them).",
        _start_ups(results),
        "## What an optical-flow method sees",
        _flow_text(results),
        _effects(results),
        '## What "auto" picks',
        f"First draws of the scene's sensor, undeformed, {camera.width} x {camera.height} px, path depth of the scene. "
        "Noise in levels of 255, root mean square, from two pictures with seeds that the pilots did not have; the "
        "camera's own is measured in a photograph of them, quantisation included.",
        _choices(results),
        "## Not covered",
        _not_covered(results),
    ]
    return "\n\n".join(parts) + "\n"


def summary(results: Results) -> list[str]:
    """For the terminal."""
    return [line.replace("**", "") for line in answers(results)]


def _measured(results: Results) -> str:
    scene = results.subject.scene
    samples = results.own_samples or '"auto"'
    return (
        f"One press of `{scene.name}` (seed {results.subject.seed}: {scene.contact.indenter.shape}, "
        f"{scene.motion.depth_mm:.2f} mm deep), made as by `generate`; the scene has {samples} samples per pixel and "
        f"path depth {results.own_depth}. The reference has {results.reference.samples} samples per pixel and path "
        f"depth {results.deepest}; its own noise of {results.reference_noise:.3f} levels is subtracted. Every row is "
        f"the mean of {REPEATS} pictures with seeds that neither the reference nor another row has, and the median of "
        "their times: the renderer alone, on all cores, nothing compiled or built in it but in the first of them. "
        "Settings are compared by processor time, which other work on the machine changes less; on CUDA by wall time. "
        "Errors are of the picture as it is seen: blurred by the lens, exposed, encoded, before camera noise and "
        "quantisation. `noise` is what another seed changes, `systematic` what no number of samples removes; "
        "rmse² = noise² + systematic²."
    )


def _cells(cells: list[Cell], results: Results) -> str:
    front = pareto_front(results.cells)
    lines = [
        "| variant | depth | samples | s/frame | processor s | rmse | noise | noise / camera's | systematic | bias % |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for cell in cells:
        setting, found = cell.setting, cell.errors
        systematic = f"{found.systematic:.3f}" if found.has_systematic else f"({found.systematic:.3f})"
        seconds, rmse = f"{cell.seconds:.3f} | {cell.processor_s:.3f}", f"{found.rmse:.3f}"
        if cell in front:
            rmse = f"**{rmse}**"
        lines.append(
            f"| {setting.variant.name} | {setting.max_depth} | {setting.samples} | {seconds} | {rmse} "
            f"| {found.noise:.3f} | {found.noise / results.camera_noise:.2f} | {systematic} "
            f"| {found.bias_percent:+.3f} ± {found.bias_se_percent:.3f} |"
        )
    return "\n".join(lines) if cells else "Nothing could be measured."


def _start_ups(results: Results) -> str:
    lines = ["| variant | load | build | first frame |", "| --- | ---: | ---: | ---: |"]
    lines += [
        f"| {one.variant} | {one.load:.2f} | {one.build:.2f} | {max(one.first, 0.0):.2f} |" for one in results.start_ups
    ]
    return "\n".join(lines)


def _flow_text(results: Results) -> str:
    camera, effect = results.subject.own.sensor.camera, results.effects[-1]
    seeds, exact = len(effect.error_px), results.exact
    return (
        f"OpenCV's DIS (medium) on the undeformed and the pressed gel at {camera.width} x {camera.height} px, path "
        f"depth {results.own_depth}, motion {exact.mean_px:.2f} px in the mean and {exact.largest_px:.1f} px at most, "
        f"{exact.counts.mean():.0%} of the pixels visible in both. {seeds} seeds of each state make {seeds * seeds} "
        f"pairs, 8 bits; with camera noise each counts by its mean over {NOISE_DRAWS} draws of that. *Change*: of the "
        f"endpoint error, against the mean of the other {seeds - 1} seeds' pictures "
        f"with {effect.samples} samples ({(seeds - 1) * effect.samples} samples) with the same camera noise; mean of "
        f"the pairs ± one standard error (jackknife over seeds); settled where it is on one side of the limit by two. "
        "Endpoint errors are means over the pixels, ruled by those where there is no texture, and of the median pixel; "
        f"both: median of the pairs. *Difference*: mean distance of the two measured flows. Asked for: "
        f"{', '.join(map(str, FLOW_SAMPLES))} samples, rounded up to full grids."
    )


def _effects(results: Results) -> str:
    lines = [
        f"| camera noise | samples | endpoint error px | change px | within {SEEN_PX:g} px? | median pixel | change px "
        f"| within {SEEN_PX:g} px? | difference px |",
        "| --- | ---: | ---: | ---: | --- | ---: | ---: | --- | ---: |",
    ]
    for effect in sorted(results.effects, key=lambda one: (one.camera_noise, one.samples)):
        lines.append(
            f"| {'on' if effect.camera_noise else 'off'} | {effect.samples} | {effect.median_px:.3f} "
            f"| {_change(effect.change)} | {np.median(effect.typical_px):.3f} | {_change(effect.typical_change)} "
            f"| {effect.median_difference_px:.3f} |"
        )
    return "\n".join(lines)


def _change(change: tuple[float, float]) -> str:
    verdict = "yes" if is_unseen(change) else "no" if is_seen(change) else "not settled"
    return f"{change[0]:+.4f} ± {change[1]:.4f} | {verdict}"


def _choices(results: Results) -> str:
    if not results.choices:
        return "No sensor could be drawn."
    lines = [
        "| sensor | camera's noise | \"auto\" | s/frame | noise | noise / camera's | scene's samples | their noise |",
        "| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for one in results.choices:
        fixed = f"{one.fixed} | {one.fixed_noise:.3f}" if one.fixed else "auto | –"
        lines.append(
            f"| {one.sensor} | {one.camera:.3f} | {one.samples} | {one.seconds:.2f} | {one.noise:.3f} "
            f"| {one.share:.3f} | {fixed} |"
        )
    return "\n".join(lines)


def _not_covered(results: Results) -> str:
    lines = [f"- {line}" for line in results.absent]
    lines += [
        "- Light that the window's faces reflect back onto the gel: the renderer has none at any depth "
        "(docs/decisions.md), so that it is no part of the systematic error above.",
        "- Other presses and flow methods: one pair, one method; image errors of one draw of the sensor.",
        "- Fewer samples than a full grid with the same share for every light; one thread or several processes.",
        "- The mono variants, where pattern, coating or lights have colour.",
    ]
    return "\n".join(lines)


def _machine() -> str:
    parts = [f"{processor()}, {os.cpu_count()} cores"]
    if hasattr(os, "getloadavg"):
        parts.append(f"load {os.getloadavg()[2]:.1f} over the last 15 minutes, this run included")
    parts.append(f"synth {__version__}")
    for package in PACKAGES:
        try:
            parts.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return ", ".join(parts)

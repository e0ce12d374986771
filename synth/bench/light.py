"""`synth bench light`: separated light against path tracing, as a table in Markdown."""

import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from synth.bench.light_measure import FlowRow, Row

SEEN_PX = 0.01
"""A change of flow that counts."""


def run_light(
    scenes: Sequence[str], out: Path, reference: int, seed: int, device: Literal["auto", "cpu", "cuda"], as_json: bool
) -> int:
    """Measure and write OUT/light.md.

    Args:
        scenes: names or files.
        out: directory.
        reference: samples per pixel of the path-traced pictures that others are held against.
        seed: of the draws.
        device: that renders.
        as_json: print the rows instead of the summary.

    Returns:
        0, or 1 when separated light with most samples is not within a quarter of the camera's noise.

    Raises:
        InputError: a scene that cannot be pressed, or storage that refuses.
    """
    from synth.bench.light_measure import SEPARATED_SAMPLES, Row, compare
    from synth.bench.render_subject import press
    from synth.dataset.jsontext import to_line
    from synth.dataset.storage import replace_file, report_folder
    from synth.errors import InputError
    from synth.planning import job_variant
    from synth.scene.template import load_scene

    began = time.perf_counter()
    report_folder(out, "light")
    rows: list[Row] = []
    flows: list[FlowRow] = []
    refused: list[str] = []
    for scene in scenes:
        template = load_scene(scene)
        subject = press(template, seed, None)
        variant = job_variant(template, device)
        try:
            for row in compare(template.name, subject.small, variant, subject.scene.render, reference, _say):
                if isinstance(row, Row):
                    rows.append(row)
                else:
                    flows.append(row)
        except InputError as error:
            refused.append(f"`{template.name}`: {error}")
    command = f"python -m synth bench light {' '.join(shlex.quote(Path(s).name) for s in scenes)} --out DIR"
    command += f" --reference {reference}" + f" --seed {seed}" * (seed != 0)
    text = _report(rows, flows, refused, command, time.perf_counter() - began)
    replace_file(out / "light.md", text.encode("utf-8"))
    good = all(row.holds for row in rows if row.light == "separated" and row.samples >= SEPARATED_SAMPLES[-1])
    if as_json:
        print(to_line({"rows": [vars(r) | {"errors": vars(r.errors)} for r in rows], "flow": [vars(f) for f in flows]}))
    else:
        verdict = f"{'is' if good else 'is not'} within a quarter of the camera's noise"
        print(f"separated light with {SEPARATED_SAMPLES[-1]} samples {verdict}")
        print(f"written: {out / 'light.md'}")
    return 0 if good else 1


def _report(
    rows: Sequence["Row"], flows: Sequence["FlowRow"], refused: Sequence[str], command: str, seconds: float
) -> str:
    from synth.bench.machine import machine_line

    parts = [
        "# Light: separated against path traced",
        f"Made by `{command}` on {machine_line()}, in {seconds / 60:.1f} min.",
        '`[render] light = "separated"`: direct light in closed form, blocked and bounced light sampled at their own '
        "rates (`synth/render/separated_light.py`). One press of each scene at half its image size and its own path "
        "depth. The reference is path traced. Errors in levels of 255, before camera noise and quantisation, the "
        "reference's noise subtracted; *systematic* is in brackets where it is less than two standard errors from 0. "
        "*Path tracing would take*: processor time for the same noise, from its own by the law noise² ~ 1/time.",
        "## Pictures",
        "| scene | state | light | samples | processor s | rmse | noise | systematic | rmse / camera's noise "
        "| within a quarter? | path tracing would take, s |\n"
        "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | --- | ---: |\n"
        + "\n".join(_row(row, rows) for row in rows),
        "## Flow",
        "Undeformed and pressed picture with the camera's noise, the same in both pairs that are compared. *Change*: "
        "of the endpoint error against that on the reference's pair; *difference*: distance of the two measured flows; "
        "each as the mean over the pixels and (median) of the median pixel. Light *reference*: one half of the "
        "reference against the other, the least that can be told.",
        "| scene | method | light | samples | change px | (median) | difference px | (median) |\n"
        "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: |\n" + "\n".join(_flow(row) for row in flows),
    ]
    if refused:
        parts += ["## Refused", "\n".join(f"- {line}" for line in refused)]
    return "\n\n".join(parts) + "\n"


def _row(row: "Row", rows: Sequence["Row"]) -> str:
    found = row.errors
    systematic = f"{found.systematic:.3f}" if found.has_systematic else f"({found.systematic:.3f})"
    alike = next(r for r in rows if (r.scene, r.state, r.light) == (row.scene, row.state, "path_traced"))
    share = (alike.errors.noise / max(found.noise, 1e-9)) ** 2
    return (
        f"| {row.scene} | {row.state} | {row.light} | {row.samples} | {row.processor_s:.2f} | {found.rmse:.3f} "
        f"| {found.noise:.3f} | {systematic} | {found.rmse / row.camera_noise:.2f} | {'yes' if row.holds else 'no'} "
        f"| {alike.processor_s * share:.3g} |"
    )


def _flow(row: "FlowRow") -> str:
    changes = " | ".join(_marked(value, "+.4f") for value in (row.change, row.typical_change))
    apart = " | ".join(_marked(value, ".4f") for value in (row.difference, row.typical_difference))
    return f"| {row.scene} | {row.method} | {row.light} | {row.samples} | {changes} | {apart} |"


def _marked(value: float, form: str) -> str:
    """Bold where it is within SEEN_PX."""
    return f"**{value:{form}}**" if abs(value) <= SEEN_PX else f"{value:{form}}"


def _say(line: str) -> None:
    print(f"synth: {line}", file=sys.stderr, flush=True)

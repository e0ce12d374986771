"""What the commands do, between the command line and the stages."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from synth.dataset.export import ExportFormat, export
from synth.dataset.shard import Shard
from synth.dataset.store import output_of
from synth.dataset.summary import shares
from synth.errors import InputError
from synth.pipeline.generate import Scheduling, Summary
from synth.pipeline.generate import generate as generate_samples
from synth.planning import Plan, Prediction, job_variant, plan, predict
from synth.progress import duration, progress
from synth.render.variant import Device, Variant
from synth.scene.template import Template, load_scene

_NO_LIMIT = 10_000
"""Characters: wider than any table."""


def run_generate(
    scene: str,
    n: int,
    out: str,
    seed: int,
    assignments: Sequence[str],
    device: Device,
    workers: int | None,
    ray: str | None,
    shard: str | None,
    dry_run: bool,
    as_json: bool,
) -> int:
    """See `synth.cli.generate`."""
    scheduling = Scheduling(workers, ray, Shard.parse(shard) if shard else None)
    template = _loaded(scene, assignments)
    variant = job_variant(template, device)
    if dry_run:
        return _show_plan(plan(template, variant), n, as_json)
    _say_hint(variant)
    with progress(f"{template.name}: pairs", n) as advance:
        summary = generate_samples(template, n, output_of(out), seed, variant, scheduling, advance)
    if as_json:
        print(json.dumps({"directory": str(summary.directory), **summary.record()}))
    else:
        _show_summary(summary, variant)
    return 1 if summary.given_up else 0


def run_plan(scene: str, n: int, assignments: Sequence[str], device: Device, as_json: bool) -> int:
    """See `synth.cli.plan`."""
    template = _loaded(scene, assignments)
    planned = plan(template, job_variant(template, device))
    if not as_json:
        _say_hint(planned.variant)
    return _show_plan(planned, n, as_json)


def run_simulate(scene: str, out: Path, seed: int, index: int, assignments: Sequence[str], as_json: bool) -> int:
    """See `synth.cli.simulate`."""
    from synth.dataset.storage import refuse_foreign, storage_errors
    from synth.scene.sampling import draw
    from synth.simulate.files import write_trajectory
    from synth.simulate.mesh_rule import MeshRule
    from synth.simulate.solve import simulate_press

    refuse_foreign(out / "trajectory.json", b'"scene": {')
    for surface in out.glob("state_*.vtu"):
        refuse_foreign(surface, b'Name="mesh"')
    template = _loaded(scene, assignments)
    instance = draw(template, seed, index)
    with storage_errors(out):
        out.mkdir(parents=True, exist_ok=True)  # before minutes of work, not after
    try:
        with progress("simulate: percent of the load path", 100) as advance:
            press = MeshRule.of(instance).press(instance, template.folder)
            trajectory = simulate_press(press, on_progress=lambda share: advance(int(100 * share), 100))
    except InputError as error:
        raise InputError(f"{template.label}: {error}") from error
    record = write_trajectory(out, instance, trajectory)
    if as_json:
        print(json.dumps(record))
    else:
        table = Table("depth", "shear", "twist", "force", "det F", "penetr.", "iter.", title="mm, degrees, N")
        for state in trajectory.states:
            table.add_row(
                f"{state.depth_mm:.3f}",
                " ".join(f"{s:.3f}" for s in np.add(state.shear_mm, 0.0)),  # + 0: no negative zero
                f"{state.twist_deg + 0.0:.2f}",
                " ".join(f"{f:.3g}" for f in state.force_n),
                f"{state.min_jacobian:.3f}",
                f"{state.max_penetration_mm:.4f}",
                str(state.newton_iterations),
            )
        console = Console()
        console.print(table)
        _say(console, f"{trajectory.status} in {trajectory.seconds:.1f} s: {out / 'trajectory.json'}")
    if trajectory.status != "complete":
        print(f"synth: simulation {trajectory.status}: {trajectory.reason}", file=sys.stderr)
        return 1
    return 0


def run_inspect(path: Path, png: Path | None, html: Path | None, limit: int, as_json: bool) -> int:
    """See `synth.cli.inspect`."""
    from synth.dataset.storage import refuse_foreign
    from synth.inspect import PAGE_MARK, SHEET_MARK, inspect, tables, write_html, write_sheet

    for file, mark in ((png, SHEET_MARK), (html, PAGE_MARK)):
        if file is not None:
            refuse_foreign(file, mark.encode())
    inspection = inspect(path, limit)
    if as_json:
        print(json.dumps(inspection.as_dict()))
    else:
        console = _console()
        for table in tables(inspection, console.width):
            console.print(table)
    if png is not None:
        write_sheet(inspection, png)
    if html is not None:
        write_html(inspection, html)
    return 0


def run_verify(path: Path, as_json: bool) -> int:
    """See `synth.cli.verify`."""
    from synth.dataset.reader import read_dataset
    from synth.verify.dataset import verify_dataset

    count = len(read_dataset(path).samples)
    done = iter(range(1, count + 1))
    with progress("verify: samples", count) as advance:
        report = verify_dataset(path, on_sample=lambda _: advance(next(done), count))
    if as_json:
        print(json.dumps(report.record()))
    else:
        _console().print(report.table())
    return 0 if report.ok else 1


def run_export(path: Path, format: ExportFormat, out: Path, camera: str) -> int:
    """See `synth.cli.export`."""
    with progress("export: samples") as advance:
        count = export(path, format, out, advance, camera)
    _say(Console(), f"{count} samples written to {out}")
    return 0


def _loaded(scene: str, assignments: Sequence[str]) -> Template:
    """The scene; what is unusual in it is told on stderr."""
    template = load_scene(scene, assignments)
    for warning in dict.fromkeys(line for corner in template.corners for line in corner.warnings):
        print(f"synth: warning: {template.label}: {warning}", file=sys.stderr)
    return template


def _say_hint(variant: Variant) -> None:
    if variant.hint is not None:
        print(f"synth: rendering with {variant.name} ({variant.reason}); {variant.hint}", file=sys.stderr)


def _show_plan(planned: Plan, n: int, as_json: bool) -> int:
    predicted = predict(planned)
    if as_json:
        print(json.dumps({**planned.record(), **predicted.record(), "n": n}))
        return 0
    console = Console()
    title = f"{planned.template.name} with {planned.variant.name}"
    table = Table("feature", "runs", "because", title=title, title_justify="left")
    for decision in planned.decisions:
        table.add_row(decision.feature, "yes" if decision.runs else "left out", Text(decision.reason))
    console.print(table)
    seconds = sum(predicted.seconds_per_pair.values())
    stages = ", ".join(f"{stage} {value:.2f} s" for stage, value in predicted.seconds_per_pair.items())
    _say(
        console,
        f"mesh: {predicted.resolution}, about {predicted.nodes} displacement nodes\n"
        + _error_line(predicted)
        + f"predicted per pair: {stages}; {predicted.bytes_per_pair / 1e6:.2f} MB\n"
        f"predicted for {n} pairs: {duration(n * seconds)} on one core, {n * predicted.bytes_per_pair / 1e9:.2f} GB\n"
        "times are predicted within a factor of three",
    )
    return 0


def _error_line(predicted: Prediction) -> str:
    """What the plan says of the simulation's discretisation error."""
    if predicted.error_px is None or predicted.target_error_px is None:
        return "the simulation's discretisation error is not predicted for meshes of fTetWild\n"
    median, largest = predicted.error_px
    line = f"predicted error of the flow from the simulation: {median:.2g} px (median), {largest:.2g} px (largest)"
    if largest > predicted.target_error_px:
        return f"{line}; for some draws the mesh does not reach the target of {predicted.target_error_px:g} px\n"
    return f"{line}; target {predicted.target_error_px:g} px\n"


def _show_summary(summary: Summary, variant: Variant) -> None:
    console = Console()
    stages = ", ".join(f"{name} {share:.0%}" for name, share in shares(summary.stages).items())
    rate = f", {summary.samples_per_second:.2f} pairs/s" if summary.made else ""
    _say(
        console,
        f"{summary.made} pairs made ({summary.found} were there) in {duration(summary.seconds)}{rate} "
        f"with {variant.name}: {summary.directory}" + (f", shard {summary.shard}" if summary.shard else ""),
    )
    if stages:
        _say(console, f"time: {stages}")
    if summary.failed_draws:
        _say(console, f"{summary.failed_draws} draws failed and were drawn again (failures.jsonl):")
        for reason, count in summary.failures.most_common(5):
            _say(console, f"  {count} x {reason}")
    if summary.given_up:
        print(
            f"synth: {len(summary.given_up)} samples could not be made, see {summary.directory}/failures.jsonl",
            file=sys.stderr,
        )


def _console() -> Console:
    """Stdout; tables keep their natural width where it is no terminal."""
    console = Console()
    if not console.is_terminal:
        console.width = _NO_LIMIT
    return console


def _say(console: Console, text: str) -> None:
    """Plain text: square brackets in a path are no markup."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)

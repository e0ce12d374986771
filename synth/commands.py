"""The commands that make, look at and check datasets. Nothing heavy is imported before one runs."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from synth.cli_options import DEFAULT_SCENE, AsJson, Assignments, Dataset, Device, Format, SceneName, whole
from synth.errors import InputError, printable

if TYPE_CHECKING:
    from synth.pipeline.generate import Summary
    from synth.render.variant import Variant
    from synth.scene.template import Template
    from synth.simulate import Trajectory


def generate(
    *,
    scene: SceneName = DEFAULT_SCENE,
    n: Annotated[int, Parameter(converter=whole(1), help="Samples in the dataset.")] = 8,
    out: Annotated[
        str, Parameter(help="Directory or fsspec URL of the dataset; a part of the same job in it is continued.")
    ] = "data/demo",
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of everything random.")] = 0,
    assignments: Assignments = None,
    device: Device = "auto",
    workers: Annotated[
        int | None,
        Parameter(
            converter=whole(1),
            help="Processes that make samples, on one core each; the samples are the same. Default: one a core as far "
            "as memory holds them (beside this process, which simulates, on a GPU), or none for a short job. With the "
            "batched solver 1 is for no others.",
        ),
    ] = None,
    ray: Annotated[
        str | None, Parameter(help="Address of a Ray cluster to make samples on, such as auto; local starts one here.")
    ] = None,
    shard: Annotated[
        str | None,
        Parameter(
            help="i/N: make every N-th trajectory, from number i (0 to N - 1) on; other processes make the rest."
        ),
    ] = None,
    devices: Annotated[
        int | None, Parameter(converter=whole(1), help="GPUs of this machine that share the job; default: all.")
    ] = None,
    dry_run: Annotated[bool, Parameter(negative=(), help="Only show the plan.")] = False,
    as_json: AsJson = False,
) -> int:
    """Generates image pairs, or clips, with exact flow."""
    from synth.dataset.shard import Shard
    from synth.dataset.store import output_of
    from synth.pipeline import generate as pipeline
    from synth.planning import job_variant
    from synth.progress import progress

    scheduling = pipeline.Scheduling(workers, ray, Shard.parse(shard) if shard else None, devices=devices)
    template = _loaded(scene, assignments)
    variant = job_variant(template, device)
    if dry_run:
        return _show_plan(template, variant, n, as_json)
    _say_hint(variant)
    with progress(f"{template.name}: {template.sampling.kind}", n) as advance:
        summary = pipeline.generate(template, n, output_of(out), seed, variant, scheduling, advance)
    if as_json:
        print(json.dumps({"directory": str(summary.directory), **summary.record()}))
    else:
        _show_summary(summary, variant, template.sampling.kind)
    return 1 if summary.given_up else 0


def plan(
    *,
    scene: SceneName = DEFAULT_SCENE,
    n: Annotated[int, Parameter(converter=whole(1), help="Samples to predict time and size for.")] = 8,
    assignments: Assignments = None,
    device: Device = "auto",
    as_json: AsJson = False,
) -> int:
    """Shows what will run, what is left out and why, and the predicted time and size."""
    from synth.planning import job_variant

    template = _loaded(scene, assignments)
    variant = job_variant(template, device)
    if not as_json:
        _say_hint(variant)
    return _show_plan(template, variant, n, as_json)


def preview(
    *,
    scene: SceneName = DEFAULT_SCENE,
    out: Annotated[Path, Parameter(help="PNG file; further cameras stand beside the main one.")] = Path("preview.png"),
    places: Annotated[
        Path | None, Parameter(help="EXR file for where each pixel sees the gel at rest, mm; for gelflow's --scene.")
    ] = None,
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of everything random.")] = 0,
    assignments: Assignments = None,
    device: Device = "auto",
    as_json: AsJson = False,
) -> int:
    """Makes one picture of the gel at rest in seconds, and says whether its light suits the camera."""
    from synth.preview import preview as photograph
    from synth.render.variant import job_variant

    template = _loaded(scene, assignments)
    variant = job_variant(template, device)
    found = photograph(template, out, seed, variant, places)
    if as_json:
        print(json.dumps(found))
        return 0
    _say_hint(variant)
    for name, camera in found["cameras"].items():
        for channel, one in camera["levels"].items():
            shares = f"at white {one['clipped']:.1%}, dark (below 5% of white) {one['dark']:.1%}"
            print(f"{name}, {channel}: mean {one['mean']:.1%} of white; pixels {shares}")
        print(f"{name}: {camera['advice'] or 'light suits the camera'}")
    print(f"{found['pixels_per_mm']:.3g} px per mm on the gel: {out}")
    return 0


def simulate(
    *,
    scene: SceneName,
    out: Annotated[Path, Parameter(help="Directory for trajectory.json and a VTU file per state.")],
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of everything random.")] = 0,
    index: Annotated[int, Parameter(converter=whole(0), help="Number of the trajectory.")] = 0,
    assignments: Assignments = None,
    as_json: AsJson = False,
) -> int:
    """Runs the finite-element simulation alone; renders nothing."""
    from synth.dataset.atomic_files import refuse_foreign, storage_errors
    from synth.press.press import MeshRule, as_pressed
    from synth.progress import progress
    from synth.sampling import draw
    from synth.simulate.solve import simulate_press
    from synth.simulate.trajectory import write_trajectory

    refuse_foreign(out / "trajectory.json", b'"scene": {')
    for surface in out.glob("state_*.vtu"):
        refuse_foreign(surface, b'Name="mesh"')
    template = _loaded(scene, assignments)
    instance = draw(template, seed, index)
    with storage_errors(out):
        out.mkdir(parents=True, exist_ok=True)  # before minutes of work, not after
    try:
        with progress("simulate: percent of the load path", 100) as advance:
            rule = MeshRule.of(instance)
            press = rule.press(instance, template.folder)
            _warn(template, rule.lost_detail(instance, press.path.body, press.accuracy))
            trajectory = simulate_press(press, on_progress=lambda share: advance(int(100 * share), 100))
    except InputError as error:
        raise InputError(f"{template.label}: {error}") from error
    record = write_trajectory(out, as_pressed(instance, press.path.body), press.path, trajectory)
    if as_json:
        print(json.dumps(record))
    else:
        _console().print(_states_table(trajectory))
        print(f"{trajectory.status} in {trajectory.seconds:.1f} s: {out / 'trajectory.json'}")
    if trajectory.status != "complete":
        print(f"synth: simulation {trajectory.status}: {trajectory.reason}", file=sys.stderr)
        return 1
    return 0


def inspect(
    path: Annotated[Path, Parameter(help="A dataset, a sample's folder or one flow EXR.")],
    /,
    *,
    png: Annotated[Path | None, Parameter(help="Write a picture sheet.")] = None,
    html: Annotated[Path | None, Parameter(help="Write one self-contained page.")] = None,
    limit: Annotated[int, Parameter(converter=whole(1), help="Largest number of samples to show.")] = 100,
    as_json: AsJson = False,
) -> int:
    """Shows a dataset, a sample or a flow in numbers and pictures."""
    from synth.dataset.atomic_files import refuse_foreign
    from synth.inspect import PAGE_MARK, SHEET_MARK, tables, write_html, write_sheet
    from synth.inspect import inspect as look

    for file, mark in ((png, SHEET_MARK), (html, PAGE_MARK)):
        if file is not None:
            refuse_foreign(file, mark.encode())
    inspection = look(path, limit)
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


def verify(path: Dataset, /, *, as_json: AsJson = False) -> int:
    """Derives the ground truth again by independent code; exit status 1 if the two disagree."""
    from synth.pipeline.worker_pool import cores, main_left_out, one_thread_each
    from synth.progress import progress
    from synth.verify import verify_dataset

    with progress("verify: samples") as advance, main_left_out(), one_thread_each():
        report = verify_dataset(path, progress=advance, workers=cores())
    if as_json:
        print(json.dumps(report.record()))
    else:
        _console().print(report.table())
    return 0 if report.ok else 1


def export(
    path: Dataset,
    /,
    *,
    format: Format,
    out: Annotated[Path, Parameter(help="Directory to write to.")],
    camera: Annotated[str, Parameter(help="Name of a further camera; default: the main one.")] = "",
) -> int:
    """Writes a dataset in another layout, with all channels, forces and meta.json."""
    from synth.dataset.export import export as write_copies
    from synth.dataset.export import left_out
    from synth.progress import progress

    with progress("export: samples") as advance:
        count = write_copies(path, format, out, advance, camera)
    print(f"{count} samples written to {out}; left out: {left_out(path, camera, format)}")
    return 0


def _states_table(trajectory: Trajectory) -> Table:
    table = Table("depth", "shear", "twist", "force", "det F", "penetr.", "iter.", title="mm, degrees, N")
    for state in trajectory.states:
        table.add_row(
            f"{state.depth_mm:.3f}",
            " ".join(f"{s + 0.0:.3f}" for s in state.shear_mm),  # + 0: no negative zero
            f"{state.twist_deg + 0.0:.2f}",
            " ".join(f"{f:.3g}" for f in state.force_n),
            f"{state.min_jacobian:.3f}",
            f"{state.max_penetration_mm:.4f}",
            str(state.newton_iterations),
        )
    return table


def _loaded(scene: str, assignments: Sequence[str] | None) -> Template:
    """The scene; what is unusual in it is told on stderr."""
    from synth.scene.template import load_scene

    template = load_scene(scene, assignments or [])
    for warning in dict.fromkeys(line for corner in template.corners for line in corner.warnings):
        _warn(template, warning)
    return template


def _warn(template: Template, warning: str) -> None:
    if warning:
        print(printable(f"synth: warning: {template.label}: {warning}"), file=sys.stderr)


def _say_hint(variant: Variant) -> None:
    if variant.hint is not None:
        print(f"synth: rendering with {variant.name} ({variant.reason}); {variant.hint}", file=sys.stderr)


def _show_plan(template: Template, variant: Variant, n: int, as_json: bool) -> int:
    from synth.planning import plan, predict
    from synth.progress import duration
    from synth.render.pattern import pixels_per_mm

    planned = plan(template, variant)
    predicted = predict(planned)
    _warn(template, predicted.warning)
    kind = template.sampling.kind
    unit = kind.removesuffix("s")
    if as_json:
        named = {key.replace("per_pair", f"per_{unit}"): value for key, value in vars(predicted).items()}
        print(json.dumps({**planned.record(), **named, "n": n}))
        return 0
    title = f"{template.name} with {variant.name}"
    table = Table("feature", "runs", Column("because", overflow="fold"), title=title, title_justify="left")
    for decision in planned.decisions:
        table.add_row(decision.feature, "yes" if decision.runs else "left out", Text(decision.reason))
    _console().print(table)
    seconds = sum(predicted.seconds_per_pair.values())
    stages = ", ".join(f"{stage} {value:.2f} s" for stage, value in predicted.seconds_per_pair.items())
    sensor = template.corners[0].sensor
    scale, camera = pixels_per_mm(sensor), sensor.camera
    seen = f"so {camera.width / scale:.3g} x {camera.height / scale:.3g} mm if undistorted and seen straight on"
    print(
        f"picture: {camera.width} x {camera.height} px, principal point {camera.cx:.4g}, {camera.cy:.4g}, {scale:.3g} "
        f"px per mm on the gel, {seen if sensor.gel.shape == 'box' and camera.lens == 'pinhole' else 'at most'}\n"
        f"mesh: {predicted.resolution}, about {predicted.nodes} displacement nodes\n"
        + "".join(f"{line}\n" for line in predicted.error_lines())
        + f"predicted per {unit}: {stages}; {predicted.bytes_per_pair / 1e6:.2f} MB\n"
        f"predicted for {n} {kind}: {duration(n * seconds)} on one core, {n * predicted.bytes_per_pair / 1e9:.2f} GB\n"
        f"predicted memory: {predicted.memory_bytes / 1e9:.1f} GB for each process that renders\n"
        "times are predicted within a factor of three"
    )
    return 0


def _show_summary(summary: Summary, variant: Variant, kind: str) -> None:
    from synth.dataset.summary import shares
    from synth.progress import duration

    stages = ", ".join(f"{name} {share:.0%}" for name, share in shares(summary.stages).items())
    rate = f", {summary.samples_per_second:.2f} {kind}/s" if summary.made else ""
    print(
        f"{summary.made} {kind} made ({summary.found} were there) in {duration(summary.seconds)}{rate} "
        f"with {variant.name}: {summary.directory}" + (f", shard {summary.shard}" if summary.shard else "")
    )
    if stages:
        print(f"time: {stages}")
    if summary.failed_draws:
        print(f"{summary.failed_draws} attempts failed and were repeated or replaced (failures.jsonl):")
        for reason, count in summary.failures.most_common(5):
            print(f"  {count} x {reason}")
    if summary.given_up:
        print(
            f"synth: {len(summary.given_up)} samples could not be made, see {summary.directory}/failures.jsonl",
            file=sys.stderr,
        )


def _console() -> Console:
    """Stdout; tables keep their natural width where it is no terminal."""
    console = Console()
    return console if console.is_terminal else Console(width=10_000)  # wider than any table

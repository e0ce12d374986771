"""The command line of the benchmarks: `python -m synth bench render|scale|light|flow|all`."""

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from synth.cli_options import DEFAULT_SCENE, AsJson, Assignments, Device, SceneName, whole

bench = App(name="bench", help="Measures how exact simulation and rendering are, and at what cost.")


@bench.command
def render(
    *,
    scene: SceneName = DEFAULT_SCENE,
    out: Annotated[Path, Parameter(help="Directory for the tables, the plot and the report.")] = Path("data/bench"),
    size: Annotated[
        str | None,
        Parameter(help="Image whose errors are measured, such as 160x120. Default: half the scene's. Flow: its own."),
    ] = None,
    reference: Annotated[
        int, Parameter(converter=whole(64), help="Samples per pixel of what images are held against.")
    ] = 4096,
    seeds: Annotated[
        int, Parameter(converter=whole(3), help="Seeds of each of the two states whose flow is measured.")
    ] = 6,
    device: Device = "auto",
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of the draw.")] = 0,
    as_json: AsJson = False,
) -> int:
    """Measures image error against rendering time, and the render noise that optical flow notices."""
    from synth.bench import run_render

    return run_render(scene, out, size, reference, seeds, seed, device, as_json)


@bench.command
def scale(
    *,
    scene: SceneName = DEFAULT_SCENE,
    out: Annotated[
        Path, Parameter(help="Directory for the table and the report; pairs are made there and removed.")
    ] = Path("data/bench"),
    n: Annotated[int, Parameter(converter=whole(1), help="Half of the pairs of each run.")] = 8,
    size: Annotated[
        list[str] | None,
        Parameter(help="Image, such as 640x480; repeatable. Default: the scene's own, and half of it."),
    ] = None,
    workers: Annotated[
        list[int] | None,
        Parameter(
            help="Processes of one core each, beside a run without; repeatable. Default: 1, 2, 4 ... up to the cores."
        ),
    ] = None,
    device: Device = "auto",
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of the draws.")] = 0,
    assignments: Assignments = None,
    minutes: Annotated[float | None, Parameter(help="Begin no further run after them.")] = None,
    as_json: AsJson = False,
) -> int:
    """Measures pairs per second, where the time goes, and what larger jobs would take."""
    from synth.bench import run_scale

    return run_scale(scene, out, n, size or [], workers or [], device, seed, assignments or [], minutes, as_json)


@bench.command
def light(
    scenes: Annotated[list[str] | None, Parameter(help="Names or files of scenes. Default: gelsight_mini.")] = None,
    /,
    *,
    out: Annotated[Path, Parameter(help="Directory for the report.")] = Path("data/bench"),
    reference: Annotated[
        int, Parameter(converter=whole(64), help="Samples per pixel of what is held against, path traced.")
    ] = 4096,
    device: Device = "auto",
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of the draws.")] = 0,
    as_json: AsJson = False,
) -> int:
    """Measures separated light against path tracing: pictures, time, and what flow methods make of them."""
    from synth.bench import run_light

    return run_light(scenes or [DEFAULT_SCENE], out, reference, seed, device, as_json)


@bench.command
def flow(
    scenes: Annotated[
        list[str] | None, Parameter(help="Names or files of scenes. Default: gelsight_mini, tac3d and densetact.")
    ] = None,
    /,
    *,
    out: Annotated[Path, Parameter(help="Directory for the table, the plot and the report.")] = Path("data/bench"),
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of the draws.")] = 0,
    as_json: AsJson = False,
) -> int:
    """Measures the flow's error against its run time, beside simpler generators of flow."""
    from synth.bench import run_flow

    return run_flow(scenes or [], out, seed, as_json)


@bench.command(name="all")
def every(
    *,
    out: Annotated[Path, Parameter(help="Directory; each benchmark writes to a folder of its own in it.")] = Path(
        "data/bench"
    ),
    as_json: AsJson = False,
) -> int:
    """Runs render, light, flow and scale with their defaults."""
    from synth.bench import run_all

    return run_all(out, as_json)

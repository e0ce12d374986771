"""The command line of the benchmarks: `python -m synth bench fem|budget`."""

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from synth.cli_options import AsJson, whole

bench = App(name="bench", help="Measures how exact simulation is, and at what cost. Without a command: fem.")


@bench.default
@bench.command
def fem(
    *,
    out: Annotated[Path, Parameter(help="Directory for the table, the plot and the report.")] = Path("data/bench"),
    quick: Annotated[bool, Parameter(negative=(), help="One case and a few settings.")] = False,
    workers: Annotated[int, Parameter(converter=whole(1), help="Presses that run at once.")] = 2,
    as_json: AsJson = False,
) -> int:
    """Measures error against run time."""
    from synth.bench import run_bench

    return run_bench("fem", out, quick, as_json, workers)


@bench.command
def budget(
    *,
    scene: Annotated[
        list[str] | None,
        Parameter(name="--scene", help="A scene's name or TOML file; repeatable. Default: all shipped."),
    ] = None,
    out: Annotated[
        Path, Parameter(help="Directory for table, plot and report; one that holds part of the same study goes on.")
    ] = Path("data/bench"),
    draws: Annotated[int, Parameter(converter=whole(1), help="Draws of each scene.")] = 20,
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of the draws; the error model saw 0 and 1.")] = 2,
    reference: Annotated[int, Parameter(converter=whole(8), help="Most elements across a contact in the truth.")] = 18,
    workers: Annotated[int, Parameter(converter=whole(1), help="Presses that run at once.")] = 1,
    minutes: Annotated[
        float | None, Parameter(help="Begin no press that will not end within them; the same command goes on.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Compares random draws with much finer solutions: is the error within its target, at little more than it takes?"""
    from synth.bench import run_budget

    return run_budget(scene or [], out, draws, seed, reference, workers, minutes, as_json)

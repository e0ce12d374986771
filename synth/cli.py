"""The command line: `python -m synth generate|plan|preview|simulate|stress|calibrate|inspect|verify|export|doctor`.

Exit status: 0 done, 1 done with failed samples or a failed check, 2 wrong input, 130 interrupted. Nothing heavy is
imported before a command runs.
"""

import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import App, CycloptsError, Parameter

from synth import __version__
from synth.cli_options import DEFAULT_SCENE, AsJson, Assignments, SceneName, whole
from synth.commands import export, generate, inspect, plan, preview, simulate, verify
from synth.errors import InputError, printable

app = App(
    name="synth",
    version=__version__,
    help="Image pairs of vision-based tactile sensors with exact optical flow.\n\n"
    "With --debug, a mistake shows its traceback.",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)
for command in (generate, plan, preview, simulate, inspect, verify, export):
    app.command(command)


@app.command
def stress(
    *,
    out: Annotated[Path, Parameter(help="Directory for the table and a folder per case.")] = Path("data/stress"),
    only: Annotated[list[str] | None, Parameter(help="Names or patterns of cases; repeatable.")] = None,
    workers: Annotated[int, Parameter(converter=whole(1), help="Cases that run at once.")] = 1,
    as_json: AsJson = False,
) -> int:
    """Runs the stiff and extreme cases and says how each ends."""
    from synth.stress import run_stress

    return run_stress(out, only, workers, as_json)


@app.command
def calibrate(
    *,
    frames: Annotated[
        list[Path] | None, Parameter(consume_multiple=True, help="Images of the gel, to be fitted.")
    ] = None,
    units: Annotated[
        list[Path] | None,
        Parameter(consume_multiple=True, help="Instead: calibrated units, for a scene that covers them all."),
    ] = None,
    scene: SceneName = DEFAULT_SCENE,
    out: Annotated[Path, Parameter(help="Directory for scene.toml, calibration.png and calibration.json.")] = Path(
        "data/calibration"
    ),
    judge: Annotated[
        list[Path] | None, Parameter(consume_multiple=True, help="Further images, compared but not fitted.")
    ] = None,
    ball: Annotated[
        list[Path] | None,
        Parameter(consume_multiple=True, help="Images of one ball pressed in, which tell the lights."),
    ] = None,
    judge_ball: Annotated[
        list[Path] | None, Parameter(consume_multiple=True, help="Further images of it, compared but not fitted.")
    ] = None,
    radius_mm: Annotated[float | None, Parameter(help="Radius of that ball.")] = None,
    spacing_mm: Annotated[
        float | None, Parameter(help="Distance between columns of dots; default: keep the scene's field of view.")
    ] = None,
    steps: Annotated[
        int, Parameter(converter=whole(0), help="Most steps of the fit of the lights' geometry; 0: powers only.")
    ] = 30,
    rest_map: Annotated[
        bool, Parameter(negative="", help="Also write what lights do not explain as rest_map.png, for the scene.")
    ] = False,
    measured: Annotated[
        bool,
        Parameter(negative="", help="With --ball: light measured on its slopes, in place of lights that are fitted."),
    ] = False,
    assignments: Assignments = None,
    as_json: AsJson = False,
) -> int:
    """Fits a scene's lights, dots and camera to images of your own sensor."""
    if units:
        from synth.calibrate.units import run_units

        return run_units(units, out)
    from synth.calibrate import run_calibrate

    balls, others, changes = (ball or [], judge_ball or [], radius_mm), judge or [], assignments or []
    return run_calibrate(
        scene, frames or [], others, out, changes, spacing_mm, steps, as_json, rest_map, balls, measured
    )


@app.command
def doctor(*, as_json: AsJson = False) -> int:
    """Tells what this machine can run and how to install the rest."""
    from synth.doctor import run_doctor

    return run_doctor(as_json)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns the exit status. A mistake is shown without a traceback unless --debug is given."""
    tokens = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in tokens
    tokens = [token for token in tokens if token != "--debug"]
    try:
        status = app(tokens, exit_on_error=False, print_error=False)
    except (InputError, CycloptsError, OSError, MemoryError, RecursionError, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exc()
        print(f"synth: {printable(_message(error, tokens[0]))}", file=sys.stderr)
        return 130 if isinstance(error, KeyboardInterrupt) else 2
    return status if isinstance(status, int) else 0


def _message(error: BaseException, command: str) -> str:
    if isinstance(error, KeyboardInterrupt):
        kept = "; finished samples are kept: run the same command again to go on" if command == "generate" else ""
        return f"interrupted{kept}"
    if isinstance(error, MemoryError | RecursionError):
        return f"out of memory, or nested too deeply ({error}); give less at once"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error).strip()

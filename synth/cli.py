"""The command line: `python -m synth generate|plan|simulate|stress|calibrate|inspect|verify|export|doctor`.

Exit status: 0 done, 1 done with failed samples or a failed check, 2 wrong input, 130 interrupted. Nothing heavy is
imported before a command runs.
"""

import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

from synth import __version__
from synth.cli_options import DEFAULT_SCENE, AsJson, Assignments, Dataset, Device, SceneName, whole
from synth.errors import InputError

app = App(
    name="synth",
    version=__version__,
    help="Image pairs of vision-based tactile sensors with exact optical flow.\n\n"
    "With --debug, a mistake shows its traceback.",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)


@app.command
def generate(
    *,
    scene: SceneName = DEFAULT_SCENE,
    n: Annotated[int, Parameter(converter=whole(1), help="Samples in the dataset.")] = 8,
    out: Annotated[
        str, Parameter(help="Directory or fsspec URL of the dataset; one that holds part of the same job goes on.")
    ] = "data/demo",
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of everything random.")] = 0,
    assignments: Assignments = None,
    device: Device = "auto",
    workers: Annotated[
        int | None,
        Parameter(
            converter=whole(1),
            help="Processes that make samples on one core each; the same come out. Default: none, this process makes "
            "them and renders on all cores. With numerics.solver = batched: processes beside the one that simulates "
            "and renders, 1 for none; default on a GPU: one for every other core.",
        ),
    ] = None,
    ray: Annotated[
        str | None, Parameter(help="Address of a Ray cluster to make samples on, such as auto; local begins one here.")
    ] = None,
    shard: Annotated[
        str | None,
        Parameter(
            help="i/N: make every N-th trajectory from i on (from 0), beside other processes with the same --out."
        ),
    ] = None,
    dry_run: Annotated[bool, Parameter(negative=(), help="Only show the plan.")] = False,
    as_json: AsJson = False,
) -> int:
    """Generates image pairs with exact flow."""
    from synth.commands import run_generate

    return run_generate(scene, n, out, seed, assignments or [], device, workers, ray, shard, dry_run, as_json)


@app.command
def plan(
    *,
    scene: SceneName = DEFAULT_SCENE,
    n: Annotated[int, Parameter(converter=whole(1), help="Samples to predict time and size for.")] = 8,
    assignments: Assignments = None,
    device: Device = "auto",
    as_json: AsJson = False,
) -> int:
    """Shows what will run, what is left out and why, and the predicted time and size."""
    from synth.commands import run_plan

    return run_plan(scene, n, assignments or [], device, as_json)


@app.command
def simulate(
    *,
    scene: SceneName,
    out: Annotated[Path, Parameter(help="Directory for trajectory.json and a VTU file per state.")],
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of the draw.")] = 0,
    index: Annotated[int, Parameter(converter=whole(0), help="Number of the trajectory that is drawn.")] = 0,
    assignments: Assignments = None,
    as_json: AsJson = False,
) -> int:
    """Runs the finite-element simulation alone; renders nothing."""
    from synth.commands import run_simulate

    return run_simulate(scene, out, seed, index, assignments or [], as_json)


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
    frames: Annotated[list[Path], Parameter(consume_multiple=True, help="Images of the undeformed gel, to be fitted.")],
    scene: SceneName = DEFAULT_SCENE,
    out: Annotated[Path, Parameter(help="Directory for scene.toml, calibration.png and calibration.json.")] = Path(
        "data/calibration"
    ),
    judge: Annotated[
        list[Path] | None, Parameter(consume_multiple=True, help="More of such images, to judge the fit by.")
    ] = None,
    spacing_mm: Annotated[
        float | None, Parameter(help="Distance of the dots' columns where known; else the scene's field of view holds.")
    ] = None,
    steps: Annotated[
        int, Parameter(converter=whole(0), help="Most steps of the lights' geometry; 0: powers only.")
    ] = 30,
    assignments: Assignments = None,
    as_json: AsJson = False,
) -> int:
    """Fits a scene's lights, dots and camera to images of your own sensor."""
    from synth.calibrate import run_calibrate

    return run_calibrate(scene, frames, judge or [], out, assignments or [], spacing_mm, steps, as_json)


@app.command
def inspect(
    path: Annotated[Path, Parameter(help="A dataset, a sample's folder or one flow EXR.")],
    /,
    *,
    png: Annotated[Path | None, Parameter(help="Write a picture sheet.")] = None,
    html: Annotated[Path | None, Parameter(help="Write one self-contained page.")] = None,
    limit: Annotated[int, Parameter(converter=whole(1), help="Most samples of a dataset to look at.")] = 100,
    as_json: AsJson = False,
) -> int:
    """Shows a dataset, a sample or a flow in numbers and pictures."""
    from synth.commands import run_inspect

    return run_inspect(path, png, html, limit, as_json)


@app.command
def verify(path: Dataset, /, *, as_json: AsJson = False) -> int:
    """Derives the ground truth again by an independent route; exit status 1 if it disagrees."""
    from synth.commands import run_verify

    return run_verify(path, as_json)


@app.command
def export(
    path: Dataset,
    /,
    *,
    format: Annotated[Literal["flo", "kitti", "npz", "webdataset"], Parameter(help="Layout to write.")],
    out: Annotated[Path, Parameter(help="Directory to write to.")],
    camera: Annotated[str, Parameter(help="Name of a further camera; default: the main one.")] = "",
) -> int:
    """Writes a dataset in another layout."""
    from synth.commands import run_export

    return run_export(path, format, out, camera)


@app.command
def doctor(*, as_json: AsJson = False) -> int:
    """Tells what this machine can run, and how to get the rest."""
    from synth.doctor import run_doctor

    return run_doctor(as_json)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns the exit status. A mistake is shown without a traceback unless --debug is given."""
    tokens = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in tokens
    tokens = [token for token in tokens if token != "--debug"]
    try:
        status = app(tokens, exit_on_error=False, print_error=False)
    except (InputError, CycloptsError, OSError) as error:
        if debug:
            traceback.print_exc()
        print(f"synth: {_message(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        if debug:
            traceback.print_exc()
        print("synth: interrupted; finished samples are kept: run the same command again to go on", file=sys.stderr)
        return 130
    return status if isinstance(status, int) else 0


def _message(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error).strip()

"""The command line: `python -m gelflow train|finetune|evaluate|compare|predict|export|pairs`.

Exit status: 0 done, 1 done in part, 2 wrong input, 130 interrupted. Nothing heavy is imported before a command runs.
"""

import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, CycloptsError, Parameter

from gelflow import __version__
from gelflow.errors import InputError

app = App(
    name="gelflow",
    version=__version__,
    help="Learned optical flow for vision-based tactile sensors.\n\nWith --debug, a mistake shows its traceback.",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)


def kept(_: Any, given: Sequence[str] | None) -> None:
    """Validator: no assignment is undone by a later one."""
    keys = [text.partition("=")[0].strip() for text in given or ()]
    for number, key in enumerate(keys):
        for earlier in keys[:number]:
            if earlier == key or earlier.startswith(f"{key}."):
                raise ValueError(f"{key} undoes the earlier {earlier}; give each key once, a table before its fields")


Device = Literal["auto", "cpu", "cuda"]
Paths = Annotated[
    list[Path], Parameter(help="Folders of pairs: of synth or its *.tar shards, of `pairs`, or NAME_1.png, NAME_2.png.")
]
AsJson = Annotated[bool, Parameter("--json", negative=(), help="Print the answer as JSON on stdout.")]
Size = Annotated[str | None, Parameter(help="ROWSxCOLUMNS at which the network works; default: as in training.")]
Assignments = Annotated[
    list[str] | None, Parameter("--set", validator=kept, help="KEY=VALUE, such as loss.lambda_dc=10; repeatable.")
]
Out = Annotated[Path, Parameter(help="Folder for the results.")]
Validation = Annotated[list[Path] | None, Parameter(help="Folders of pairs to validate on.")]
Config = Annotated[
    str | None,
    Parameter(
        help="Settings: best, real, bare, paper, selfflow, arflow, or a TOML file. Default: best; for finetune, real."
    ),
]
ShippedOrFile = Annotated[
    Path | None,
    Parameter(help="File of weights; default: those that come with the package, best."),
]
Steps = Annotated[int | None, Parameter(help="Optimiser steps.")]
Resume = Annotated[bool, Parameter(negative=(), help="Go on with the run that --out holds.")]
OnDevice = Annotated[
    Device, Parameter(help="Where networks and registration run; auto: a CUDA device where there is one.")
]
Registered = Literal["none", "motion", "both", "brightness"]
Registration = Annotated[
    Registered | None,
    Parameter(
        help="Correct the network's flow on the images: to follow the gel's motion, or to bring image 2 as close to "
        "image 1 as can be, shading included, or both: this where motion alone leaves much. Default: as the weights' "
        "training asked for; best: motion."
    ),
]
TrainDevice = Annotated[Device | None, Parameter(help="Where to train; auto: a CUDA device where there is one.")]
Devices = Annotated[
    int | None,
    Parameter(help="Devices (on a CPU: processes) of each machine; each takes batch_size pairs a step."),
]
Nodes = Annotated[
    int | None,
    Parameter(
        help="Machines, which share --out. Start the same command on each: by srun, by torchrun, or by hand with "
        "MASTER_ADDR, MASTER_PORT and NODE_RANK set."
    ),
]


@app.command
def train(
    data: Paths,
    /,
    *,
    out: Out,
    validation: Validation = None,
    config: Config = None,
    assignments: Assignments = None,
    steps: Steps = None,
    device: TrainDevice = None,
    devices: Devices = None,
    nodes: Nodes = None,
    resume: Resume = False,
) -> int:
    """Trains a network on image pairs."""
    from gelflow.commands import run_train

    options = {"steps": steps, "device": device, "devices": devices, "nodes": nodes}
    return run_train(data, validation or [], out, config or "best", assignments or [], options, resume, None)


@app.command
def finetune(
    data: Paths,
    /,
    *,
    out: Out,
    weights: ShippedOrFile = None,
    validation: Validation = None,
    config: Config = None,
    assignments: Assignments = None,
    steps: Steps = None,
    device: TrainDevice = None,
    devices: Devices = None,
    nodes: Nodes = None,
    resume: Resume = False,
) -> int:
    """Trains on, from given weights, whose architecture is kept."""
    from gelflow.commands import run_train
    from gelflow.shipped import weights_file

    options = {"steps": steps, "device": device, "devices": devices, "nodes": nodes}
    start = weights_file(weights)
    return run_train(data, validation or [], out, config or "real", assignments or [], options, resume, start)


@app.command
def evaluate(
    data: Paths,
    /,
    *,
    weights: ShippedOrFile = None,
    registration: Registration = None,
    size: Size = None,
    device: OnDevice = "auto",
    as_json: AsJson = False,
) -> int:
    """Scores one file of weights on image pairs."""
    from gelflow.commands import run_evaluate

    return run_evaluate(data, weights, registration, size, device, as_json)


@app.command
def compare(
    data: Paths,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="Folder for tables, plots and all numbers.")] = None,
    methods: Annotated[
        str,
        Parameter(
            help="Methods, separated by commas; an empty text for none. Beside the default ones, which are the "
            "paper's: dis-motion, dis-both, dis-brightness (DIS medium, then registration), exact (the exact flow "
            "of synthetic pairs), al-dic (pyALDIC)."
        ),
    ] = "none,lucas-kanade,farneback,dis-ultrafast,dis-fast,dis-medium,tvl1",
    weights: Annotated[
        list[str] | None,
        Parameter(
            help="FILE or LABEL=FILE of a network: GelFlow (.safetensors; best: ours) or RAFT (.pth); "
            "repeatable. Labels that differ after # alone (best#0, best#1) are seeds: one row, mean and standard "
            "deviation."
        ),
    ] = None,
    registration: Annotated[
        list[Registered] | None,
        Parameter(
            help="Registration of GelFlow networks, see predict; repeatable, a row of each, whose name ends with "
            "+motion, +both or +brightness. Default: as the weights' training asked for."
        ),
    ] = None,
    ft: Annotated[
        int, Parameter(help="Steps of test-time optimisation of each GelFlow network on these pairs, reported apart.")
    ] = 0,
    ft_config: Annotated[
        str | None,
        Parameter(
            help="A preset or TOML file with its losses, learning rate, batch and flips; default: those of the "
            "network's own training, in batches of 4. What it takes of neither: gelflow/baselines/finetuned.py."
        ),
    ] = None,
    batch: Annotated[int, Parameter(help="Pairs at once where networks' speed and memory are measured; 0: not.")] = 1,
    every: Annotated[int, Parameter(help="Take every n-th pair only, for methods that are slow.")] = 1,
    add: Annotated[
        bool, Parameter(negative=(), help="Keep the methods that --out holds already; pairs are known by their names.")
    ] = False,
    size: Size = None,
    device: OnDevice = "auto",
    as_json: AsJson = False,
) -> int:
    """Scores several methods on the same image pairs."""
    from gelflow.commands import run_compare

    return run_compare(
        data, out, methods, weights or [], registration, size, device, as_json, (ft, ft_config), batch, every, add
    )


@app.command
def predict(
    inputs: Annotated[list[Path], Parameter(help="Two images, or one video or folder of frames.")],
    /,
    *,
    out: Out,
    weights: ShippedOrFile = None,
    method: Annotated[
        str | None,
        Parameter(
            help="Instead: lucas-kanade, farneback, dis-ultrafast, dis-fast, dis-medium, tvl1, dis-motion, "
            "dis-both, dis-brightness, al-dic."
        ),
    ] = None,
    registration: Registration = None,
    reference: Annotated[
        Literal["first", "previous"], Parameter(help="Of a video: flow from its first frame, or from the one before.")
    ] = "first",
    every: Annotated[int, Parameter(help="Of a video: take every n-th frame.")] = 1,
    size: Size = None,
    device: OnDevice = "auto",
    as_json: AsJson = False,
) -> int:
    """Flow of a pair of images, to EXR, .flo and a picture, or of a video, to EXR, motion.csv and a video."""
    from gelflow.commands import run_predict

    return run_predict(inputs, out, weights, method, registration, reference, every, size, device, as_json)


@app.command
def export(
    weights: Annotated[Path, Parameter(help="File of weights; best: those that come with the package.")],
    /,
    *,
    out: Annotated[Path, Parameter(help="File to write, ending in .onnx.")],
    size: Annotated[str | None, Parameter(help="ROWSxCOLUMNS of the images; default: as in training.")] = None,
) -> int:
    """Writes a network as ONNX: image1, image2 in, flow out, at one size."""
    from gelflow.commands import run_export

    return run_export(weights, out, size)


@app.command
def pairs(
    inputs: Annotated[list[str], Parameter(help="Videos, folders of videos or images, patterns like 'day1/*.mp4'.")],
    /,
    *,
    out: Out,
    per_video: Annotated[int, Parameter(help="Most pairs from one recording.")] = 10,
    min_motion: Annotated[float, Parameter(help="Least motion in px, 95th percentile over the image.")] = 2.0,
    max_motion: Annotated[float, Parameter(help="Most motion in px.")] = 60.0,
    min_difference: Annotated[
        float, Parameter(help="Least difference in px between the flows of two pairs of one recording.")
    ] = 1.0,
    frames: Annotated[int, Parameter(help="Most frames of a recording that are looked at.")] = 40,
    tries: Annotated[int, Parameter(help="Most pairs of a recording that are tried.")] = 200,
    seed: Annotated[int, Parameter(help="Seed of the random choice.")] = 0,
    as_json: AsJson = False,
) -> int:
    """Chooses image pairs with enough motion from recordings; goes on where the same job was interrupted."""
    from gelflow.commands import run_pairs
    from gelflow.data.choose import ChoiceConfig

    config = ChoiceConfig(per_video, min_motion, max_motion, min_difference, frames, tries, seed)
    return run_pairs(inputs, out, config, as_json)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns the exit status. A mistake is one line on stderr, or a traceback with --debug."""
    tokens = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in tokens
    tokens = [token for token in tokens if token != "--debug"]
    try:
        status = app(tokens, exit_on_error=False, print_error=False)
    except (InputError, CycloptsError, OSError) as error:
        if debug:
            traceback.print_exc()
        print(f"gelflow: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        if debug:
            traceback.print_exc()
        print(f"gelflow: {str(interrupt) or 'interrupted; what is finished has been kept'}", file=sys.stderr)
        return 130
    return status if isinstance(status, int) else 0


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())

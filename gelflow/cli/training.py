"""The commands `train` and `finetune`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gelflow.cli.options import Device, Out, Paths, ShippedOrFile, each_key_once, whole


@Parameter(name="*")
@dataclass(frozen=True)
class RunOptions:
    """Options that `train` and `finetune` have in common."""

    validation: Annotated[list[Path] | None, Parameter(help="Folders of pairs to validate on.")] = None
    config: Annotated[
        str | None,
        Parameter(
            help="Settings: best, real, bare, paper, selfflow, arflow, or a TOML file. Default: best; for finetune, "
            "real."
        ),
    ] = None
    assignments: Annotated[
        list[str] | None,
        Parameter("--set", validator=each_key_once, help="KEY=VALUE, such as loss.lambda_dc=10; repeatable."),
    ] = None
    steps: Annotated[int | None, Parameter(converter=whole(1), help="Optimiser steps.")] = None
    device: Annotated[Device | None, Parameter(help="Where to train; auto: a CUDA device where there is one.")] = None
    devices: Annotated[
        int | None,
        Parameter(
            converter=whole(1),
            help="Devices (on a CPU: processes) of each machine; each takes batch_size pairs a step.",
        ),
    ] = None
    nodes: Annotated[
        int | None,
        Parameter(
            converter=whole(1),
            help="Machines, which share --out. Start the same command on each: by srun, by torchrun, or by hand with "
            "MASTER_ADDR, MASTER_PORT and NODE_RANK set.",
        ),
    ] = None
    resume: Annotated[bool, Parameter(negative=(), help="Continue the run in --out.")] = False


DEFAULTS = RunOptions()


def train(data: Paths, /, *, out: Out, options: RunOptions = DEFAULTS) -> int:
    """Trains a network on image pairs."""
    return _train(data, out, options, options.config or "best", None)


def finetune(data: Paths, /, *, out: Out, weights: ShippedOrFile = None, options: RunOptions = DEFAULTS) -> int:
    """Continues training from given weights and keeps their architecture."""
    return _train(data, out, options, options.config or "real", weights or "best")


def _train(data: list[Path], out: Path, options: RunOptions, config: str, weights: str | Path | None) -> int:
    from gelflow.training.callback import is_first_process
    from gelflow.training.job import train

    given = {name: getattr(options, name) for name in ("steps", "device", "devices", "nodes")}
    settings = [
        *(options.assignments or ()),
        *(f"{name}={value}" for name, value in given.items() if value is not None),
    ]
    validation = options.validation or ()
    result = train(data, out, config, settings, validation=validation, weights=weights, resume=options.resume)
    if is_first_process():
        print(result)
    return 0

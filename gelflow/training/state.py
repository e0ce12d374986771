"""The folder of a run: what it holds, whether it may be used, and the whole state that a run resumes from.

run.json             the configuration and what it was given, written when the run starts
state.ckpt           network, optimiser, step and best score so far: everything a resumed run needs
weights.safetensors  the best weights on the validation pairs so far; without such pairs, the last, at the end
                     or where Ctrl-C or SIGTERM stopped the run
logs/                TensorBoard and CSV, a subfolder per session
"""

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gelflow import __version__
from gelflow.config import TrainConfig
from gelflow.errors import InputError
from gelflow.files.atomic import refuse_foreign, replacing, write_text
from gelflow.files.tensors import Unreadable, load_tensors

RUN, STATE, WEIGHTS = "run.json", "state.ckpt", "weights.safetensors"

FREE = ("steps", "validate_every", "save_every", "workers", "device")
"""Settings that a resumed run may change; steps only under a constant learning rate."""


@dataclass(frozen=True)
class State:
    """Everything that a run resumes from.

    `model`, `optimiser` and `average` (of the weights) are state dictionaries; `score` is the best validation score so
    far, lower is better; `validation_due` says that the validation that follows the step is still to come.
    """

    step: int
    model: dict[str, Any]
    optimiser: dict[str, Any] | None
    score: float | None
    metrics: dict[str, float]
    average: dict[str, Any] | None = None
    validation_due: bool = False


def save_state(out: Path, state: State) -> None:
    """Writes what a training continues from, as a whole or not at all."""
    content = io.BytesIO()  # torch.save into a file reports a full disk as an error of its own, which names no file
    torch.save(dict(vars(state)), content)
    with replacing(out / STATE) as temporary:
        temporary.write_bytes(content.getbuffer())


def load_state(out: Path) -> State:
    """Reads the state of a run, without running code in it; InputError where there is none, or it is damaged."""
    path = out / STATE
    try:
        return State(**load_tensors(path))
    except FileNotFoundError as error:
        raise InputError(f"{out}: no run to resume there ({STATE} is missing); start it without --resume") from error
    except (Unreadable, TypeError) as error:
        raise InputError(f"{path}: damaged, the run cannot be resumed from it: {error}") from error


def open_run(
    out: Path, config: TrainConfig, data: Mapping[str, int | str | None], initial: Path | None, resume: bool
) -> State | None:
    """Claims the folder for a new run, or checks that it holds this very run; the state to resume from, None for a new.

    `data` is what is known of the data sets: `pairs` and `validation_pairs` (0 without), their numbers, and
    `training_pairs_sha256` and `validation_pairs_sha256`, digests of their names, scenes and seeds (None where a data
    set has none). `initial` are the weights that the run starts from. InputError for a folder that holds a run, or a
    `RUN` from elsewhere, although resume is False; for none, or another run, although it is True.
    """
    record = {
        "gelflow": __version__,
        **data,
        "initial_sha256": None if initial is None else hashlib.sha256(initial.read_bytes()).hexdigest(),
        "config": config.model_dump(mode="json"),
    }
    if not resume:
        if out.exists() and not out.is_dir():
            raise InputError(f"{out}: a file is in the way; give a folder")
        if (out / STATE).exists() or (out / WEIGHTS).exists():
            raise InputError(f"{out}: holds a run already; add --resume to go on with it, or give another folder")
        refuse_foreign(out / RUN, b'"gelflow"')
        write_text(out / RUN, json.dumps(record, indent=2) + "\n")
        return None
    state = load_state(out)
    old, new = _flat(_read_run(out)), _flat(record)
    free = ("gelflow", *(f"config.{name}" for name in (FREE if config.schedule == "constant" else FREE[1:])))
    differences = [
        f"{name.removeprefix('config.')}: {old.get(name)!r} there, {value!r} now"
        for name, value in new.items()
        if name not in free and old.get(name) != value
    ]
    if differences:
        raise InputError(f"{out}: holds another run than the one to resume ({'; '.join(differences)})")
    if state.step > config.steps:
        raise InputError(f"{out}: its run has done {state.step} steps, more than the {config.steps} asked for")
    write_text(out / RUN, json.dumps(record, indent=2) + "\n")
    return state


def _read_run(out: Path) -> dict[str, Any]:
    try:
        values = json.loads((out / RUN).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{out / RUN}: missing or damaged, the run cannot be resumed: {error}") from error
    if not isinstance(values, dict):
        raise InputError(f"{out / RUN}: damaged, the run cannot be resumed")
    return values


def _flat(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat

"""Test-time optimisation, the paper's "+ft": a network trained on, without truth, on the very pairs it is scored on.

It cannot be compared with methods that see each pair once; tables list it apart. The paper fine-tunes "for an
additional 800 epochs using the validation dataset" and says no more, so everything else is as in its training: the
self-supervised losses, whole images at the network's size, batches of 4, a constant rate.

Losses, gradient clipping, flips, weight decay, precision, a constant rate and seed are those that the network's
training recorded with its weights. Exact flow is not looked at. The pairs are neither moved, recoloured, compressed nor
cropped: these very images are to be matched. The rate is constant, so that a longer optimisation goes on with a shorter
one; the peak of a falling rate is lowered to `RATE`. The weights themselves are kept, not their moving average.

Registration has no part in the training steps. The copy keeps what its weights had, and is used with what was asked of
the network that it came from.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from gelflow.config import TrainConfig
from gelflow.config.validation import validated
from gelflow.data.pairs import PairDataset
from gelflow.errors import InputError
from gelflow.methods.learned import Learned
from gelflow.models.weights import read_metadata
from gelflow.training.run import train
from gelflow.training.state import STATE
from gelflow.untrusted import parsed

BATCH = 4
"""Pairs in a batch, the paper's, so that 1600 steps on 8 pairs are its 800 epochs for every network."""
RATE = 1e-4
"""Largest constant learning rate in place of a falling one: that of ARFlow, on which the paper builds."""


def fine_tuning_settings(method: Learned, steps: int, pairs: int) -> TrainConfig:
    """The settings of a test-time optimisation; batches are not larger than the number of pairs.

    InputError where the weights carry no settings.
    """
    text = read_metadata(method.path).get("train")
    if text is None:
        raise InputError(f"{method.path}: its metadata lack the settings of its training, by which --ft goes on")
    try:
        values = dict(parsed(json.loads, text, "train"))
    except (ValueError, TypeError) as error:
        raise InputError(f"{method.path}: its metadata do not describe its training") from error
    fixed: dict[str, Any] = {
        "model": method.trained.model_dump(),
        "supervision": "self",
        "image_size": method.size or method.model.image_size,
        "crop_size": None,
        "motion": None,
        "color_jitter": 0.0,
        "compression": 0.0,
        "specks": 0.0,
        "ema_decay": 0.0,
        "schedule": "constant",
        "warmup_steps": 0,
        "steps": steps,
        "batch_size": min(BATCH, pairs),
        "workers": 0,
        "device": method.device,
        "devices": 1,
        "nodes": 1,
    }
    if values.get("schedule") == "one_cycle":
        fixed["learning_rate"] = min(values["learning_rate"], RATE)
    return validated(TrainConfig, values | fixed, f"{method.path}, fine-tuning")


def fine_tuned(method: Learned, dataset: PairDataset, out: Path, steps: int) -> Learned:
    """Trains a copy of a network on the pairs of a comparison; its name says so.

    A run of the same settings in the folder `out` is resumed, or used if it is finished. It is the same run however the
    flow is registered. InputError where the pairs differ in size and the network has none of its own; see also
    `fine_tuning_settings` and `gelflow.training.train`.
    """
    settings = fine_tuning_settings(method, steps, len(dataset))
    sizes = {dataset.images(index)[0].shape[:2] for index in range(len(dataset))}
    if settings.image_size is None and len(sizes) > 1:
        given = ", ".join(f"{rows}x{columns}" for rows, columns in sorted(sizes))
        raise InputError(f"--ft {steps}: the pairs have {given} px, a batch needs one size; give --size ROWSxCOLUMNS")
    resume = (out / STATE).is_file()
    result = train(settings, dataset, None, out, initial=method.path, resume=resume)
    name = replace(method.name, fine_tuned=True)
    return Learned(result.weights, name, method.size, method.device, method.registration)

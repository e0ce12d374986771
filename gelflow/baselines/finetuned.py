"""Test-time optimisation, the paper's "+ft": a network trained on, without truth, on the very pairs it is scored on.

Not comparable with methods that see each pair once: tables list it apart. The settings are those that the network's
training recorded with its weights, self-supervised, with a constant learning rate; `--ft-config` takes others (a
network trained on exact flow has no settings for training without).
"""

import json
from pathlib import Path

from gelflow.baselines.learned import Learned
from gelflow.config import TrainConfig, validated
from gelflow.data.pairs import PairDataset
from gelflow.errors import InputError
from gelflow.overrides import train_config

SUFFIX = "+ft"
"""At the end of the name of every method of this kind."""


def fine_tuning_settings(method: Learned, steps: int, config: str | None, pairs: int) -> TrainConfig:
    """The settings of a test-time optimisation.

    Args:
        method: The network.
        steps: Optimiser steps. The paper's 800 epochs of 8 pairs in batches of 4 are 1600.
        config: Preset or TOML file; None: the settings that the weights were trained with.
        pairs: Number of pairs; batches are not larger.

    Raises:
        InputError: The weights carry no settings, or `config` cannot be used.
    """
    from gelflow.train.checkpoint import read_metadata

    fixed = {
        "model": method.model.config.model_dump(),
        "supervision": "self",
        "steps": steps,
        "schedule": "constant",
        "warmup_steps": 0,
        "device": method.device,
    }
    if config is None:
        text = read_metadata(method.path).get("train")
        if text is None:
            raise InputError(f"{method.path}: its metadata lack the settings of its training; give --ft-config")
        values = json.loads(text)
    else:
        chosen = train_config(config)
        values = chosen.model_dump(mode="json")
        if len(chosen.loss.lambda_s) != method.model.config.levels - 1:
            raise InputError(f"--ft-config {config}: its losses are for another number of scales than {method.path}")
    values |= fixed | {"image_size": method.model.image_size, "batch_size": min(values["batch_size"], pairs)}
    return validated(TrainConfig, values, f"{method.path}, fine-tuning")


def fine_tuned(method: Learned, dataset: PairDataset, out: Path, steps: int, config: str | None = None) -> Learned:
    """Trains a copy of a network on the pairs of a comparison.

    Args:
        method: The network; stays as it is.
        dataset: The pairs.
        out: Folder for the run; a run of the same settings that it holds is gone on with, or used if it is finished.
        steps: Optimiser steps.
        config: See `fine_tuning_settings`.

    Returns:
        The fine-tuned network, its name with "+ft".

    Raises:
        InputError: See `fine_tuning_settings` and `gelflow.train.train`.
    """
    from gelflow.train import train
    from gelflow.train.state import STATE

    settings = fine_tuning_settings(method, steps, config, len(dataset))
    resume = (out / STATE).is_file()
    result = train(settings, dataset, None, out, initial=method.path, resume=resume)
    return Learned(result.weights, f"{method.name}{SUFFIX}", method.size, method.device)

"""Fine-tuning on the pairs of a comparison ("+ft"): what it takes of the network's training, and what it must not."""

import json
from pathlib import Path
from typing import Any

import pytest
from textures import write_folder, write_synthetic
from waves import random_weights, same_weights

from gelflow.baselines.learned import Learned
from gelflow.config import ModelConfig, MotionConfig, RegistrationConfig, TrainConfig
from gelflow.config.sources import train_config
from gelflow.data import PairDataset, join, open_pairs
from gelflow.errors import InputError
from gelflow.models.weights import read_metadata
from gelflow.train.test_time import fine_tuned, fine_tuning_settings

SMALL = ModelConfig(levels=4, projected_channels=8)
UNSUITABLE: dict[str, Any] = {
    "loss": {"lambda_s": [1.0, 1.0, 0.5], "alpha": 0.5},
    "supervision": "mixed", "mixed_self": 3.0, "motion": MotionConfig(), "color_jitter": 0.2, "crop_size": (64, 64),
    "ema_decay": 0.999, "schedule": "one_cycle", "warmup_steps": 100, "learning_rate": 4e-4, "batch_size": 16,
    "gradient_clip": 1.0, "flip": False, "seed": 5, "devices": 2, "workers": 3, "device": "cuda",
}  # fmt: skip
"""A training that nothing of may carry over but losses, clipping, flips, weight decay and seed."""


@pytest.mark.parametrize("preset", ["best", "real", "bare", "paper", "selfflow"])
def test_whatever_the_preset_the_pairs_are_seen_as_they_are_and_without_truth(preset: str, tmp_path: Path) -> None:
    """Fails with any one of the fixed settings left out that this preset sets otherwise."""
    recorded = train_config(preset)
    levels = recorded.model.levels
    model = ModelConfig(levels=levels, projected_channels=8, estimator="shared", registration=RegistrationConfig())
    rate = min(recorded.learning_rate, 1e-4) if recorded.schedule == "one_cycle" else recorded.learning_rate
    method = Learned(random_weights(tmp_path / "w.safetensors", model, recorded, recorded.image_size), device="cpu")
    for config in (None, preset):
        settings = fine_tuning_settings(method, 1600, config, pairs=8)
        assert settings.supervision == "self"
        assert settings.motion is None
        assert settings.color_jitter == 0
        assert settings.crop_size is None
        assert settings.ema_decay == 0
        assert (settings.schedule, settings.warmup_steps, settings.learning_rate) == ("constant", 0, rate)
        assert settings.image_size == recorded.image_size
        assert settings.loss == recorded.loss
        assert settings.model == model  # its registration included
        # From the weights the paper's batches of 4, so that 1600 steps are 800 epochs; a file's own, if pairs suffice.
        assert settings.batch_size == (4 if config is None else min(recorded.batch_size, 8))


def test_nothing_else_of_the_training_carries_over(tmp_path: Path) -> None:
    """Fails with the machine's settings (devices, workers) left as recorded."""
    recorded = TrainConfig.model_validate({"model": SMALL} | UNSUITABLE)
    method = Learned(random_weights(tmp_path / "w.safetensors", SMALL, recorded), device="cpu")
    settings = fine_tuning_settings(method, 12, None, pairs=3)
    expected = TrainConfig(
        model=SMALL, loss=recorded.loss, supervision="self", mixed_self=3.0, batch_size=3, steps=12, learning_rate=1e-4,
        gradient_clip=1.0, flip=False, seed=5, device="cpu",
    )  # fmt: skip
    assert settings == expected


def test_a_constant_rate_and_the_size_of_use_are_kept(tmp_path: Path) -> None:
    """Fails with the size of the training where --size gives another: the pairs would be scored at a size not seen."""
    recorded = TrainConfig.model_validate({"model": SMALL} | UNSUITABLE | {"schedule": "constant", "warmup_steps": 0})
    path = random_weights(tmp_path / "w.safetensors", SMALL, recorded, (96, 128))
    settings = fine_tuning_settings(Learned(path, size=(64, 80), device="cpu"), 12, None, pairs=3)
    assert settings.learning_rate == 4e-4
    assert settings.image_size == (64, 80)
    assert fine_tuning_settings(Learned(path, device="cpu"), 12, None, pairs=3).image_size == (96, 128)


def test_exact_flow_is_not_looked_at(tmp_path: Path) -> None:
    """Fails with supervision = "flow" or "mixed" carried over: the same images with and without their exact flow."""
    shifts = [(1.5, 0.5), (-1.0, 0.0)]
    plain = open_pairs(write_folder(tmp_path / "plain", {"a": shifts[0], "b": shifts[1]}))
    exact = open_pairs(write_synthetic(tmp_path / "exact", shifts))
    recorded = TrainConfig.model_validate({"model": SMALL} | UNSUITABLE)
    method = Learned(random_weights(tmp_path / "w.safetensors", SMALL, recorded), "net", device="cpu")
    runs = [fine_tuned(method, dataset, tmp_path / f"run{k}", 3) for k, dataset in enumerate((plain, exact))]
    assert [run.name for run in runs] == ["net+ft"] * 2
    assert same_weights(runs[0].path, runs[1].path)
    assert not same_weights(runs[0].path, method.path)
    recorded_now = json.loads(read_metadata(runs[0].path)["train"])
    assert (recorded_now["supervision"], recorded_now["steps"]) == ("self", 3)


def test_pairs_of_several_sizes_need_one(tmp_path: Path) -> None:
    folders = [write_folder(tmp_path / f"{k}", {"a": (1, 0)}, size) for k, size in enumerate([(64, 80), (72, 80)])]
    dataset: PairDataset = join([open_pairs(folder) for folder in folders])
    recorded = TrainConfig.model_validate({"model": SMALL} | UNSUITABLE)
    path = random_weights(tmp_path / "w.safetensors", SMALL, recorded)
    with pytest.raises(InputError, match="64x80, 72x80 px, a batch needs one size; give --size"):
        fine_tuned(Learned(path, device="cpu"), dataset, tmp_path / "run", 1)
    assert fine_tuned(Learned(path, size=(64, 80), device="cpu"), dataset, tmp_path / "run", 1).path.is_file()

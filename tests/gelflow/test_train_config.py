"""Settings: the paper's values, refusals that name the field, presets and that each trains."""

import datetime
import itertools
import tomllib
from importlib.resources import files
from pathlib import Path

import pytest
import torch
from commands import refused
from waves import Shifts

from gelflow.config import REGISTRATIONS, LossConfig, ModelConfig, RegistrationConfig, TrainConfig
from gelflow.config.sources import PRESETS, train_config
from gelflow.config.validation import validated
from gelflow.models.gelflow import CORRELATION_RADIUS, FINEST_SCALE
from gelflow.training import train


def test_defaults_are_the_readings_of_the_paper_and_its_preset_states_them() -> None:
    model, loss, run = ModelConfig(), LossConfig(), TrainConfig()
    assert (model.levels, FINEST_SCALE, CORRELATION_RADIUS, model.lffm) == (8, 2, 4, True)
    assert (loss.alpha, loss.beta, loss.lambda_theta, loss.lambda_zeta) == (0.85, 10, 0.01, 0.01)
    assert (loss.lambda_dc, loss.lambda_df, loss.lambda_s) == (75, 0.01, (1,) * 7)
    assert (loss.smoothness, loss.least_weight) == ("helmholtz", 0)
    assert (run.batch_size, run.learning_rate, run.weight_decay, run.supervision) == (4, 1e-4, 1e-6, "self")
    paper = train_config("paper")
    assert paper == TrainConfig(image_size=(512, 640))
    assert paper.steps == 200 * 1328 // 4  # 200 epochs of 1327 pairs in batches of 4, the last one filled up
    text = tomllib.loads(files("gelflow").joinpath("presets", "paper.toml").read_text(encoding="utf-8"))
    published = {f"lambda_{name}" for name in ("dc", "theta", "zeta", "df", "s")} | {"alpha", "beta"}
    assert published <= set(text["loss"])
    assert {"levels", "lffm"} <= set(text["model"])


@pytest.mark.parametrize(("values", "words"), [
    ({"lr": 1}, "lr: there is no such setting; allowed: model, loss"),
    ({"loss": {"lambda_x": 1}}, "loss.lambda_x: there is no such setting; allowed: alpha"),
    ({"loss": {"alpha": 2}}, r"loss.alpha: .*less than or equal to 1 \(given: 2\)"),
    ({"model": {"estimator": "both"}}, "model.estimator: .*'per_scale' or 'shared'.*both"),
    ({"model": {"registration": {"prior": 1}}}, "model.registration.prior: .*allowed: windows_px, "),
    ({"model": {"levels": 6}}, "loss.lambda_s has 7 numbers; model.levels asks for 5"),
    ({"loss": {"lambda_s": [0.0] * 7}}, "at least one of them above 0"),
    ({"crop_size": [32, 64]}, r"crop_size = \[32, 64\]: each side must be at least 64 px"),
    ({"image_size": [64, 64], "crop_size": [64, 80]}, "does not fit into image_size"),
    ({"steps": 10, "warmup_steps": 10}, "warmup_steps = 10 must be below steps = 10"),
    ({"steps": 0}, "steps: .*greater than or equal to 1"),
    ({"learning_rate": float("nan")}, "learning_rate"),
    ({"batch_size": True}, "batch_size: .*integer .*True"),
    ({"batch_size": "2"}, "batch_size: .*integer .*'2'"),
    ({"loss": {"alpha": True}}, "loss.alpha: .*number .*True"),
    ({"loss": {"lambda_dc": "5"}}, "loss.lambda_dc: .*number .*'5'"),
    ({"loss": {"lambda_s": [True] * 7}}, "loss.lambda_s.0: .*number .*True"),
    ({"flip": "no"}, "flip: .*boolean .*no"),
    ({"seed": datetime.date(2000, 1, 1)}, "seed: .*integer .*2000-01-01"),
])  # fmt: skip
def test_wrong_values_are_named_with_what_is_allowed(values: dict, words: str) -> None:
    said = refused(words, validated, TrainConfig, values, "run.toml")
    assert said.startswith("run.toml: ")
    assert "\n" not in said


def test_numbers_lists_json_and_earlier_records_serve_where_they_mean_the_same() -> None:
    values = {"steps": 1e3, "learning_rate": 1, "precision": 32, "image_size": [64.0, 80], "gradient_clip": 1e30}
    config = train_config(None, [f"{name}={value}" for name, value in values.items()])
    expected = {"steps": 1000, "learning_rate": 1.0, "precision": "32", "image_size": (64, 80), "gradient_clip": 1e30}
    found = {name: getattr(config, name) for name in expected}
    assert found == expected
    assert list(map(type, found.values())) == list(map(type, expected.values()))
    # Settings that are gone are read with the value that every run has now, and refused with another.
    config = TrainConfig(image_size=(64, 80), loss=LossConfig(least_weight=0.1))
    assert validated(TrainConfig, config.model_dump(mode="json"), "json") == config
    loss = {"lambda_ph": 1.0, "lambda_census": 0.0, "mask_outside": True, "weight": "anti_edge", "weight_floor": 0.1}
    model = {"finest_scale": 2, "normalise_features": True, "lffm_scale": "inverse_sqrt"}
    assert validated(TrainConfig, {"model": model, "loss": loss, "compile": True}, "weights") == TrainConfig()
    assert validated(ModelConfig, model, "weights") == ModelConfig()
    gone = {"loss": {"lambda_census": 0.1}}
    refused(r"loss\.lambda_census: there is no such setting", validated, TrainConfig, gone, "weights")


def test_registration_has_names_of_which_fields_can_be_changed() -> None:
    start = {"model": ModelConfig(registration=REGISTRATIONS["brightness"]).model_dump()}
    for name, meant in REGISTRATIONS.items():
        assert train_config(None, [f"model.registration={name}"], start=start).model.registration == meant
    words = "'movement' is no registration; names are none, motion, both, brightness"
    refused(words, train_config, "best", ["model.registration=movement"])
    for preset, given in itertools.product(("best", "real", "bare"), (None, start)):
        config = train_config(preset, ["model.registration.prior_px=0.5"], start=given)
        assert config.model.registration == RegistrationConfig(prior_px=0.5)


def test_presets_say_what_they_differ_in() -> None:
    paper, selfflow, arflow, best, bare = map(train_config, ("paper", "selfflow", "arflow", "best", "bare"))
    assert (selfflow.loss.smoothness, selfflow.model.lffm) == ("first_order", False)
    assert (arflow.loss.smoothness, arflow.loss.smoothness_s) == ("second_order", (1, 0, 0, 0, 0, 0))
    assert (arflow.model.estimator, arflow.model.levels, arflow.loss.lambda_dc) == ("shared", 7, 75)
    shared = {"steps", "batch_size", "learning_rate", "image_size"}
    assert all(preset.model_dump(include=shared) == paper.model_dump(include=shared) for preset in (selfflow, arflow))
    assert (best.supervision, best.loss.compare_at, best.loss.warping) == ("flow", "image", "spline")
    assert best.ema_decay > 0
    # Nothing that a sensor could not do to pairs.
    assert (bare.supervision, bare.flip, bare.color_jitter) == ("flow", False, 0)
    assert bare.motion is bare.crop_size is None
    assert bare.model == best.model.model_copy(update={"registration": None})


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_trains(name: str, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    # The published numbers of levels and channels are what takes the time: two steps at the smallest size.
    tiny = ["steps=2", "batch_size=2", "image_size=[64, 64]", "crop_size=[64, 64]", "device=cpu"]
    result = train(train_config(name, tiny), Shifts(2, 64, 1.0, seed=1), None, tmp_path)
    assert result.steps == 2
    assert result.weights.is_file()


def test_settings_come_from_a_file_a_preset_and_assignments(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text("steps = 7\n[loss]\nlambda_dc = 3.0\n")
    config = train_config(path, ["loss.lambda_df=0.5"])
    assert (config.steps, config.loss.lambda_dc, config.loss.lambda_df) == (7, 3, 0.5)
    words = r"papier: neither a configuration file nor a preset; presets are best, real, bare, paper"
    refused(words, train_config, "papier")
    assert train_config("best", ["steps=1e2"]).warmup_steps == 99
    refused("must be below steps = 4", train_config, "best", ["warmup_steps=4", "steps=4"])

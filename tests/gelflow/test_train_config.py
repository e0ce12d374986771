"""Settings: the paper's values, refusals that name the field, imports that stay light."""

import datetime
import subprocess
import sys

import pytest

from gelflow.config import REGISTRATIONS, LossConfig, ModelConfig, RegistrationConfig, TrainConfig
from gelflow.config.sources import train_config
from gelflow.config.validation import validated
from gelflow.errors import InputError


def test_defaults_are_the_readings_of_the_paper() -> None:
    model, loss, run = ModelConfig(), LossConfig(), TrainConfig()
    assert (model.levels, model.finest_scale, model.correlation_radius, model.lffm_region) == (8, 2, 4, 3)
    assert (loss.alpha, loss.beta, loss.lambda_theta, loss.lambda_zeta) == (0.85, 10, 0.01, 0.01)
    assert (loss.lambda_dc, loss.lambda_df, loss.lambda_s) == (75, 0.01, (1,) * 7)
    assert (loss.smoothness, loss.flow_normalisation, loss.ratio, loss.weight) == (
        "helmholtz", "min_side", "product", "anti_edge")  # fmt: skip
    assert (run.batch_size, run.learning_rate, run.weight_decay, run.supervision) == (4, 1e-4, 1e-6, "self")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"lr": 1}, "lr: there is no such setting; allowed: model, loss"),
        ({"loss": {"lambda_x": 1}}, "loss.lambda_x: there is no such setting; allowed: alpha"),
        ({"loss": {"alpha": 2}}, r"loss.alpha: .*less than or equal to 1 \(given: 2\)"),
        ({"loss": {"alpha": "high"}}, "loss.alpha: .*number.*high"),
        ({"model": {"estimator": "both"}}, "model.estimator: .*'per_scale' or 'shared'.*both"),
        ({"model": {"registration": {"prior": 1}}}, "model.registration.prior: .*allowed: windows_px, "),
        ({"model": {"levels": 4, "finest_scale": 3}}, "finest_scale = 3 must be below the coarsest scale 3"),
        ({"model": {"levels": 6}}, "loss.lambda_s has 7 numbers; model.levels asks for 5"),
        ({"loss": {"lambda_s": [0.0] * 7}}, "at least one of them above 0"),
        ({"crop_size": [32, 64]}, r"crop_size = \[32, 64\]: each side must be at least 64 px"),
        ({"image_size": [64, 64], "crop_size": [64, 80]}, "does not fit into image_size"),
        ({"steps": 10, "warmup_steps": 10}, "warmup_steps = 10 must be below steps = 10"),
        ({"steps": 0}, "steps: .*greater than or equal to 1"),
        ({"learning_rate": float("nan")}, "learning_rate"),
        ({"batch_size": True}, "batch_size: .*integer .*True"),
        ({"batch_size": 2.5}, "batch_size: .*integer .*2.5"),
        ({"batch_size": "2"}, "batch_size: .*integer .*'2'"),
        ({"loss": {"alpha": True}}, "loss.alpha: .*number .*True"),
        ({"loss": {"lambda_dc": "5"}}, "loss.lambda_dc: .*number .*'5'"),
        ({"loss": {"lambda_s": [True] * 7}}, "loss.lambda_s.0: .*number .*True"),
        ({"flip": "no"}, "flip: .*boolean .*no"),
        ({"flip": 1}, "flip: .*boolean .*1"),
        ({"seed": datetime.date(2000, 1, 1)}, "seed: .*integer .*2000-01-01"),
    ],
)
def test_wrong_values_are_named_with_what_is_allowed(values: dict, words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        validated(TrainConfig, values, "run.toml")
    assert str(error.value).startswith("run.toml: ")
    assert "\n" not in str(error.value)


def test_numbers_and_lists_serve_where_they_mean_the_same() -> None:
    values = {"steps": 1e3, "learning_rate": 1, "precision": 32, "image_size": [64.0, 80], "gradient_clip": 1e30}
    config = train_config(None, [f"{name}={value}" for name, value in values.items()])
    assert (config.steps, config.learning_rate, config.precision) == (1000, 1, "32")
    assert (config.image_size, config.gradient_clip) == ((64, 80), 1e30)
    assert [type(value) for value in (config.steps, config.learning_rate, config.gradient_clip)] == [int, float, float]


def test_a_configuration_survives_json() -> None:
    config = TrainConfig(image_size=(64, 80), loss=LossConfig(weight="floor"))
    assert validated(TrainConfig, config.model_dump(mode="json"), "json") == config


def test_what_earlier_versions_recorded_is_read_where_it_means_the_same() -> None:
    """Settings that are gone are read with the value that every run has now, and refused with another."""
    loss = {"lambda_ph": 1.0, "lambda_census": 0.0, "mask_outside": True}
    assert validated(TrainConfig, {"loss": loss, "compile": True}, "weights") == TrainConfig()
    with pytest.raises(InputError, match=r"loss\.lambda_census: there is no such setting"):
        validated(TrainConfig, {"loss": {"lambda_census": 0.1}}, "weights")


def test_registration_has_names() -> None:
    """Fails with names merged into the settings of the weights that a fine-tuning starts from."""
    start = {"model": ModelConfig(registration=REGISTRATIONS["brightness"]).model_dump()}
    for name, meant in REGISTRATIONS.items():
        assert train_config(None, [f"model.registration={name}"], start=start).model.registration == meant
    with pytest.raises(InputError, match="'movement' is no registration; names are none, motion, both, brightness"):
        train_config("best", ["model.registration=movement"])


@pytest.mark.parametrize("preset", ["best", "real", "bare"])
def test_a_field_changes_a_registration_that_has_a_name(preset: str) -> None:
    """Fails with names left as they are until all settings have been merged."""
    for start in (None, {"model": ModelConfig(registration=REGISTRATIONS["brightness"]).model_dump()}):
        config = train_config(preset, ["model.registration.prior_px=0.5"], start=start)
        assert config.model.registration == RegistrationConfig(prior_px=0.5)


def test_importing_the_package_and_the_settings_loads_nothing_heavy() -> None:
    code = (
        "import sys, gelflow, gelflow.config; print([m for m in ('torch', 'numpy', 'lightning') if m in sys.modules])"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"

"""The configurations that come with the package: what each says, and that each trains."""

import tomllib
from importlib.resources import files
from pathlib import Path

import pytest
import torch
from waves import Shifts

from gelflow.config import TrainConfig
from gelflow.config.sources import PRESETS, train_config
from gelflow.errors import InputError
from gelflow.train import train

TINY = ["steps=2", "warmup_steps=0", "batch_size=2", "image_size=[64, 64]", "crop_size=[64, 64]", "device=cpu"]


def test_paper_states_the_defaults() -> None:
    """Every default is the paper's reading, so the preset differs in nothing but the published image size."""
    paper = train_config("paper")
    assert paper == TrainConfig(image_size=(512, 640))
    assert paper.steps == 200 * 1328 // 4  # 200 epochs of 1327 pairs in batches of 4, the last one filled up


def test_paper_writes_out_every_field_of_its_losses_and_network() -> None:
    """A default that changes must not change the paper's configuration unseen."""
    text = tomllib.loads(files("gelflow").joinpath("presets", "paper.toml").read_text(encoding="utf-8"))
    published = {
        "alpha",
        "lambda_dc",
        "lambda_theta",
        "lambda_zeta",
        "lambda_df",
        "beta",
        "lambda_s",
        "ratio",
        "weight",
    }
    assert published <= set(text["loss"])
    assert {"levels", "lffm", "lffm_region", "finest_scale"} <= set(text["model"])


def test_the_comparisons_differ_from_the_paper_in_what_they_say() -> None:
    paper, selfflow, arflow = (train_config(name) for name in ("paper", "selfflow", "arflow"))
    assert (selfflow.loss.smoothness, selfflow.model.lffm) == ("first_order", False)
    assert (arflow.loss.smoothness, arflow.loss.smoothness_s) == ("second_order", (1, 0, 0, 0, 0, 0))
    assert (arflow.model.estimator, arflow.model.levels, arflow.loss.lambda_dc) == ("shared", 7, 75)
    for other in (selfflow, arflow):
        assert (other.steps, other.batch_size, other.learning_rate, other.image_size) == (
            paper.steps, paper.batch_size, paper.learning_rate, paper.image_size)  # fmt: skip


def test_best_trains_on_the_exact_flow() -> None:
    best = train_config("best")
    assert (best.supervision, best.loss.compare_at, best.loss.warping) == ("flow", "image", "spline")
    assert best.ema_decay > 0


def test_bare_does_nothing_to_pairs_that_a_sensor_could_not() -> None:
    bare, best = train_config("bare"), train_config("best")
    assert (bare.supervision, bare.motion, bare.flip, bare.color_jitter, bare.crop_size) == (
        "flow",
        None,
        False,
        0,
        None,
    )
    assert bare.model == best.model.model_copy(update={"registration": None})


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_trains(name: str, tmp_path: Path) -> None:
    torch.set_num_threads(1)
    # The published numbers of levels and channels are what takes the time: two steps at the smallest size.
    config = train_config(name, TINY)
    result = train(config, Shifts(2, 64, 1.0, seed=1), None, tmp_path)
    assert result.steps == 2
    assert result.weights.is_file()


def test_assignments_and_files_still_work(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text("steps = 7\n[loss]\nlambda_dc = 3.0\n")
    assert train_config(path, ["loss.lambda_df=0.5"]).loss.lambda_df == 0.5
    assert train_config(path).steps == 7
    with pytest.raises(
        InputError, match=r"papier: neither a configuration file nor a preset; presets are best, real, bare, paper"
    ):
        train_config("papier")

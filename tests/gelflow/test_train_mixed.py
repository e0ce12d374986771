"""Training on pairs with and without a known flow side by side, and the weights of scales under supervision."""

from pathlib import Path

import pytest
import torch
from torch.utils.data import ConcatDataset
from waves import Shifts

from gelflow.config import LossConfig, ModelConfig, TrainConfig
from gelflow.config.sources import train_config
from gelflow.errors import InputError
from gelflow.losses import flow_loss, self_supervised_loss
from gelflow.models import GelFlow
from gelflow.train import train
from gelflow.train.module import FlowModule
from gelflow.train.samples import checked, collate

LOSS = LossConfig(lambda_s=(1, 1, 1))
CONFIG = TrainConfig(model=ModelConfig(levels=4), loss=LOSS, supervision="mixed", mixed_self=3.0, device="cpu")


def module() -> FlowModule:
    torch.manual_seed(0)
    return FlowModule(CONFIG, GelFlow(CONFIG.model))


def test_each_pair_counts_by_what_is_known_of_it() -> None:
    """Fails with the self-supervised loss over the whole batch, and with its weight left out."""
    samples = [checked(sample) for sample in Shifts(3, 64, 2.0, seed=4)]
    samples[1]["flow"] = torch.full((2, 64, 64), torch.nan)
    samples[2]["flow"][:, :5] = torch.nan  # known in part: supervised
    batch = collate(samples)
    trained = module()
    loss, parts = trained._mixed(batch["image1"], batch["image2"], batch["flow"])
    known, unknown = [0, 2], [1]
    network = trained.model
    supervised, _ = flow_loss(network(batch["image1"][known], batch["image2"][known]), batch["flow"][known], LOSS)
    pair = batch["image1"][unknown], batch["image2"][unknown]
    alone, _ = self_supervised_loss(network(*pair), *pair, LOSS)
    torch.testing.assert_close(loss, 2 / 3 * supervised + 3.0 / 3 * alone)
    assert set(parts) == {"endpoint", "photometric", "smoothness", "deformation"}


def test_batches_of_one_kind_are_that_kind() -> None:
    samples = [checked(sample) for sample in Shifts(2, 64, 2.0, seed=4)]
    batch, trained = collate(samples), module()
    images = batch["image1"], batch["image2"]
    labelled, parts = trained._mixed(*images, batch["flow"])
    torch.testing.assert_close(labelled, flow_loss(trained.model(*images), batch["flow"], LOSS)[0])
    assert set(parts) == {"endpoint"}
    unlabelled, _ = trained._mixed(*images, None)
    torch.testing.assert_close(unlabelled, 3.0 * self_supervised_loss(trained.model(*images), *images, LOSS)[0])


def test_a_run_on_both_kinds_trains(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    bare = Shifts(2, 64, 1.0, seed=6)
    for sample in bare.samples:
        sample["flow"] = torch.full((2, 64, 64), torch.nan)
    both = ConcatDataset([bare, Shifts(2, 64, 1.0, seed=5)])  # the first pair has no flow: not refused
    config = CONFIG.model_copy(update={"steps": 2, "batch_size": 2})
    result = train(config, both, None, tmp_path)
    assert result.weights.is_file()


def test_scales_have_weights_of_their_own_under_supervision() -> None:
    """Fails with `lambda_s` used although `flow_s` is given."""
    flows = [torch.rand(1, 2, 64 >> s, 64 >> s) for s in range(3)]
    truth = torch.zeros(1, 2, 64, 64)
    only_coarse = LossConfig(lambda_s=(1, 0, 0), flow_s=(0, 0, 2))
    expected = flow_loss(flows, truth, LossConfig(lambda_s=(0, 0, 2)))[0]
    torch.testing.assert_close(flow_loss(flows, truth, only_coarse)[0], expected)
    torch.testing.assert_close(flow_loss(flows, truth, LossConfig(lambda_s=(0, 0, 2), flow_s=None))[0], expected)
    for wrong, words in (("[1, 1]", "flow_s has 2 numbers, lambda_s 7"), ("[0, 0, 0, 0, 0, 0, 0]", "flow_s is 0")):
        with pytest.raises(InputError, match=words):
            train_config(None, [f"loss.flow_s={wrong}"])

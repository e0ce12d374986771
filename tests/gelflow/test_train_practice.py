"""Practice: moving average, both directions, mixed pairs, bf16, two processes, signals, speed."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from commands import refused
from textures import table, write_folder, write_synthetic
from torch.utils.data import ConcatDataset
from waves import Shifts, same_weights, small, weights_of

from gelflow.config import LossConfig, ModelConfig, TrainConfig
from gelflow.config.sources import train_config
from gelflow.data import PairDataset
from gelflow.losses import flow_loss, self_supervised_loss
from gelflow.models import GelFlow
from gelflow.training import module, train
from gelflow.training.module import FlowModule
from gelflow.training.samples import checked, collate
from gelflow.training.state import load_state

EVERYTHING = {"lambda_s": [1.0, 1.0, 1.0], "occlusion": "forward_backward", "lambda_ar": 0.01}
LOSS = LossConfig(lambda_s=(1, 1, 1))
CONFIG = TrainConfig(model=ModelConfig(levels=4), loss=LOSS, supervision="mixed", mixed_self=3.0, device="cpu")


@pytest.fixture(scope="module")
def pairs() -> Shifts:
    torch.set_num_threads(1)
    return Shifts(3, 64, 2.0, seed=1)


def test_the_average_follows_the_weights_and_is_what_is_kept(pairs: Shifts, tmp_path: Path) -> None:
    states = []
    for steps in (1, 2):
        result = train(small(steps=steps, ema_decay=0.75), pairs, None, tmp_path / str(steps))
        states.append(load_state(tmp_path / str(steps)))
        torch.testing.assert_close(dict(weights_of(result.weights)), dict(states[-1].average), rtol=0, atol=0)
    # average_2 = 0.75 average_1 + 0.25 weights_2, one rounding each
    expected = {name: 0.75 * former + 0.25 * states[1].model[name] for name, former in states[0].average.items()}
    torch.testing.assert_close(dict(states[1].average), expected, rtol=1e-6, atol=1e-7)


def test_a_resumed_run_with_everything_on_ends_with_the_same_weights(pairs: Shifts, tmp_path: Path) -> None:
    short, long = (small(steps=steps, loss=EVERYTHING, ema_decay=0.9) for steps in (1, 2))
    whole = train(long, pairs, None, tmp_path / "whole")
    train(short, pairs, None, tmp_path / "cut")
    resumed = train(long, pairs, None, tmp_path / "cut", resume=True)
    assert same_weights(whole.weights, resumed.weights)


@pytest.mark.parametrize(("step", "late"), [(0, False), (4, False), (5, True), (9, True)])
def test_losses_that_trust_the_flow_wait_for_their_stage(step: int, late: bool, monkeypatch) -> None:
    """Else every pixel of a new network is judged hidden, and its flow grows without end."""
    asked: list[bool] = []
    monkeypatch.setattr(FlowModule, "step", step)
    monkeypatch.setattr(module, "visible_in_both_images", lambda *flows: asked.append(True))
    trained = FlowModule(small(steps=10, loss=EVERYTHING | {"second_stage": 0.5}), GelFlow(small().model))
    images = torch.rand(2, 1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    parts = trained._self_supervised(*images)[1]
    assert (asked == [True], "consistency" in parts) == (late, late)


def test_bfloat16_keeps_float32_weights_and_speed_and_memory_are_reported(pairs: Shifts, tmp_path: Path) -> None:
    values = weights_of(train(small(steps=2, precision="bf16"), pairs, None, tmp_path).weights).values()
    assert all(value.dtype == torch.float32 and torch.isfinite(value).all() for value in values)
    result = train(small(steps=10), pairs, None, tmp_path / "speed")
    rows = table(next(tmp_path.glob("speed/logs/csv/*/metrics.csv")))
    assert float(rows[-1]["train/pairs_per_second"]) > 0
    assert "pairs/s; peak memory" in str(result)
    assert (result.memory_mib or 0) > 100  # torch alone


def command(tmp_path: Path, data: Path, settings: str, *options: str) -> list[str]:
    path = tmp_path / "settings.toml"
    path.write_text(f"{settings}\nmodel = {{levels = 4, projected_channels = 8}}\nloss.lambda_s = [1.0, 1.0, 1.0]\n")
    return [sys.executable, "-m", "gelflow", "train", str(data), "--out", str(tmp_path / "run"), "--device", "cpu",
            "--config", str(path), *options]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("option", ["--devices", "--nodes"])
def test_two_processes_end_as_one_with_twice_the_batch(tmp_path: Path, option: str) -> None:
    """Gradients are averaged over processes, so that 2 x 1 pairs are 1 x 2 pairs."""
    folder = write_synthetic(tmp_path / "data", [(1.0, 0.5)] * 4, (64, 64))
    config = small(batch_size=2, steps=3, learning_rate=1e-4, supervision="flow")
    one = train(config, PairDataset(folder), None, tmp_path / "one").weights
    both = command(tmp_path, folder, "steps = 3\nbatch_size = 1\nsupervision = 'flow'\nworkers = 1", option, "2")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        environment = os.environ | {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
    said = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    ranks = ({"NODE_RANK": str(rank)} for rank in range(2 if option == "--nodes" else 1))
    machines = [subprocess.Popen(both, env=environment | rank, **said) for rank in ranks]
    texts = [machine.communicate(timeout=240) for machine in machines]
    assert [machine.returncode for machine in machines] == [0] * len(machines), texts
    assert sum(printed.count("weights.safetensors") for printed, _ in texts) == 1
    first, second = (weights_of(path) for path in (one, tmp_path / "run" / "weights.safetensors"))
    # The same gradients up to float32 rounding. Adam's first steps are the sign of the gradient times 1e-4, so that a
    # gradient near zero may turn: all but a few weights must agree to a hundredth of a step.
    differences = torch.cat([(first[name] - second[name]).abs().flatten() for name in first])
    assert (differences < 1e-6).float().mean() > 0.99
    assert differences.max() < 6.1e-4  # three steps, each to the other side


@pytest.mark.parametrize(
    ("send", "devices"),
    [(os.killpg, 1), *(pytest.param(send, 2, marks=pytest.mark.slow) for send in (os.kill, os.killpg))],
)
def test_sigterm_stops_a_run_as_ctrl_c_does(tmp_path: Path, send: Callable[[int, int], None], devices: int) -> None:
    """Sent to all its processes, as SLURM does, or to the first, as `timeout` does."""
    folder, out = write_folder(tmp_path / "data", {"a": (1.0, 0.5)}, (64, 64)), tmp_path / "run"
    settings = "steps = 100_000\nbatch_size = 1\nsave_every = 1\nworkers = 1"
    run = subprocess.Popen(command(tmp_path, folder, settings, "--devices", str(devices)), stderr=subprocess.PIPE,
                           text=True, start_new_session=True)  # fmt: skip
    try:
        ends = time.monotonic() + 150
        while not (out / "state.ckpt").exists() and run.poll() is None and time.monotonic() < ends:
            time.sleep(0.05)
        send(run.pid, signal.SIGTERM)
        text = run.communicate(timeout=60)[1]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
    assert run.returncode == 130, text
    assert [text.count(words) for words in ("stopping after this step", "stopped; step")] == [1, 1]
    assert f"stopped; step {load_state(out).step} of 100000 is saved" in text
    assert (out / "weights.safetensors").exists()


def test_each_pair_counts_by_what_is_known_of_it() -> None:
    samples = [checked(sample) for sample in Shifts(3, 64, 2.0, seed=4)]
    samples[1]["flow"] = torch.full((2, 64, 64), torch.nan)
    samples[2]["flow"][:, :5] = torch.nan  # known in part: supervised
    torch.manual_seed(0)
    batch, trained = collate(samples), FlowModule(CONFIG, GelFlow(CONFIG.model))

    def supervised(which: list[int]) -> torch.Tensor:
        flows = trained.model(batch["image1"][which], batch["image2"][which])
        return flow_loss(flows, batch["flow"][which], LOSS)[0]

    def alone(which: list[int]) -> torch.Tensor:
        pair = batch["image1"][which], batch["image2"][which]
        return self_supervised_loss(trained.model(*pair), *pair, LOSS)[0]

    loss, parts = trained._mixed(batch["image1"], batch["image2"], batch["flow"])
    torch.testing.assert_close(loss, 2 / 3 * supervised([0, 2]) + 3.0 / 3 * alone([1]))
    assert set(parts) == {"endpoint", "photometric", "smoothness", "deformation"}
    # Batches of one kind are that kind.
    labelled, parts = trained._mixed(batch["image1"][[0, 2]], batch["image2"][[0, 2]], batch["flow"][[0, 2]])
    torch.testing.assert_close(labelled, supervised([0, 2]))
    assert set(parts) == {"endpoint"}
    unlabelled, _ = trained._mixed(batch["image1"], batch["image2"], None)
    torch.testing.assert_close(unlabelled, 3.0 * alone([0, 1, 2]))


def test_a_run_on_both_kinds_trains_and_scales_have_weights_of_their_own(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    bare, known = (Shifts(2, 64, 1.0, seed=seed) for seed in (6, 5))
    for sample in bare.samples:
        sample["flow"] = torch.full((2, 64, 64), torch.nan)
    config = CONFIG.model_copy(update={"steps": 2, "batch_size": 2})
    both = ConcatDataset([bare, known])  # the first pair has no flow: not refused
    assert train(config, both, None, tmp_path).weights.is_file()
    flows, truth = [torch.rand(1, 2, 64 >> s, 64 >> s) for s in range(3)], torch.zeros(1, 2, 64, 64)
    coarse, own = LossConfig(lambda_s=(0, 0, 2)), LossConfig(lambda_s=(1, 0, 0), flow_s=(0, 0, 2))
    torch.testing.assert_close(flow_loss(flows, truth, own)[0], flow_loss(flows, truth, coarse)[0])
    assert flow_loss(flows, truth, own)[0] > 0
    for wrong, words in (("[1, 1]", "flow_s has 2 numbers, lambda_s 7"), ("[0, 0, 0, 0, 0, 0, 0]", "flow_s is 0")):
        refused(words, train_config, None, [f"loss.flow_s={wrong}"])

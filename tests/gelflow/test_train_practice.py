"""Practice: moving average, both directions and consistency resume bit by bit; bf16; two processes; speed."""

import contextlib
import csv
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
from textures import write_folder, write_synthetic
from waves import Shifts, same_weights, small

from gelflow.data import open_pairs
from gelflow.models import GelFlow
from gelflow.models.weights import load_weights
from gelflow.train import module, train
from gelflow.train.module import FlowModule
from gelflow.train.state import load_state


@pytest.fixture(scope="module")
def pairs() -> Shifts:
    torch.set_num_threads(1)
    return Shifts(3, 64, 2.0, seed=1)


def test_the_average_follows_the_weights_and_is_what_is_kept(pairs: Shifts, tmp_path: Path) -> None:
    """Fails with the average moved before the optimiser's step."""
    kept = []
    for steps in (1, 2):
        result = train(small(steps=steps, ema_decay=0.75), pairs, None, tmp_path / str(steps))
        state = load_state(tmp_path / str(steps))
        assert state.average is not None
        kept.append((state.model, state.average))
        loaded = load_weights(result.weights).state_dict()
        assert all(torch.equal(loaded[name], state.average[name]) for name in loaded)
    for name, average in kept[1][1].items():
        # average_2 = 0.75 average_1 + 0.25 weights_2, one rounding each
        expected = 0.75 * kept[0][1][name] + 0.25 * kept[1][0][name]
        torch.testing.assert_close(average, expected, rtol=1e-6, atol=1e-7)


def test_a_resumed_run_with_everything_on_ends_with_the_same_weights(pairs: Shifts, tmp_path: Path) -> None:
    """Fails with the average left out of the saved state, and with an unseeded transformation."""
    loss = {"lambda_s": [1.0, 1.0, 1.0], "occlusion": "forward_backward", "lambda_ar": 0.01}
    options = {"loss": loss, "ema_decay": 0.9}
    whole = train(small(steps=4, **options), pairs, None, tmp_path / "whole")
    train(small(steps=2, **options), pairs, None, tmp_path / "cut")
    resumed = train(small(steps=4, **options), pairs, None, tmp_path / "cut", resume=True)
    assert same_weights(whole.weights, resumed.weights)


@pytest.mark.parametrize(("step", "late"), [(0, False), (4, False), (5, True), (9, True)])
def test_losses_that_trust_the_flow_wait_for_their_stage(
    step: int, late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else every pixel of a new network is judged hidden, and its flow grows without end."""
    # Fails with either of the two from the start.
    asked: list[bool] = []
    monkeypatch.setattr(FlowModule, "step", step)
    monkeypatch.setattr(module, "visible_in_both_images", lambda *flows: asked.append(True))
    loss = {"lambda_s": [1.0, 1.0, 1.0], "occlusion": "forward_backward", "lambda_ar": 0.01, "second_stage": 0.5}
    trained = FlowModule(small(steps=10, loss=loss), GelFlow(small().model))
    images = torch.rand(2, 1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    parts = trained._self_supervised(*images)[1]
    assert (asked == [True], "consistency" in parts) == (late, late)


def test_bfloat16_trains_and_keeps_float32_weights(pairs: Shifts, tmp_path: Path) -> None:
    result = train(small(steps=2, precision="bf16"), pairs, None, tmp_path)
    values = load_weights(result.weights).state_dict().values()
    assert all(value.dtype == torch.float32 and torch.isfinite(value).all() for value in values)


@pytest.mark.slow
@pytest.mark.parametrize("option", ["--devices", "--nodes"])
def test_two_processes_end_as_one_with_twice_the_batch(tmp_path: Path, option: str) -> None:
    """Gradients are averaged over processes, so that 2 x 1 pairs are 1 x 2 pairs.

    Fails with both processes given the same pairs.
    """
    folder = write_synthetic(tmp_path / "data", [(1.0, 0.5)] * 4, (64, 64))
    options = {"steps": 3, "learning_rate": 1e-4, "supervision": "flow"}
    one = train(small(batch_size=2, **options), open_pairs(folder), None, tmp_path / "one").weights
    settings = tmp_path / "settings.toml"
    settings.write_text("steps = 3\nbatch_size = 1\nsupervision = 'flow'\n[model]\nlevels = 4\nprojected_channels = 8\n"
                        "[loss]\nlambda_s = [1.0, 1.0, 1.0]\n")  # fmt: skip
    command = [sys.executable, "-m", "gelflow", "train", str(folder), "--out", str(tmp_path / "two"), "--device", "cpu",
               "--config", str(settings), option, "2"]  # fmt: skip
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        environment = os.environ | {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1])}
    machines = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                                 env=environment | {"NODE_RANK": str(rank)})
                for rank in range(2 if option == "--nodes" else 1)]  # fmt: skip
    texts = [machine.communicate(timeout=240) for machine in machines]
    assert [machine.returncode for machine in machines] == [0] * len(machines), texts
    assert sum(printed.count("weights.safetensors") for printed, _ in texts) == 1
    first, second = (load_weights(path).state_dict() for path in (one, tmp_path / "two" / "weights.safetensors"))
    # The same gradients up to float32 rounding. Adam's first steps are the sign of the gradient times 1e-4, so that a
    # gradient near zero may turn: all but a few weights must agree to a hundredth of a step.
    differences = torch.cat([(first[name] - second[name]).abs().flatten() for name in first])
    assert (differences < 1e-6).float().mean() > 0.99
    assert differences.max() < 6.1e-4  # three steps, each to the other side


@pytest.mark.parametrize(
    ("send", "devices"),
    [
        (os.killpg, 1),
        pytest.param(os.kill, 2, marks=pytest.mark.slow),
        pytest.param(os.killpg, 2, marks=pytest.mark.slow),
    ],
)
def test_sigterm_stops_a_run_as_ctrl_c_does(tmp_path: Path, send: Callable[[int, int], None], devices: int) -> None:
    """Sent to all its processes, as SLURM does, or to the first, as `timeout` does.

    Fails with Lightning's handler, with workers that the signal ends, and where processes do not stop together.
    """
    folder, out = write_folder(tmp_path / "data", {"a": (1.0, 0.5)}, (64, 64)), tmp_path / "run"
    settings = tmp_path / "settings.toml"
    settings.write_text("steps = 100_000\nbatch_size = 1\nsave_every = 1\nworkers = 1\n[model]\nlevels = 4\n"
                        "projected_channels = 8\n[loss]\nlambda_s = [1.0, 1.0, 1.0]\n")  # fmt: skip
    command = [sys.executable, "-m", "gelflow", "train", str(folder), "--out", str(out), "--device", "cpu",
               "--config", str(settings), "--devices", str(devices)]  # fmt: skip
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        while not (out / "state.ckpt").exists() and run.poll() is None:
            time.sleep(0.05)
        send(run.pid, signal.SIGTERM)
        text = run.communicate(timeout=60)[1]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
    assert run.returncode == 130, text
    assert text.count("stopping after this step") == 1
    assert text.count("stopped; step") == 1
    assert f"stopped; step {load_state(out).step} of 100000 is saved" in text
    assert (out / "weights.safetensors").exists()


def test_speed_and_memory_are_reported(pairs: Shifts, tmp_path: Path) -> None:
    result = train(small(steps=10), pairs, None, tmp_path)
    assert result.pairs_per_second is not None
    assert result.pairs_per_second > 0
    assert "pairs/s" in str(result)
    rows = list(csv.DictReader(next(tmp_path.glob("logs/csv/*/metrics.csv")).open()))
    assert float(rows[-1]["train/pairs_per_second"]) > 0
    if result.memory_mib is not None:  # Linux
        assert "peak memory" in str(result)
        assert result.memory_mib > 100  # torch alone

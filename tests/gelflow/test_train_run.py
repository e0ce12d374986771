"""Whole runs, small: they learn, they resume bit by bit, they refuse what is not theirs."""

import errno
import json
import multiprocessing
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused
from textures import table, write_folder
from torch.utils.data import Dataset
from waves import Shifts, same_weights, small, weights_of

import gelflow
from gelflow.cli import main
from gelflow.config import TrainConfig
from gelflow.data import PairDataset
from gelflow.errors import InputError
from gelflow.models.estimate import estimate_flow
from gelflow.models.weights import load_weights, read_metadata
from gelflow.training import train
from gelflow.training.module import learning_rate_factor
from gelflow.training.state import load_state


@pytest.fixture(scope="module")
def pairs() -> Shifts:
    return Shifts(3, 64, 2.0, seed=1)


class CtrlC(Dataset):
    """Pairs of which the n-th one asked for comes with a Ctrl-C."""

    def __init__(self, pairs: Shifts, at: int) -> None:
        self.pairs, self.left = pairs, at

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> dict:
        self.left -= 1
        if self.left == 0:
            self.happens()
        return self.pairs[index]

    def happens(self) -> None:
        os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("validates", [True, False])
def test_a_run_interrupted_by_ctrl_c_ends_with_the_same_weights(pairs, tmp_path, validates, capsys) -> None:
    config = small(steps=5, validate_every=2, save_every=2, schedule="one_cycle", warmup_steps=2)
    validation, cut = pairs if validates else None, tmp_path / "cut"
    whole = train(config, pairs, validation, tmp_path / "whole")
    before = signal.getsignal(signal.SIGINT)  # ignored, where pytest runs in the background
    with pytest.raises(KeyboardInterrupt, match=r"step 3 of 5 is saved.*--resume, or use the weights so far"):
        train(config, CtrlC(pairs, 1 + 2 * 2 + 1), validation, cut)  # one to check, then two a step
    assert "stopping after this step" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGINT) is before
    state, so_far = load_state(cut), cut / "weights.safetensors"
    assert state.step == 3
    assert read_metadata(so_far)["step"] == ("2" if validates else "3")
    if not validates:
        torch.testing.assert_close(dict(weights_of(so_far)), dict(state.model), rtol=0, atol=0)
    resumed = train(config, pairs, validation, cut, resume=True)
    assert same_weights(whole.weights, resumed.weights)
    one, two = load_state(tmp_path / "whole"), load_state(cut)
    assert one.step == two.step == 5
    torch.testing.assert_close(dict(one.model), dict(two.model), rtol=0, atol=0)
    assert resumed.metrics == whole.metrics
    assert bool(resumed.metrics) == validates


def test_a_run_stopped_before_its_first_save_says_so(tmp_path: Path) -> None:
    """By SIGTERM while Lightning opens the data, before the callback handles signals, which ends the first step."""

    class Counted(Shifts):
        counts = 0

        def __len__(self) -> int:
            self.counts += 1
            if self.counts == 2:  # once to look at the data set, then for the loader
                os.kill(os.getpid(), signal.SIGTERM)
            return super().__len__()

    with pytest.raises(KeyboardInterrupt, match="stopped; nothing has been saved yet: start again"):
        train(small(steps=3), Counted(2, 64, 1.0, seed=3), None, tmp_path)


def test_a_run_killed_between_saves_goes_back_to_the_last_one_and_ends_the_same(pairs: Shifts, tmp_path: Path) -> None:
    class Killed(CtrlC):
        def happens(self) -> None:
            raise RuntimeError("power cut")

    config, cut = small(steps=4, save_every=2), tmp_path / "cut"
    whole = train(config, pairs, None, tmp_path / "whole")
    with pytest.raises(RuntimeError, match="power cut"):
        train(config, Killed(pairs, 1 + 2 * 3), None, cut)
    assert load_state(cut).step == 2
    assert same_weights(whole.weights, train(config, pairs, None, cut, resume=True).weights)


def test_a_pair_that_a_loading_process_cannot_use_is_named_and_the_process_ends(pairs: Shifts, tmp_path: Path) -> None:
    class Broken(CtrlC):
        def happens(self) -> None:
            raise InputError("pair 3: damaged")

    with pytest.raises(InputError, match=r"^pair 3: damaged$") as caught:
        train(small(steps=6, workers=1), Broken(pairs, 3), None, tmp_path)
    assert caught.traceback  # which holds the loader, as a command's does until it has printed the message
    processes = multiprocessing.active_children()
    assert processes
    for process in processes:
        process.terminate()
        process.join(10)
        assert process.exitcode == 0


UNGUARDED = """
import torch
from torch.utils.data import DataLoader
from gelflow.config import TrainConfig
from gelflow.training.loading import end_with_run, loading_context
print("begins", flush=True)
context = loading_context(TrainConfig(devices=2, workers=1))
loader = DataLoader(torch.arange(3), num_workers=1, multiprocessing_context=context, worker_init_fn=end_with_run)
print([int(one) for one in loader])
"""


def test_loading_processes_beside_several_devices_need_no_main_guard(tmp_path: Path) -> None:
    (tmp_path / "load.py").write_text(UNGUARDED)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, str(tmp_path / "load.py")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout == "begins\n[0, 1, 2]\n", done.stderr


def test_several_devices_from_a_program_that_is_no_file_are_refused(pairs: Shifts, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "argv", ["-"])
    refused("devices = 2: .* not typed or piped", train, small(steps=2, devices=2), pairs, None, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_full_disk_is_one_error_that_says_how_to_go_on(pairs: Shifts, tmp_path: Path, monkeypatch, capfd) -> None:
    """The kernel refuses what goes beyond 8 KiB of a file; then TensorBoard's thread, which prints what it meets."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, before[1]))
    try:
        with pytest.raises(OSError, match="File too large; stopped; nothing has been saved yet") as caught:
            train(small(steps=2), pairs, None, tmp_path / "state")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.filename == str(tmp_path / "state" / "state.ckpt")
    assert sorted(path.name for path in (tmp_path / "state").iterdir()) == ["logs", "run.json"]

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("tensorboard.summary.writer.record_writer.RecordWriter.write", refuse)
    with pytest.raises(OSError, match="No space left on device; stopped") as caught:
        train(small(steps=2), pairs, None, tmp_path / "logs")
    assert caught.value.filename == str(tmp_path / "logs")
    assert "Traceback" not in capfd.readouterr().err


def test_python_trains_as_the_command_does(tmp_path: Path) -> None:
    folder, settings = write_folder(tmp_path / "data", {"a": (1, 0), "b": (0, 1)}), ["device=cpu", "batch_size=1"]
    settings += ["image_size=[64, 64]", "seed=3"]
    first = gelflow.train(str(folder), tmp_path / "first", "paper", [*settings, "steps=1"], validation=[folder])
    assert first.weights == tmp_path / "first" / "weights.safetensors"
    assert first.metrics["psnr_db"] > 0
    second = gelflow.train([folder], tmp_path / "second", "paper", [*settings, "steps=1"], weights=first.weights)
    command = ["finetune", folder, "--out", tmp_path / "third", "--weights", first.weights, "--config", "paper"]
    command += ["--steps", 1, *(word for setting in settings for word in ("--set", setting))]
    assert main(list(map(str, command))) == 0
    assert same_weights(second.weights, tmp_path / "third" / "weights.safetensors")
    assert not same_weights(first.weights, second.weights)


@pytest.mark.parametrize("steps", [4, 2])
def test_a_run_whose_validation_failed_is_saved_and_validates_when_resumed(pairs: Shifts, tmp_path, steps: int) -> None:
    class OneSmall(CtrlC):
        def __getitem__(self, index: int) -> dict:
            sample = self.pairs[index]
            if index == self.left:
                sample |= {key: sample[key][..., :63, :] for key in ("image1", "image2", "flow")}
            return sample

    config, cut = small(steps=steps, validate_every=2), tmp_path / "cut"
    whole = train(config, pairs, pairs, tmp_path / "whole")
    words = r"validation pair shift_0: 63x64 px, but each side must be at least 64 px"
    refused(words, train, config, pairs, OneSmall(pairs, 0), cut)
    assert not cut.exists()
    refused(r"validation pair shift_1: 63x64 px", train, config, pairs, OneSmall(pairs, 1), cut)
    assert load_state(cut).step == 2
    resumed = train(config, pairs, pairs, cut, resume=True)
    assert (resumed.best, resumed.metrics) == (whole.best, whole.metrics)
    assert same_weights(whole.weights, resumed.weights)
    rows = [row for log in cut.glob("logs/csv/*/metrics.csv") for row in table(log)]
    validated = sorted(int(row["step"]) for row in rows if row.get("validation/psnr_db"))
    assert validated == list(range(2, steps + 1, 2))


def test_the_folder_of_a_run_holds_logs_weights_and_settings(pairs: Shifts, tmp_path: Path) -> None:
    result = train(small(steps=20, validate_every=10), pairs, pairs, tmp_path)
    rows = table(next(tmp_path.glob("logs/csv/*/metrics.csv")))
    assert [row["step"] for row in rows if row["train/loss"]] == ["10", "20"]
    first, last = (float(row["validation/endpoint_error_px"]) for row in rows if row["validation/endpoint_error_px"])
    assert list(tmp_path.glob("logs/tensorboard/*/events*"))
    assert json.loads((tmp_path / "run.json").read_text())["config"]["steps"] == 20
    # the mean length of the flows, which are constant over each image
    still = np.mean([pair["flow"][:, 0, 0].norm() for pair in pairs.samples])
    found = (result.metrics["endpoint_error_px"], result.best, result.metrics["no_motion_endpoint_error_px"])
    assert found == pytest.approx((last, min(first, last), still), rel=1e-5)
    metadata = read_metadata(result.weights)
    assert metadata["step"] == ("20" if last < first else "10")
    assert json.loads(metadata["train"])["learning_rate"] == 1e-3
    assert "endpoint error" in str(result)
    network = load_weights(result.weights)  # the kept weights are those that were validated
    flows = [estimate_flow(network, pair["image1"][None], pair["image2"][None])[0] for pair in pairs.samples]
    off = [(flow - pair["flow"]).norm(dim=0).mean() for flow, pair in zip(flows, pairs.samples, strict=True)]
    assert np.mean(off) == pytest.approx(result.best, rel=1e-4)


def test_without_truth_the_photometric_loss_chooses_and_the_learning_rate_rises_and_falls(tmp_path: Path) -> None:
    pairs = Shifts(2, 64, 1.0, seed=2, flow=False)
    result = train(small(steps=2, validate_every=1), pairs, pairs, tmp_path)
    assert set(result.metrics) == {"psnr_db", "no_motion_psnr_db", "photometric_loss"}
    assert result.best <= result.metrics["photometric_loss"]
    config = TrainConfig(steps=110, warmup_steps=10, schedule="one_cycle")
    factors = [learning_rate_factor(config, step) for step in (0, 9, 10, 60, 110)]
    assert factors == pytest.approx([0.1, 1, 1, 0.5, 0], abs=1e-15)
    assert learning_rate_factor(TrainConfig(), 1000) == 1


def test_fine_tuning_starts_from_the_given_weights_and_folders_of_other_runs_are_refused(pairs, tmp_path) -> None:
    first = train(small(steps=1), pairs, None, tmp_path / "first").weights
    # a learning rate of 1e-12 changes float32 weights of size 1e-2 by less than their rounding
    second = train(small(steps=1, learning_rate=1e-12, seed=5), pairs, None, tmp_path / "second", initial=first).weights
    torch.testing.assert_close(dict(weights_of(first)), dict(weights_of(second)), rtol=0, atol=1e-10)
    other = small(model={"levels": 5, "projected_channels": 8}, loss={"lambda_s": [1.0] * 4})
    words = r"its architecture is not that of the run .levels: 4 there, 5 here"
    refused(words, train, other, pairs, None, tmp_path / "third", initial=first)
    config, run = small(steps=2), tmp_path / "run"
    refused("no run to resume there", train, config, pairs, None, run, resume=True)
    train(config, pairs, None, run)
    before = (run / "weights.safetensors").read_bytes()
    for changed, data, resume, words in (
        (config, pairs, False, "holds a run already; add --resume"),
        (small(steps=2, learning_rate=0.1), pairs, True, r"another run than .*learning_rate: 0.001 there, 0.1 now"),
        (config, Shifts(1, 64, 1.0, seed=3), True, "pairs: 3 there, 1 now"),
        (small(steps=1), pairs, True, "has done 2 steps, more than the 1 asked for"),
    ):
        refused(words, train, changed, data, None, run, resume=resume)
    assert (run / "weights.safetensors").read_bytes() == before
    (tmp_path / "run.json").write_text("{}")
    refused(r"run\.json: exists and does not come from", train, small(steps=1), pairs, None, tmp_path)
    assert (tmp_path / "run.json").read_text() == "{}"


def test_a_run_is_not_resumed_with_other_pairs(tmp_path: Path) -> None:
    run, folders = tmp_path / "run", (write_folder(tmp_path / n, dict.fromkeys(n, (1.0, 0.0))) for n in ("ab", "ac"))
    data, other = map(PairDataset, folders)
    train(small(steps=1), data, data, run)
    for pairs, validation, words in ((other, data, "training"), (data, other, "validation")):
        refused(f"{words}_pairs_sha256: ", train, small(steps=2), pairs, validation, run, resume=True)


def test_settings_that_cannot_be_served_or_diverge_are_told_and_leave_nothing(pairs: Shifts, tmp_path: Path) -> None:
    bare = Shifts(1, 64, 1.0, seed=3, flow=False)
    refused('supervision = "self"', train, small(supervision="flow"), bare, None, tmp_path / "a")
    refused("training set: holds no pair", train, small(), Shifts(0, 64, 1.0, seed=3), None, tmp_path / "b")
    if not torch.cuda.is_available():
        refused("no CUDA device was found", train, small(device="cuda"), pairs, None, tmp_path / "c")
    assert not list(tmp_path.iterdir())
    words = "training has diverged; lower learning_rate"
    refused(words, train, small(steps=20, learning_rate=1e30), pairs, None, tmp_path)
    assert not (tmp_path / "state.ckpt").exists()


@pytest.mark.parametrize("supervision", ["flow", "self"])
def test_training_learns_the_motion_of_a_few_pairs(supervision: str, tmp_path: Path) -> None:
    """Measured with three seeds: 0.12 to 0.20 of the motion is left, with its truth as from the images alone."""
    pairs = Shifts(4, 64, 3.0, seed=20)
    config = small(
        model={"levels": 4, "projected_channels": 16}, supervision=supervision, batch_size=4, steps=20, flip=False,
        schedule="one_cycle", warmup_steps=5, gradient_clip=1.0)  # fmt: skip
    result = train(config, pairs, pairs, tmp_path)
    assert result.best < result.metrics["no_motion_endpoint_error_px"] / 3

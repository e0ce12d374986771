"""What happens around the steps of a run: saving, choosing the best weights, showing progress, stopping when asked to.

Ctrl-C (SIGINT) and SIGTERM (a time limit, `docker stop`) ask alike.
"""

import math
import resource
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.utilities import rank_zero_only

from gelflow.config import TrainConfig
from gelflow.errors import InputError
from gelflow.models.weights import save_weights
from gelflow.terminal import Advance
from gelflow.training.module import LOG_EVERY, FlowModule
from gelflow.training.state import WEIGHTS, State, save_state


class Throughput:
    """Counts pairs from the end of the first step on: that one compiles, allocates and fills caches."""

    def __init__(self) -> None:
        self._pairs = 0
        self._started: float | None = None
        self._paused = 0.0

    def add(self, pairs: int) -> None:
        if self._started is None:
            self._started = time.perf_counter()
        else:
            self._pairs += pairs

    def pause(self) -> None:
        self._paused = time.perf_counter()

    def resume(self) -> None:
        if self._started is not None:
            self._started += time.perf_counter() - self._paused

    @property
    def pairs_per_second(self) -> float | None:
        """Since the first step; None before the second has ended."""
        return self._pairs / (time.perf_counter() - self._started) if self._started and self._pairs else None


def peak_memory_mib() -> float:
    """The most memory, MiB, that torch held on the CUDA device, or on a CPU the process."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        return torch.cuda.max_memory_allocated() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


class Stopped(Exception):
    """The user asked to stop; the state is saved up to the step in the folder."""


class CheckpointCallback(L.Callback):
    """Saves the state, keeps the best weights, reports progress; stops between two steps when asked to.

    `score` and `metrics` are the best score and the last results of a resumed run.
    """

    def __init__(
        self, module: FlowModule, out: Path, validates: bool, score: float | None, metrics: Mapping[str, float]
    ) -> None:
        self.module = module
        self.config = module.config
        self.out = out
        self.validates = validates
        self.score = score
        self.metrics = dict(metrics)
        self.stop = False
        self.advance: Advance | None = None
        self.throughput = Throughput()

    def ask_to_stop(self, *_: Any) -> None:
        """A signal's handler: the first asks to stop after the step, the second stops at once."""
        if self.stop:
            raise Stopped
        self.stop = True
        if is_first_process():
            print("stopping after this step (Ctrl-C once more: at once, back to the last save)", file=sys.stderr)

    def on_train_start(self, *_: Any) -> None:
        """Takes SIGTERM from Lightning, whose own handler, just set, would end the process with status 0."""
        if _in_main_thread():
            signal.signal(signal.SIGTERM, self.ask_to_stop)  # Lightning restores the one before its own at the end

    def validates_at(self, step: int) -> bool:
        return self.validates and (step % self.config.validate_every == 0 or step == self.config.steps)

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        """Shows progress; saves where it is due, and before a validation; stops where that was asked for."""
        module, step = self.module, self.module.step
        self.throughput.add(self.config.batch_size * trainer.world_size)
        if step % LOG_EVERY == 0 or step == self.config.steps:
            self._check()
            rate, memory = self.throughput.pairs_per_second, peak_memory_mib()
            known = {"train/pairs_per_second": rate, "train/peak_memory_mib": memory}
            module.write({name: value for name, value in known.items() if value is not None}, step)
            if self.advance is not None:
                item = f"step {step} of {self.config.steps}, loss {float(module.last_loss):.4g}"
                item += "" if rate is None else f", {rate:.3g} pairs/s"
                item += f"; validation: {describe(self.metrics)}" if self.metrics else ""
                self.advance(step - module.start, self.config.steps - module.start, item)
        stop = trainer.strategy.reduce_boolean_decision(self.stop, all=False)  # whichever process was asked to
        validation_due = self.validates_at(step)
        if stop or validation_due or step % self.config.save_every == 0 or step == self.config.steps:
            self._save(trainer, validation_due)
        if stop:
            if not self.validates:
                self._keep_weights(trainer)
            trainer.strategy.barrier()  # no process leaves before the first has written the files
            raise Stopped

    def on_validation_start(self, *_: Any) -> None:
        self.throughput.pause()

    def on_validation_end(self, trainer: L.Trainer, *_: Any) -> None:
        """Keeps the weights if they are the best so far, and saves."""
        self.throughput.resume()
        self.metrics = self.module.metrics
        score = self.metrics.get("endpoint_error_px", self.metrics.get("photometric_loss"))
        if score is None:
            raise InputError("validation: no pair has a finite result; look at the validation pairs")
        if self.score is None or score < self.score:
            self.score = score
            self._keep_weights(trainer)
        self._save(trainer)
        if trainer.is_global_zero:
            print(f"step {self.module.step}: {describe(self.metrics)}", file=sys.stderr)

    def _keep_weights(self, trainer: L.Trainer) -> None:
        if trainer.is_global_zero:
            metadata = weights_metadata(self.config, self.module.step)
            save_weights(self.out / WEIGHTS, self.module.evaluated, **metadata)

    def _check(self) -> None:
        loss = float(self.module.last_loss)
        if not math.isfinite(loss):
            raise InputError(
                f"step {self.module.step}: loss {loss}: training has diverged; lower learning_rate "
                f"({self.config.learning_rate:g}) or set gradient_clip (now {self.config.gradient_clip})"
            )

    def _save(self, trainer: L.Trainer, validation_due: bool = False) -> None:
        self._check()
        if trainer.is_global_zero:
            module = self.module
            optimiser = trainer.optimizers[0].state_dict()
            average = None if module.average is None else module.average.state_dict()
            model, metrics = module.model.state_dict(), dict(self.metrics)
            state = State(module.step, model, optimiser, self.score, metrics, average, validation_due)
            save_state(self.out, state)


def weights_metadata(config: TrainConfig, step: int) -> dict[str, str]:
    """What weights say of their training."""
    return {"train": config.model_dump_json(), "step": str(step)}


def describe(metrics: Mapping[str, float]) -> str:
    """Validation metrics as one line."""
    texts = []
    if "endpoint_error_px" in metrics:
        still = metrics["no_motion_endpoint_error_px"]
        texts.append(f"endpoint error {metrics['endpoint_error_px']:.3f} px (no motion {still:.3f} px)")
    if "psnr_db" in metrics:
        texts.append(f"PSNR {metrics['psnr_db']:.2f} dB (no motion {metrics['no_motion_psnr_db']:.2f} dB)")
    return ", ".join(texts)


@contextmanager
def stopping(callback: CheckpointCallback) -> Iterator[None]:
    """While the block runs, Ctrl-C asks the callback to stop. See `CheckpointCallback.on_train_start` for SIGTERM."""
    if not _in_main_thread():
        yield
        return
    former = signal.signal(signal.SIGINT, callback.ask_to_stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)


def is_first_process() -> bool:
    """Whether this is the process that writes files and messages, among those of all devices and machines."""
    return not getattr(rank_zero_only, "rank", 0)


def _in_main_thread() -> bool:
    """Whether signals may be handled here."""
    return threading.current_thread() is threading.main_thread()

"""A training run from start to end: `train`.

Lightning drives the steps in sections that end at multiples of `validate_every`, counted from the start of the whole
run, so that a resumed run validates where an uninterrupted one does. On a CPU, with the same number of threads, both
end with the same weights, bit by bit.
"""

import sys
import threading
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch.utils.data import DataLoader, Dataset

from gelflow.config import TrainConfig
from gelflow.errors import InputError
from gelflow.files.quiet import quiet_logger
from gelflow.hardware import chosen_device
from gelflow.models import GelFlow
from gelflow.models.denoiser import Denoiser
from gelflow.models.weights import load_weights, save_weights
from gelflow.terminal import progress
from gelflow.training.callback import (
    CheckpointCallback,
    Stopped,
    describe,
    is_first_process,
    peak_memory_mib,
    stopping,
    weights_metadata,
)
from gelflow.training.loading import ResidentPairs, end_with_run, loading_context, resident
from gelflow.training.module import FlowModule, check_side
from gelflow.training.samples import CheckedPairs, StepSampler, TrainingSamples, augmented_batch, checked, collate
from gelflow.training.state import STATE, WEIGHTS, State, load_state, open_run


@dataclass(frozen=True)
class TrainResult:
    """What a run ended with.

    `weights` are the best on the validation pairs, without such pairs the last; `metrics` those of the last validation
    (`gelflow.training.module.METRICS`); `best` the best validation score: endpoint error in px where the flow is known,
    else photometric loss. Speed (of this session, validation left out) is None where unknown.
    """

    weights: Path
    steps: int
    metrics: dict[str, float]
    best: float | None
    pairs_per_second: float | None
    memory_mib: float

    def __str__(self) -> str:
        speed = "" if self.pairs_per_second is None else f"{self.pairs_per_second:.3g} pairs/s"
        memory = f"peak memory {self.memory_mib:.0f} MiB"
        texts = (f"{self.steps} steps", describe(self.metrics), speed, memory, f"{self.weights}")
        return "; ".join(text for text in texts if text)


def train(
    config: TrainConfig,
    train_set: Dataset[Any],
    validation_set: Dataset[Any] | None,
    out: Path,
    *,
    initial: Path | None = None,
    resume: bool = False,
) -> TrainResult:
    """Trains a network on data sets that are open; arguments, results and exceptions else as of `job.train`.

    Data sets are map-style and have a length; samples are dictionaries with `image1` and `image2` (3, H, W) float32 in
    [0, 1], `name`, and where it is known `flow` (2, H, W) float32 in px, NaN where no gel is seen. The architecture of
    the `initial` weights must be `config.model`.
    """
    pairs, validation_pairs = _length(train_set), 0 if validation_set is None else _length(validation_set)
    if pairs == 0 or (validation_set is not None and validation_pairs == 0):
        raise InputError(f"{'training' if pairs == 0 else 'validation'} set: holds no pair")
    device = _device(config)
    model = _initial_network(config, initial)
    checked(train_set[0], supervised=config.exact)
    if validation_set is not None:
        check_side(_one_pair([validation_set[0]]), config)
    if is_first_process():
        data = {
            "pairs": pairs,
            "validation_pairs": validation_pairs,
            "training_pairs_sha256": getattr(train_set, "digest", None),
            "validation_pairs_sha256": getattr(validation_set, "digest", None),
        }
        state = open_run(out, config, data, initial, resume)
    else:
        state = load_state(out) if resume else None
    if state is None:
        state = State(0, model.state_dict(), None, None, {})
    model.load_state_dict(state.model)
    module = FlowModule(config, model, state.step, state.optimiser, state.average)
    callback = CheckpointCallback(module, out, validation_pairs > 0, state.score, state.metrics)
    if module.start < config.steps or state.validation_due:
        _fit(callback, _Data(config, train_set, validation_set, module), device, state.validation_due)
    weights = out / WEIGHTS
    if validation_set is None and is_first_process():
        save_weights(weights, module.evaluated, **weights_metadata(config, config.steps))
    rate = callback.throughput.pairs_per_second
    return TrainResult(weights, config.steps, callback.metrics, callback.score, rate, peak_memory_mib())


def _length(data: Dataset[Any]) -> int:
    return len(data)  # type: ignore[arg-type]  # Dataset itself declares no __len__


def _device(config: TrainConfig) -> str:
    device = chosen_device(config.device)
    if device == "cuda" and config.devices > torch.cuda.device_count():
        raise InputError(f"devices = {config.devices}: this machine has {torch.cuda.device_count()} CUDA devices")
    if config.devices > 1 and (hasattr(sys, "ps1") or not Path(sys.argv[0]).is_file()):
        raise InputError(f"devices = {config.devices}: every device runs your program; it must be a file, not typed or "
                         "piped into Python")  # fmt: skip
    return device


def _initial_network(config: TrainConfig, initial: Path | None) -> GelFlow:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = GelFlow(config.model) if initial is None else load_weights(initial)
        # A fine-tuning may add a denoiser.
        if config.model.denoise and model.denoiser is None:
            model.denoiser = Denoiser()
            model.config = model.config.model_copy(update={"denoise": True})
    if initial is not None:
        # Registration has no weights: a fine-tuning may switch it on or change it.
        model.config = model.config.model_copy(update={"registration": config.model.registration})
        if model.config != config.model:
            theirs, ours = model.config.model_dump(), config.model.model_dump()
            names = [f"{key}: {theirs[key]!r} there, {ours[key]!r} here" for key in ours if theirs[key] != ours[key]]
            raise InputError(f"{initial}: its architecture is not that of the run ({'; '.join(names)})")
    model.image_size = config.image_size
    return model.train()


def _fit(callback: CheckpointCallback, data: "_Data", device: str, validation_due: bool) -> None:
    """Validates first where that is due, then runs the remaining steps."""
    module, config, out = callback.module, callback.module.config, callback.out
    session = f"from_step_{module.start:06d}"
    with ExitStack() as stack:
        stack.enter_context(quiet_logger("lightning.pytorch", r"lightning\..*|torch\.autograd\.graph"))
        trainer = L.Trainer(
            accelerator="gpu" if device == "cuda" else "cpu",
            devices=config.devices,
            num_nodes=config.nodes,
            strategy="ddp" if config.devices * config.nodes > 1 else "auto",
            precision="bf16-mixed" if config.precision == "bf16" else "32-true",
            max_steps=config.steps - module.start,
            max_epochs=-1,
            gradient_clip_val=config.gradient_clip,
            logger=[
                TensorBoardLogger(out / "logs", name="tensorboard", version=session),
                CSVLogger(out / "logs", name="csv", version=session),
            ],
            callbacks=[callback],
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            num_sanity_val_steps=-1 if validation_due else 0,  # all pairs, before the first step
            use_distributed_sampler=False,
            reload_dataloaders_every_n_epochs=1,
        )
        callback.advance = stack.enter_context(progress("training", shown=trainer.is_global_zero))
        stack.enter_context(stopping(callback))
        former = threading.excepthook  # TensorBoard's thread hands its OSError to this one, which tells it
        stack.callback(setattr, threading, "excepthook", former)
        threading.excepthook = lambda args: None if issubclass(args.exc_type, OSError) else former(args)
        try:
            trainer.fit(module, datamodule=data)
        except (Stopped, SIGTERMException):  # Lightning raises the latter for a signal before the first step
            if not trainer.is_global_zero:
                sys.exit()  # message and exit status are the first process's
            raise KeyboardInterrupt(_how_to_go_on(config, out)) from None
        except OSError as error:
            if error.errno is None:  # of a process that loads data
                raise
            told = f"{error.strerror}; {_how_to_go_on(config, out)}"
            raise OSError(error.errno, told, error.filename or str(out)) from error
        except InputError as error:  # of a process that loads data it comes with a traceback in its text
            raise InputError(str(error).rpartition(f"{InputError.__name__}: ")[2].strip()) from error


def _how_to_go_on(config: TrainConfig, out: Path) -> str:
    if not (out / STATE).exists():
        return "stopped; nothing has been saved yet: start again with the same command"
    saved = load_state(out).step
    message = f"stopped; step {saved} of {config.steps} is saved in {out}; go on with the same command and --resume"
    if (weights := out / WEIGHTS).exists():
        message += f", or use the weights so far, {weights}"
    return message


class _Data(L.LightningDataModule):
    """Loaders for the section of the run that begins at the module's present step."""

    def __init__(
        self, config: TrainConfig, train_set: Dataset[Any], validation_set: Dataset[Any] | None, module: FlowModule
    ) -> None:
        super().__init__()
        self.config = config
        self.train_set: CheckedPairs | ResidentPairs = CheckedPairs(train_set, config.exact)
        self.validation_set = validation_set
        self.module = module
        self._loading: dict[str, Any] = {"num_workers": config.workers, "worker_init_fn": end_with_run,
                                         "multiprocessing_context": loading_context(config)}  # fmt: skip
        self._tried_cache = False

    def train_dataloader(self) -> DataLoader[Any]:
        """Batches up to the next validation, or to the end."""
        config, trainer, start = self.config, self.module.trainer, self.module.step
        self._cache()
        stop = config.steps
        if self.validation_set is not None:
            stop = min(stop, (start // config.validate_every + 1) * config.validate_every)
        sampler = StepSampler(len(self.train_set), config, start, stop, trainer.global_rank, trainer.world_size)
        samples = TrainingSamples(self.train_set, config)
        loading = {} if isinstance(self.train_set, ResidentPairs) else self._loading
        return DataLoader(samples, batch_sampler=sampler, collate_fn=partial(augmented_batch, config=config), **loading)

    def _cache(self) -> None:
        """Puts the training pairs on the device, once, where the configuration and the memory allow it."""
        device = self.module.device
        if self._tried_cache or not self.config.cache or device.type != "cuda":
            return
        self._tried_cache = True
        if isinstance(self.train_set, CheckedPairs):
            kept = resident(self.train_set, device, **self._loading)
            if kept is None:
                print("the pairs take more than half of the device's free memory: read anew for every step",
                      file=sys.stderr)  # fmt: skip
            else:
                self.train_set = kept

    def val_dataloader(self) -> Any:
        """Every pair once, alone in its batch, shared among the processes."""
        if self.validation_set is None:
            return []
        trainer = self.module.trainer
        mine = range(trainer.global_rank, _length(self.validation_set), trainer.world_size)
        return DataLoader(self.validation_set, batch_size=1, sampler=mine, collate_fn=_one_pair, **self._loading)


def _one_pair(samples: list[dict[str, Any]]) -> dict[str, Any]:
    return collate([checked(sample) for sample in samples])

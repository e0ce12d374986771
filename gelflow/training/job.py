"""A training run by the names of its data, settings and weights: `train`, of the public interface and commands."""

from collections.abc import Sequence
from pathlib import Path

from gelflow.config.sources import train_config
from gelflow.data import open_all
from gelflow.models.weights import load_weights, weights_file
from gelflow.training import run


def train(
    data: str | Path | Sequence[str | Path],
    out: str | Path,
    config: str | Path = "best",
    set: Sequence[str] = (),
    *,
    validation: str | Path | Sequence[str | Path] = (),
    weights: str | Path | None = None,
    resume: bool = False,
) -> run.TrainResult:
    """Trains a network on image pairs, as `python -m gelflow train` and `finetune` do.

    Args:
        data: Training pairs: what `PairDataset` reads, or a list of such.
        out: Folder of the run, with weights.safetensors, state.ckpt and logs.
        config: Settings: best, real, bare, paper, selfflow or arflow, or the path of a TOML file.
        set: Single settings as "key=value", such as "steps=600" or "loss.lambda_dc=10".
        validation: Pairs to validate on; the weights that are best on them are kept.
        weights: File of weights to start from, or "best" for the shipped ones; default: random weights.
        resume: Go on with the run that `out` holds.

    Returns:
        A record with `weights`, the file, and the last `metrics` and the `best` score on the validation pairs.

    Raises:
        InputError: Settings, data, folder or weights that cannot be used; a loss that is no longer finite.
        KeyboardInterrupt: Ctrl-C or SIGTERM; the state has been saved, the message says how to go on.
        OSError: The disk is full or the folder cannot be written to.
    """
    initial = None if weights is None else weights_file(Path(weights))
    start = {} if initial is None else {"model": load_weights(initial).config.model_dump()}
    settings = train_config(config, set, start)
    apart = settings.frames_apart
    validation_set = open_all(validation, apart) if validation else None
    return run.train(settings, open_all(data, apart), validation_set, Path(out), initial=initial, resume=resume)

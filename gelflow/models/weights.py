"""Weights on disk: safetensors, with the architecture in the file's metadata. Nothing here ever unpickles.

Metadata (all texts): `format` = "gelflow", `version` of gelflow, `model` (the `ModelConfig` as JSON), `image_size`
("null" or "[rows, columns]" to which training images were resized), and whatever else `save_weights` was given.
"""

import json
from importlib.resources import files
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from gelflow import __version__
from gelflow.config import ModelConfig, size_problem
from gelflow.config.validation import validated
from gelflow.errors import InputError
from gelflow.files.atomic import replacing
from gelflow.files.tensors import misfit
from gelflow.models import GelFlow
from gelflow.untrusted import MOST_BYTES, parsed

SHIPPED = "best"
"""Name of the weights that come with the package; `gelflow/weights/README.md` says what they were trained on."""
FORMAT = "gelflow"
RETRAIN = "give a file that `python -m gelflow train` wrote (weights.safetensors)"


def weights_file(given: Path | None) -> Path:
    """The given file of weights; for None, and for "best" where no file is called so, the one in the package."""
    if given is None or (str(given) == SHIPPED and not given.is_file()):
        return Path(str(files("gelflow"))) / "weights" / f"{SHIPPED}.safetensors"
    return given


def save_weights(path: Path, model: GelFlow, **metadata: str) -> None:
    """Writes a network's weights, and further texts with them, as a whole or not at all."""
    texts = metadata | {
        "format": FORMAT,
        "version": __version__,
        "model": model.config.model_dump_json(),
        "image_size": json.dumps(model.image_size),
    }
    tensors = {name: value.detach().contiguous().cpu() for name, value in model.state_dict().items()}
    data = save(tensors, texts)
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def read_metadata(path: Path) -> dict[str, str]:
    """The texts that `save_weights` kept with the weights; exceptions as for `load_weights`."""
    return _read(path)[0]


def load_weights(path: Path, device: str = "cpu") -> GelFlow:
    """Builds the network that a file describes, with the file's weights, in evaluation mode.

    InputError for no such file, not a safetensors file, a damaged one, or weights of another model.
    """
    metadata, tensors = _read(path)
    try:
        values = parsed(json.loads, metadata["model"], "model")
        size = parsed(json.loads, metadata.get("image_size", "null"), "image_size")
    except (KeyError, InputError) as error:
        raise InputError(f"{path}: its metadata do not describe a network ({error!r}); {RETRAIN}") from error
    if not isinstance(values, dict):
        raise InputError(f"{path}: its metadata do not describe a network (given: {values!r}); {RETRAIN}")
    if not (size is None or (isinstance(size, list) and [type(side) for side in size] == [int, int])):
        raise InputError(f"{path}: image_size in its metadata must be null or [rows, columns], not {size!r}; {RETRAIN}")
    if size is not None and (problem := size_problem(size[0], size[1])):
        raise InputError(f"{path}: image_size in its metadata: {problem}; {RETRAIN}")
    model = GelFlow(validated(ModelConfig, values, f"{path}, architecture in its metadata"))
    if problem := misfit(tensors, model):
        raise InputError(f"{path}: its weights do not fit its architecture: {problem}; {RETRAIN}")
    model.load_state_dict(tensors)
    model.image_size = None if size is None else (size[0], size[1])
    return model.to(device).eval()


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; {RETRAIN}")
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path}: has more than {MOST_BYTES} bytes; {RETRAIN}")
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"{path}: not a whole safetensors file ({error}); pickled files (.pt, .pth, .ckpt) are not opened, because "
            f"that can run code; {RETRAIN}"
        ) from error
    if metadata.get("format") != FORMAT:
        raise InputError(f"{path}: a safetensors file, but not weights of GelFlow (its metadata lack it); {RETRAIN}")
    return metadata, tensors

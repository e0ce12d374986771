"""RAFT's published weights: state dictionaries of princeton-vl/RAFT (BSD-3-Clause), loaded without running code.

Mapping of names, file to `gelflow.models.raft.RAFT`:

    module.X                         X       (the published files were saved from a data-parallel wrapper)
    *.layerN.M.norm3.* (large)       dropped: the same tensors again as *.layerN.M.downsample.1.*
    *.layerN.M.norm4.* (small)       dropped likewise
    everything else                  the same name

Which of the two networks a file is of is read from the shapes: 128 feature channels (small) or 256 (large).
"""

import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from gelflow.errors import InputError
from gelflow.files.tensors import Unreadable, load_tensors, misfit
from gelflow.models.raft.network import RAFT


def looks_like_raft(path: Path) -> bool:
    """Whether a file of weights is, by its name, one of RAFT's and not of gelflow's own (.safetensors)."""
    return path.suffix.lower() in (".pth", ".pt")


def load_raft(path: Path, device: str = "cpu") -> RAFT:
    """Builds the network that a file's shapes describe, with the file's weights, in evaluation mode.

    InputError for no such file, a damaged one, one that would run code, or not RAFT's weights.
    """
    tensors = renamed(_read(path), path)
    last = tensors.get("fnet.conv2.weight")
    if last is None or last.shape[0] not in (128, 256):
        raise InputError(
            f"{path}: not weights of RAFT small or large (fnet.conv2.weight is missing or of another "
            "size); give a state dictionary of princeton-vl/RAFT"
        )
    model = RAFT(large=last.shape[0] == 256)
    if problem := misfit(tensors, model):
        raise InputError(f"{path}: does not fit RAFT {'large' if model.large else 'small'}: {problem}")
    model.load_state_dict(tensors)
    return model.to(device).eval()


def renamed(tensors: Mapping[str, Tensor], path: Path) -> dict[str, Tensor]:
    """The tensors under this package's names; InputError where one that is stored twice differs from its copy."""
    plain = {name.removeprefix("module."): value for name, value in tensors.items()}
    own = {}
    for name, value in plain.items():
        match = re.fullmatch(r"(.*layer\d\.\d)\.norm[34]\.(\w+)", name)
        copy = f"{match[1]}.downsample.1.{match[2]}" if match else ""
        if copy not in plain:
            own[name] = value
        elif not torch.equal(value, plain[copy]):
            raise InputError(f"{path}: {name} and {copy} must be one tensor, but differ")
    return own


def _read(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise InputError(f"{path}: there is no such file")
    try:
        values = load_tensors(path)
    except Unreadable as error:
        raise InputError(
            f"{path}: not a readable file of tensors (truncated, damaged, or holding objects that could run code): "
            f"{error}"
        ) from error
    if not isinstance(values, Mapping) or not all(isinstance(value, Tensor) for value in values.values()):
        raise InputError(f"{path}: holds something other than a dictionary of tensors")
    return dict(values)

"""Tensors from files: what `torch.save` wrote, read without running code in it, and whether tensors fit a network."""

import os
import struct
import warnings
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import BadZipFile, ZipFile, is_zipfile

import torch
from torch import Tensor, nn

from gelflow.untrusted import MOST_BYTES, open_file

DAMAGE = (
    UnpicklingError, RuntimeError, EOFError, LookupError, TypeError, ValueError, AttributeError, AssertionError,
    ArithmeticError, OSError, MemoryError, struct.error, BadZipFile,
)  # fmt: skip
"""Exceptions of torch's restricted reader at bytes that are no tensors; it interprets them as far as it can."""


class Unreadable(Exception):
    """The file is truncated, damaged, or holds objects that could run code; the text says which as far as is known."""


def load_tensors(path: Path) -> Any:
    """Tensors and plain values, on the CPU; FileNotFoundError where there is no file, Unreadable for anything else."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # notes on the pickle protocol of files that are refused anyway
            with open_file(path) as file:
                size = os.fstat(file.fileno()).st_size
                if is_zipfile(file):
                    size = sum(member.file_size for member in ZipFile(file).infolist())
            if size > MOST_BYTES:
                raise Unreadable(f"it unpacks to {size} bytes; at most {MOST_BYTES} are read")
            return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        lines = str(error).splitlines()
        raise Unreadable(lines[0] if lines else type(error).__name__) from error


def misfit(tensors: Mapping[str, Tensor], model: nn.Module) -> str:
    """What keeps tensors from being a network's weights, three problems at most; an empty text where they fit."""
    expected = model.state_dict()
    wrong = [f"{name} is missing" for name in expected if name not in tensors]
    wrong += [f"{name} is unknown" for name in tensors if name not in expected]
    for name, value in tensors.items():
        if name in expected and value.shape != expected[name].shape:
            wrong.append(f"{name} has shape {tuple(value.shape)}, not {tuple(expected[name].shape)}")
        elif value.is_floating_point() and not value.isfinite().all():
            wrong.append(f"{name} holds values that are not finite")
    more = f" and {len(wrong) - 3} more" if len(wrong) > 3 else ""
    return "; ".join(wrong[:3]) + more

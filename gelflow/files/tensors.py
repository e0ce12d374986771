"""Files that `torch.save` wrote, read without ever running code in them."""

import struct
import warnings
from pathlib import Path
from pickle import UnpicklingError
from typing import Any
from zipfile import BadZipFile

DAMAGE = (
    UnpicklingError, RuntimeError, EOFError, LookupError, TypeError, ValueError, AttributeError, AssertionError,
    ArithmeticError, OSError, struct.error, BadZipFile,
)  # fmt: skip
"""What torch's restricted reader raises at bytes that are something else: it interprets them until it stumbles."""


class Unreadable(Exception):
    """The file is truncated, damaged, or holds objects that could run code; the text says which as far as is known."""


def load_tensors(path: Path) -> Any:
    """Tensors and plain values, on the CPU.

    Raises:
        FileNotFoundError: There is no such file.
        Unreadable: It holds anything else.
    """
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # notes on the pickle protocol of files that are refused anyway
            return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        lines = str(error).splitlines()
        raise Unreadable(lines[0] if lines else type(error).__name__) from error

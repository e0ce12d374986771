"""NumPy .npz archives: equal arrays give equal bytes, since NumPy dates every member by the zip format's zero."""

import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.errors import InputError


def encode_npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]  # `allow_pickle` is no array
    return buffer.getvalue()


def read_npz(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """The arrays of these names; InputError where the file is missing, no .npz or damaged, or lacks a name."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            present = list(archive.files)
            missing = [name for name in names if name not in present]
            if missing:
                raise InputError(f"{path}: lacks the array {' and '.join(missing)}; it has {', '.join(present)}")
            return {name: archive[name] for name in names}
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file") from error
    except (OSError, ValueError, TypeError, AttributeError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a readable .npz archive ({error}); truncated or damaged") from error

"""NumPy .npz archives: equal arrays give equal bytes, since NumPy dates every member by the zip format's zero."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.errors import InputError
from synth.untrusted import open_file

MOST_BYTES = 2**28
"""Of all arrays together; those of the finest meshes have a tenth."""


def encode_npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]  # `allow_pickle` is no array
    return buffer.getvalue()


def read_npz(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """The arrays of these names; InputError where the file is missing, no .npz or damaged, or lacks a name."""
    try:
        with open_file(path) as file, np.load(file, allow_pickle=False) as archive:
            if sum(member.file_size for member in archive.zip.infolist()) > MOST_BYTES:
                raise ValueError(f"it unpacks to more than {MOST_BYTES} bytes, the most that is read")
            present = list(archive.files)
            missing = [name for name in names if name not in present]
            if missing:
                raise InputError(f"{path}: lacks the array {' and '.join(missing)}; it has {', '.join(present)}")
            return {name: archive[name] for name in names}
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file") from error
    except Exception as error:  # of whatever kind a damaged archive causes
        raise InputError(f"{path}: not a readable .npz archive ({error}); truncated or damaged") from error

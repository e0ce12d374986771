"""NumPy .npz archives that are the same bytes for the same arrays (fixed dates and order), read by `numpy.load`."""

import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.errors import InputError

_DATE = (1980, 1, 1, 0, 0, 0)
"""The zip format's zero."""


def encode_npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Compressed .npz file of arrays by name."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy", date_time=_DATE)
            info.create_system = 3
            info.external_attr = 0o644 << 16
            archive.writestr(info, member.getvalue(), compress_type=zipfile.ZIP_DEFLATED, compresslevel=6)
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

"""The meshes that a dataset holds: in DIR/meshes, or under a URL, from where each process fetches them once."""

import tempfile
from functools import cache
from pathlib import Path

from synth.dataset.store import Output, Store

MESHES_FOLDER = "meshes"


def mesh_folder(out: Output) -> Path:
    """A folder of this machine that holds the dataset's meshes; InputError where the storage refuses."""
    store = Store(out)
    if store.directory is not None:
        return store.directory / MESHES_FOLDER
    folder = Path(_temporary_folder(str(store.out)).name)
    for name in store.names(MESHES_FOLDER):
        if not (folder / name).exists():
            store.get(f"{MESHES_FOLDER}/{name}", folder / name)
    return folder


@cache
def _temporary_folder(url: str) -> "tempfile.TemporaryDirectory[str]":
    """One per process and URL, removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="synth-meshes-")

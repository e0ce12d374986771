"""Physically based image pairs, with exact optical flow, of vision-based tactile sensors.

`load_scene`, `plan`, `generate` and `read_dataset` are loaded when they are first asked for: the import stays light.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

try:
    __version__ = version("gelflow-synth")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "unknown"

_PUBLIC = {
    "load_scene": "synth.scene.template",
    "plan": "synth.planning",
    "generate": "synth.pipeline.generate",
    "read_dataset": "synth.dataset.reader",
}


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)

"""Physically based image pairs, with exact optical flow, of vision-based tactile sensors.

The public interface is `load_scene`, `plan`, `generate` and `read_dataset`; everything else may change without notice.
Importing the package imports nothing heavy: each of the four is loaded when it is first asked for.

Examples:
    >>> import tempfile, synth
    >>> scene = synth.load_scene("gelsight_mini", set=["numerics.target_error_px=2.5", "render.samples_per_pixel=4"])
    >>> out = tempfile.mkdtemp()
    >>> summary = synth.generate(scene, n=1, out=out, seed=0)
    >>> for sample in synth.read_dataset(out):
    ...     print(sample.images[0].shape, sample.forward.shape, sample.backward.shape, sample.visible.shape)
    (240, 320, 3) (240, 320, 2) (240, 320, 2) (240, 320)
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from synth.dataset.reader import read_dataset
    from synth.pipeline.generate import generate
    from synth.planning import plan
    from synth.scene.template import load_scene

__all__ = ["generate", "load_scene", "plan", "read_dataset"]

try:
    __version__ = version("gelflow-synth")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "unknown"

_MODULES = {
    "load_scene": "synth.scene.template",
    "plan": "synth.planning",
    "generate": "synth.pipeline.generate",
    "read_dataset": "synth.dataset.reader",
}


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)

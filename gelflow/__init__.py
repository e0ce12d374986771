"""GelFlow: learned optical flow for vision-based tactile sensors.

The network of Zhang, Yang and Yin, "GelFlow: Self-supervised Learning of Optical Flow for Vision-Based Tactile Sensor
Displacement Measurement", its losses and its trainer. Inside the network images are (B, 3, H, W) float32 in [0, 1];
flow is (B, 2, H, W) float32 in px, U to the right, V downward, and points from image 1 to image 2:
``I1(x) = I2(x + V(x))``. The centre of the pixel in column c and row r is at (c + 0.5, r + 0.5).

The public interface is `load_model`, `PairDataset`, `Tracker` and `train`; everything else may change without notice.
Importing the package imports nothing heavy: each of the four is loaded when it is first asked for.
"""

from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gelflow.data.pairs import PairDataset
    from gelflow.predict.model import load_model
    from gelflow.track.tracker import Tracker
    from gelflow.training.job import train

__all__ = ["PairDataset", "Tracker", "load_model", "train"]

try:
    __version__ = version("gelflow-synth")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "unknown"

_MODULES = {
    "PairDataset": "gelflow.data.pairs",
    "Tracker": "gelflow.track.tracker",
    "load_model": "gelflow.predict.model",
    "train": "gelflow.training.job",
}


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)

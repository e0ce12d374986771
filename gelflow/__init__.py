"""GelFlow: learned optical flow for vision-based tactile sensors.

The network of Zhang, Yang and Yin, "GelFlow: Self-supervised Learning of Optical Flow for Vision-Based Tactile Sensor
Displacement Measurement", its losses and its trainer. Images are (B, 3, H, W) float32 in [0, 1]; flow is
(B, 2, H, W) float32 in px, U to the right, V downward, and points from image 1 to image 2: ``I1(x) = I2(x + V(x))``.
The centre of the pixel in column c and row r is at (c + 0.5, r + 0.5).

Importing this package imports nothing heavy; import the module that you need.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("gelflow-synth")
except PackageNotFoundError:  # a checkout that is not installed
    __version__ = "unknown"

"""Physically based image pairs, with exact optical flow, of vision-based tactile sensors."""

__version__ = "0.1.0"

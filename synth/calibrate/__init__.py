"""Calibration: a preset fitted to frames of a user's own sensor."""

from synth.calibrate.run import run_calibrate

__all__ = ["run_calibrate"]

"""Whether a calibration is good, and what its frames cannot tell.

A gel at rest shows its coating, smoothly lit, and marks on an even grid. A contact shows as a place that no light
explains, or as marks that are off the grid together with their neighbours; marks that were printed unevenly are off it
each for itself. A stretch that is the same all over, and a contact fainter than these limits, stay hidden.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.arrays import Pixels
from synth.calibrate.ball_fit import BallFit
from synth.calibrate.comparison import Comparison
from synth.calibrate.dot_grid import DotGridFit
from synth.scene import Dots, Sensor

CHANNELS = ("red", "green", "blue")
ALLOWED_LEVELS = 4.0
"""Most mean absolute difference outside the dots, per channel, of 255."""
ALLOWED_PLACE = 15.0
"""Most difference of a place, of 255: pressed gels exceed it, gels at rest do not."""
ALLOWED_OFF_GRID = 0.015
"""Most common displacement of neighbouring dots, over their pitch: pressed gels exceed it."""

ALLOWED_TURN, ALLOWED_RISE = 15.0, 0.2
"""Most difference of the azimuth on a ball's contact, degrees, and of the rise there, relative."""


@dataclass(frozen=True)
class Verdict:
    """What `synth calibrate` ends with: a fit is good where no reason speaks against it.

    Residuals are the largest mean absolute difference of all frames outside the dots, by channel, of 255. `cannot_tell`
    is what such frames leave to the preset.
    """

    good: bool
    residual_levels: dict[str, float]
    allowed_levels: float
    reasons: tuple[str, ...]
    cannot_tell: tuple[str, ...]

    def lines(self) -> list[str]:
        levels = " ".join(f"{value:.2f}" for value in self.residual_levels.values())
        head = f"verdict: {'good' if self.good else 'NOT good'}; residual {levels} of 255 (red green blue)"
        head += f", at most {self.allowed_levels:g} is good"
        notes = [f"the frames cannot tell {note}" for note in self.cannot_tell]
        return [head, *(f"- {reason}" for reason in self.reasons), *notes]


def verdict(
    rows: dict[str, Comparison],
    grids: dict[str, DotGridFit | None],
    sensor: Sensor,
    spacing_is_known: bool,
    pressed: BallFit | None = None,
) -> Verdict:
    """Judge a fit by comparisons, and grids of dots if there are any, of the fitted frames and of others, by name.

    Presses are judged by the azimuth and the rise of each channel, where it rises by more than ALLOWED_LEVELS.
    """
    residuals = {name: row.numbers()["mean_absolute_outside_dots"] for name, row in rows.items()}
    reasons = []
    for name, residual in residuals.items():
        bad = [f"{channel} {value:.1f}" for channel, value in zip(CHANNELS, residual, strict=True)
               if not value <= ALLOWED_LEVELS]  # fmt: skip
        if bad:
            reasons.append(
                f"{name}: off by {', '.join(bad)} levels: the preset's lights do not explain it; a frame of another "
                "sensor does not tell this one's lights"
            )
        level, (x, y) = rows[name].worst_place()
        if level > ALLOWED_PLACE:
            reasons.append(
                f"{name}: off by {level:.0f} levels around pixel ({x}, {y}): a contact, a reflection or dirt; a "
                "pressed frame does not tell the lights"
            )
        grid = grids[name]
        shared = 0.0 if grid is None else common_displacement(grid.index, grid.residual_px) / grid.pitch_px
        if shared > ALLOWED_OFF_GRID:
            reasons.append(
                f"{name}: neighbouring dots are off the grid by {100 * shared:.1f} % of their pitch (at most "
                f"{100 * ALLOWED_OFF_GRID:g}): pressed or stretched; such a frame does not tell pitch or lens"
            )
    for press, fitted in zip(pressed.presses, pressed.fitted, strict=True) if pressed else ():
        (azimuth, rise), (own_azimuth, own_rise) = map(press.azimuth_and_rise, (press.changed, fitted))
        turned = np.abs((own_azimuth - azimuth + 180) % 360 - 180)
        for k, channel in enumerate(CHANNELS):
            agrees = turned[k] <= ALLOWED_TURN and abs(own_rise[k] - rise[k]) <= ALLOWED_RISE * rise[k]
            if rise[k] > ALLOWED_LEVELS and not agrees:
                reasons.append(
                    f"{press.name}: {channel} light comes from {own_azimuth[k]:.0f} degrees and rises "
                    f"{own_rise[k]:.0f} levels on the ball, in the frame from {azimuth[k]:.0f} and {rise[k]:.0f}"
                )
    worst = np.max(list(residuals.values()), axis=0)
    return Verdict(
        good=not reasons,
        residual_levels=dict(zip(CHANNELS, map(float, worst), strict=True)),
        allowed_levels=ALLOWED_LEVELS,
        reasons=tuple(reasons),
        cannot_tell=_cannot_tell(sensor, spacing_is_known),
    )


def _cannot_tell(sensor: Sensor, spacing_is_known: bool) -> tuple[str, ...]:
    if not isinstance(sensor.pattern, Dots):
        return ("a bare gel's scale, lens and blur, nor whether it is stretched: these are the preset's",)
    scale = () if spacing_is_known else ("the scale: the field of view is the preset's (see --spacing-mm)",)
    return (*scale, "whether the gel is stretched evenly")


def common_displacement(index: NDArray[np.int64], residual: Pixels) -> float:
    """Root mean square of what neighbours share of their displacement off the grid, px; see `DotGridFit`."""
    near = np.abs(index[:, None] - index[None]).sum(axis=2) <= 1  # a dot itself, and the next ones along row and column
    shared = near @ residual / near.sum(axis=1, keepdims=True)
    return float(np.sqrt((shared**2).sum(axis=1).mean()))

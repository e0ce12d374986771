"""Starts of the lights' fit that do not depend on where the preset's lights are.

Lights of the preset's size and viewing angle are tried all around the gel, at several heights and tilts. What each of
them adds is known, so that few are chosen one by one for what they explain, and then each once more given the others.
Lights that are fitted may start this, so that one that stands at a wrong place is replaced and the others stay.
"""

import dataclasses
from itertools import product

import numpy as np
from scipy.optimize import nnls

from synth.arrays import BoolArray, FloatArray
from synth.calibrate.irradiance import LightGeometry
from synth.calibrate.lights import WIDEST_DEG, Gels, Room, Target, contributions

_AZIMUTHS, _HEIGHTS = 24, (0.15, 0.35, 0.6, 0.85)
"""Lights around the gel, and their heights over the body's."""
_TILTS = (-45.0, -20.0, 0.0, 15.0)
"""Elevations (degrees) of where narrow ones aim. Wide ones aim as high as the preset's: that hardly shows in what they
light, and scales their power."""
_BESIDE_MM, _APART_MM = 1.0, 2.0
"""How far lights are outside the view, and from each other."""
_TRIED, _ROUNDS, _CHUNK = 30, 2, 32


def around(like: LightGeometry, room: Room) -> LightGeometry:
    """Lights around the gel, of the median size and viewing angle of others, no part of which is in the view."""
    size, wide = np.median(like.size, axis=0), np.median(like.viewing_angle_deg, axis=0)
    aimed = np.degrees(np.arctan2(like.direction[:, 2], np.hypot(*like.direction[:, :2].T)))
    tilts = (float(np.median(aimed)),) if wide[0] >= WIDEST_DEG else _TILTS
    top, angles = room.high[:, 2].max(), np.radians(np.arange(_AZIMUTHS) * 360 / _AZIMUTHS)
    centres, directions = [], []
    for angle, height, tilt in product(angles, _HEIGHTS, np.radians(tilts)):
        outward = np.array([np.cos(angle), np.sin(angle)])
        z = height * top
        low, high = room.view + z * room.slope
        half = np.maximum(-low, high) + _BESIDE_MM
        centres.append([*(outward * np.min(half / np.maximum(np.abs(outward), 1e-9))), z])
        directions.append([*(-outward * np.cos(tilt)), np.sin(tilt)])
    count = len(centres)
    fields = np.array(centres), np.array(directions), np.tile(size, (count, 1)), np.tile(wide, (count, 1))
    outside = room.intrusion(LightGeometry(*fields)).max(axis=1) == 0
    return LightGeometry(*(field[outside] for field in fields))


def chosen(
    gels: Gels, target: Target, like: LightGeometry, shines: BoolArray, vignetting: float, room: Room, fitted: bool
) -> LightGeometry:
    """For each of some lights, which shine in channels (m, 3), one of those around; if `fitted`, it may be itself."""
    other = around(like, room)
    fields = [np.concatenate([getattr(part, f.name) for part in (like, other)]) for f in dataclasses.fields(like)]
    centre = fields[0]
    parts = [LightGeometry(*(field[k : k + _CHUNK] for field in fields)) for k in range(0, len(centre), _CHUNK)]
    lit = np.concatenate([contributions(gels, part, alone=True) for part in parts])
    lit = lit * (target.gain * (1 - vignetting * target.corner))[None, :, None] * target.slope
    wanted = target.signal * target.slope
    norm = np.maximum(np.linalg.norm(lit, axis=1), 1e-12)
    strong = norm > 0.01 * norm.max(axis=0)  # beyond, a light that hardly reaches the gel needs any power

    def missed(picks: dict[int, int]) -> FloatArray:
        """Misfit (n, 3) under the best powers."""
        left = wanted.copy()
        for channel in range(3):
            use = [pick for light, pick in picks.items() if shines[light, channel]]
            if use:
                columns = lit[use, :, channel].T / norm[use, channel]
                left[:, channel] -= columns @ nnls(columns, wanted[:, channel], maxiter=1000)[0]
        return left

    def exchanged(light: int, picks: dict[int, int]) -> tuple[float, int]:
        """The least misfit that another pick for the light, or its own, leaves beside the others, and that pick."""
        others = {other: pick for other, pick in picks.items() if other != light}
        away = np.arange(len(centre)) >= len(shines)
        for pick in others.values():
            away &= np.linalg.norm(centre - centre[pick], axis=1) > _APART_MM
        left = missed(others)
        gain = np.einsum("mpc,pc->mc", lit, left) / norm
        gain = (np.maximum(gain, 0) ** 2 * strong)[:, shines[light]].sum(axis=1) * away
        tried = [*np.argsort(-gain)[:_TRIED].tolist(), *([picks[light]] if light in picks else [])]
        return min((float(np.sum(missed({**others, light: pick}) ** 2)), pick) for pick in tried)

    lights = range(len(shines))
    picks = {light: light for light in lights if fitted}
    # One after another; of fitted ones whichever helps most, as one at a wrong place misleads the others.
    for turn in _ROUNDS * ([lights] if fitted else [[light] for light in lights]):
        _, pick, light = min((*exchanged(each, picks), each) for each in turn)
        picks[light] = pick
    order = [picks[light] for light in lights]
    return LightGeometry(*(field[order] for field in fields))

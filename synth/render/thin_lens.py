r"""The thin lens of a camera with an aperture: which points of its pupil a pixel looks from, and where they meet.

The pupil is a disc of radius a around the camera's position, at right angles to the viewing axis. In air every ray of
a pixel meets the pinhole's ray in the plane of focus at the distance s' along the axis. A ray from the pupil point
(u, v) therefore has the tangents

.. math::  (x, y) - (u, v) / s'

where (x, y) are the pinhole's, after distortion has been undone: distortion displaces the picture and does not blur it.
A point at the distance z is blurred to a uniform disc of the diameter 2 a f |1/s' - 1/z|, around where the pinhole sees
it. Mirrors and the window act on each ray by itself.

The window shortens distances behind it. Of the focus distance s = e + b, e runs in air along the axis up to the window
and b in the body. With the axis at the angles θ in air and θ' in the body, Coddington's equations for a flat face put
what is sharp, as seen from the air, at

.. math::  s'_s = e + b / n, \qquad s'_t = e + \frac{b \cos^2 θ}{n \cos^2 θ'}

across and in the plane of incidence. The lens takes the mean of their inverses, which makes the root-mean-square blur
of that point least; both are e + b / n where the axis is at right angles to the window. (W. T. Welford, Aberrations of
Optical Systems, 1986.)

The radiance of a pixel is the plain mean over the pupil; LEDs block no ray. Light falls off by `vignetting`.
"""

from dataclasses import dataclass

import numpy as np

from synth.errors import InputError
from synth.optics import Optics
from synth.render.lights import check_view, image_lights, reaches
from synth.scene import Sensor


@dataclass(frozen=True)
class ThinLens:
    """The radius of a pupil, and s', from it to the plane of focus, as if everything were air; both in mm."""

    radius_mm: float
    distance_mm: float

    @staticmethod
    def of(sensor: Sensor) -> "ThinLens | None":
        """The thin lens of a sensor's main camera; None for a pinhole.

        InputError where the viewing axis does not reach the window, so that nothing on it could be in focus.
        """
        camera = sensor.camera
        if not camera.aperture_mm or camera.focus_mm is None:
            return None
        optics = Optics.of(sensor)
        axis = optics.look(np.array([[camera.cx, camera.cy]]))
        if axis.path[0] < 0:
            raise InputError(
                f"sensor.camera.focus_mm = {camera.focus_mm} is measured along the viewing axis, which does not reach "
                "the window: turn the camera by look_at_mm, or leave out aperture_mm for a pinhole"
            )
        radius = camera.aperture_mm / 2
        eye = optics.poses[axis.path[0]].position
        below = -float(axis.directions[0, 2])  # cos of the angle in the body
        # At index 1 rays start at the eye: there is no face, and all the distance is in air.
        before = float(np.linalg.norm(axis.origins[0] - eye)) if optics.window.index != 1 else np.inf
        within = camera.focus_mm - before
        if within <= 0:
            return ThinLens(radius, camera.focus_mm)
        n = optics.window.index
        above = float(np.sqrt(1 - n**2 * (1 - below**2)))  # Snell
        sagittal = before + within / n
        tangential = before + within / n * (above / below) ** 2
        return ThinLens(radius, 2 / (1 / sagittal + 1 / tangential))


def check_views(sensor: Sensor) -> None:
    """Refuse, by InputError, lights that all shine past the gel or stand in a camera's view, and unfocused lenses."""
    if not any(reaches(light, sensor.gel.size_mm) for light in (*sensor.lights, *image_lights(sensor))):
        raise InputError("sensor.lights: no light with power shines toward the gel: check power and aim_mm")
    for name, view in sensor.views.items():
        try:
            check_view(view)
            ThinLens.of(view)
        except InputError as error:
            raise InputError(f"sensor.further_cameras {name!r}: {error}" if name else str(error)) from error

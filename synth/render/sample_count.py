r"""How many samples a pixel needs so that nobody sees the renderer's noise behind the camera's own.

Two pilot pictures with different seeds differ by √2 times the renderer's noise, after the lens's blur and in encoded
values, as they are seen. The camera's own noise there is that of v(s + e), with v the response and e Gaussian of the
variance read² + shot² s, by quadrature, because in the dark the response is no straight line over e; and step² / 12.

Stratified sampling's noise falls at least as 1 / √samples, so the least number whose noise is below SHARE of the
camera's follows from one pilot, on the safe side. Fewer than the pilot's are never chosen: there noise grows faster.
"""

import math

import numpy as np

from synth.arrays import FloatArray, Image
from synth.render.camera_image import expected_signal, noise_deviation
from synth.scene import Camera

SHARE = 0.25
"""Of the camera's noise that the renderer's may have; both together are then 3 % more than the camera's alone."""
PILOT = 16
"""Samples a pixel of the pilots."""
MOST = 4096
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(15)


def needed_samples(first: Image, second: Image, camera: Camera, samples: int) -> int:
    """Samples per pixel for a camera, from radiances (H, W, 3) of two pilots of `samples` each with different seeds."""
    noise, own = render_noise(first, second, camera), camera_noise(first, camera)
    wanted = samples * (noise / (SHARE * own)) ** 2 if own > 0 else float(MOST)
    return int(np.clip(math.ceil(wanted), samples, MOST))


def render_noise(first: Image, second: Image, camera: Camera) -> float:
    """Root mean square of the renderer's noise in one picture, encoded, full scale 1."""
    values = [encoded(expected_signal(image, camera), camera) for image in (first, second)]
    return float(np.sqrt(np.mean((values[0] - values[1]) ** 2) / 2))


def camera_noise(radiance: Image, camera: Camera) -> float:
    """Root mean square of the camera's own noise, quantisation included, encoded, full scale 1."""
    signal = np.clip(expected_signal(radiance, camera), 0, 1)
    deviation = noise_deviation(signal, camera)
    mean, square = np.zeros_like(signal), np.zeros_like(signal)
    for node, weight in zip(_NODES, _WEIGHTS / _WEIGHTS.sum(), strict=True):
        value = encoded(signal + node * deviation, camera)
        mean += weight * value
        square += weight * value**2
    step = 1 / (2**camera.bit_depth - 1)
    return float(np.sqrt(np.maximum(square - mean**2, 0.0).mean() + step**2 / 12))


def encoded(signal: FloatArray, camera: Camera) -> FloatArray:
    """What a linear signal is in the image, without noise and quantisation."""
    return np.asarray(np.clip(signal, 0, 1) ** (1 / camera.gamma))

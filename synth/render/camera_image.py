"""What the camera's sensor makes of the radiance that reaches it.

Per channel, with full scale 1 and all steps but the last two linear:

    signal = exposure · vignette · rest map · (radiance * Gaussian point spread)
    noisy  = signal + N(0, read_noise² + shot_noise² · signal)          (EMVA 1288, photon-transfer model)
    value  = quantise(clip(noisy, 0, 1) ** (1 / gamma))

The radiance of a wide-angle lens falls off towards the corners; the vignette 1 - v ρ² (ρ = 1 at the image's farthest
corner from the principal point) stands for natural and mechanical vignetting together. For rest maps see there.

A pixel has enough samples when nobody sees the renderer's noise behind the camera's own. Two pilot pictures with
different seeds differ by √2 times the renderer's noise, after the lens's blur and in encoded values, as they are seen.
The camera's own noise there is that of v(s + e), with v the response and e Gaussian of the variance read² + shot² s, by
quadrature, because in the dark the response is no straight line over e; and step² / 12.

Stratified sampling's noise falls at least as 1 / √samples, so the least number whose noise is below SHARE of the
camera's follows from one pilot, on the safe side. Fewer than the pilot's are never chosen: there noise grows faster.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.arrays import FloatArray, Image
from synth.scene import Camera


def noise_deviation(signal: FloatArray, camera: Camera) -> FloatArray:
    """Standard deviation of the camera's noise at linear signals of full scale 1; same shape."""
    return np.asarray(np.sqrt(camera.read_noise**2 + camera.shot_noise**2 * signal))


def camera_image(
    radiance: Image, camera: Camera, rng: np.random.Generator, rest_map: FloatArray | float = 1.0
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """The image as it is read from the camera: (H, W, 3) uint8 for 8 bits, for 10 to 16 bits uint16.

    That is stretched to the full 16-bit range (a 10-bit value q is stored as round(q · 65535 / 1023)), as readers of
    16-bit PNGs expect; the steps between values stay 10-bit. The radiance (H, W, 3) float32 is linear, and exposure 1
    maps 1 to full scale. `rng` gives the noise; two images need two states of it. `rest_map`: (H, W, 3 or 1), or 1.
    """
    signal = expected_signal(radiance, camera, rest_map)
    noisy = signal + noise_deviation(signal, camera) * rng.standard_normal(signal.shape)
    levels = 2**camera.bit_depth - 1
    quantised = np.floor(encoded(noisy, camera) * levels + 0.5)
    if camera.bit_depth == 8:
        return quantised.astype(np.uint8)
    return np.floor(quantised * (65535 / levels) + 0.5).astype(np.uint16)


def expected_signal(radiance: Image, camera: Camera, rest_map: FloatArray | float = 1.0) -> FloatArray:
    """The noiseless linear signal (H, W, 3) float64, full scale 1, not clipped: blurred, vignetted, mapped, exposed."""
    signal = radiance.astype(np.float64)
    if camera.blur_px > 0:
        import cv2

        radius = max(1, math.ceil(4 * camera.blur_px))  # the tail beyond 4 sigma holds 6e-5 of a Gaussian's weight
        size = (2 * radius + 1, 2 * radius + 1)
        blurred = cv2.GaussianBlur(signal, size, camera.blur_px, borderType=cv2.BORDER_REPLICATE)
        signal = blurred.reshape(signal.shape)  # OpenCV drops the axis of a single channel
    if camera.vignetting > 0:
        signal = signal * vignette(camera)[:, :, None]
    return camera.exposure * signal * rest_map


def vignette(camera: Camera) -> FloatArray:
    """Relative illumination (H, W) float64 at pixel centres: 1 at (cx, cy), 1 - vignetting at the farthest corner."""
    x, y = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    return 1 - camera.vignetting * off_centre(camera, x[None, :], y[:, None])


def off_centre(camera: Camera, x: NDArray[Any], y: NDArray[Any]) -> FloatArray:
    """ρ² of places (x, y) px: squared distance from the principal point over that of the farthest corner."""
    corner = max(abs(camera.cx), abs(camera.width - camera.cx)) ** 2
    corner += max(abs(camera.cy), abs(camera.height - camera.cy)) ** 2
    return np.asarray(((x - camera.cx) ** 2 + (y - camera.cy) ** 2) / corner)


SHARE = 0.25
"""Share of the camera's noise that the renderer's may have; both together are then 3 % more than the camera's alone."""
PILOT = 16
"""Samples a pixel of the pilots."""
MOST = 4096
"""Most samples a pixel that are chosen."""
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

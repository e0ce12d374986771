"""What the camera's sensor makes of the radiance that reaches it.

Per channel, with full scale 1 and all steps but the last two linear:

    signal = exposure · vignette · (radiance * Gaussian point spread)
    noisy  = signal + N(0, read_noise² + shot_noise² · signal)          (EMVA 1288, photon-transfer model)
    value  = quantise(clip(noisy, 0, 1) ** (1 / gamma))

The radiance of a wide-angle lens falls off towards the corners; the vignette 1 - v ρ² (ρ = 1 at the image's farthest
corner from the principal point) stands for natural and mechanical vignetting together.
"""

import math

import numpy as np
from numpy.typing import NDArray

from synth.arrays import FloatArray, Image
from synth.scene import Camera


def noise_deviation(signal: FloatArray, camera: Camera) -> FloatArray:
    """Standard deviation of the noise of an expected linear signal."""
    return np.asarray(np.sqrt(camera.read_noise**2 + camera.shot_noise**2 * signal))


def camera_image(radiance: Image, camera: Camera, rng: np.random.Generator) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """The image as it is read from the camera.

    Args:
        radiance: (H, W, 3) float32, linear; exposure 1 maps 1 to full scale.
        camera: exposure, blur, vignetting, noise, gamma and bit depth.
        rng: source of the noise; two images need two states of it.

    Returns:
        (H, W, 3) uint8 for 8 bits. For 10 to 16 bits uint16, stretched to the full 16-bit range (a 10-bit value q is
        stored as round(q · 65535 / 1023)), as readers of 16-bit PNGs expect; the steps between values stay 10-bit.
    """
    signal = expected_signal(radiance, camera)
    noisy = signal + noise_deviation(signal, camera) * rng.standard_normal(signal.shape)
    encoded = np.clip(noisy, 0, 1) ** (1 / camera.gamma)
    levels = 2**camera.bit_depth - 1
    quantised = np.floor(encoded * levels + 0.5)
    if camera.bit_depth == 8:
        return quantised.astype(np.uint8)
    return np.floor(quantised * (65535 / levels) + 0.5).astype(np.uint16)


def expected_signal(radiance: Image, camera: Camera) -> FloatArray:
    """The noiseless linear signal (H, W, 3) float64, full scale 1, not clipped: blurred, vignetted, exposed."""
    signal = radiance.astype(np.float64)
    if camera.blur_px > 0:
        import cv2

        radius = max(1, math.ceil(4 * camera.blur_px))  # the tail beyond 4 sigma holds 6e-5 of a Gaussian's weight
        size = (2 * radius + 1, 2 * radius + 1)
        blurred = cv2.GaussianBlur(signal, size, camera.blur_px, borderType=cv2.BORDER_REPLICATE)
        signal = blurred.reshape(signal.shape)  # OpenCV drops the axis of a single channel
    if camera.vignetting > 0:
        signal = signal * vignette(camera)[:, :, None]
    return camera.exposure * signal


def vignette(camera: Camera) -> FloatArray:
    """Relative illumination (H, W) float64 at pixel centres: 1 at (cx, cy), 1 - vignetting at the farthest corner."""
    x = np.arange(camera.width) + 0.5 - camera.cx
    y = np.arange(camera.height) + 0.5 - camera.cy
    corner = max(abs(camera.cx), abs(camera.width - camera.cx)) ** 2
    corner += max(abs(camera.cy), abs(camera.height - camera.cy)) ** 2
    return 1 - camera.vignetting * (x[None, :] ** 2 + y[:, None] ** 2) / corner

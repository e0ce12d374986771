r"""Read and shot noise from the finest detail of one frame.

The kernel [1 -2 1; -2 4 -2; 1 -2 1] / 6 (Immerkær, CVIU 64, 1996) removes every smooth shading and leaves white noise's
variance. In bands of brightness, away from the pattern, that variance less the quantisation's is fitted by the
photon-transfer line of `synth.render.camera_image`, read² + shot² · signal. Frames from a lossy codec hold less noise
than the camera made: what is found is what is left in such frames, which is what synthetic ones should have.
"""

import cv2
import numpy as np
from scipy.optimize import nnls

from synth.arrays import BoolArray, FloatArray

_KERNEL = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]) / 6
_BANDS, _FEWEST = 12, 100
"""Bands of brightness, and pixels that a band needs."""


def fit_noise(encoded: FloatArray, bare: BoolArray, gamma: float, step: float) -> tuple[float, float]:
    """Read and shot noise of `synth.scene.Camera` from one frame (H, W, 3) in [0, 1].

    `bare` (H, W) are pixels whose neighbourhood shows nothing but smooth coating, `step` is that of one level of
    quantisation.
    """
    inner = cv2.erode(bare.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    signals, variances, counts = [], [], []
    for channel in np.moveaxis(encoded, 2, 0):
        fine = cv2.filter2D(channel, -1, _KERNEL)[inner]
        level: FloatArray = np.maximum(cv2.blur(channel, (3, 3))[inner], 1e-3)
        slope = gamma * level ** (gamma - 1)  # d linear / d encoded
        order = np.argsort(level)
        for band in np.array_split(order, _BANDS):
            if len(band) < _FEWEST:
                continue
            # The median is blind to scratches and dust; 1.4826 makes it a standard deviation.
            variance = (1.4826 * float(np.median(np.abs(fine[band])))) ** 2 - step**2 / 12
            if variance <= 0:  # quantised to zero for the most part: the mean square still counts
                variance = max(float(np.mean(np.minimum(np.abs(fine[band]), 3 * step) ** 2)) - step**2 / 12, 0.0)
            signals.append(float(np.mean(level[band] ** gamma)))
            variances.append(variance * float(np.mean(slope[band] ** 2)))
            counts.append(len(band))
    if not signals:
        return 0.0, 0.0
    found = np.array(variances)
    weight = np.sqrt(counts) / np.maximum(found, 1e-9)  # a variance's error is proportional to it
    line = np.column_stack([np.ones(len(signals)), signals]) * weight[:, None]
    read, shot = nnls(line, found * weight)[0]
    return float(np.sqrt(read)), float(np.sqrt(shot))

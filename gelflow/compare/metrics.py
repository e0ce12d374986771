"""How good a flow is: against an exact flow, against tracked dots, back again, and by the images themselves.

With a flow V from image 1 to image 2 and the exact flow W, over the n pixels that see gel and are visible in both:

    endpoint error   e(x) = |V(x) - W(x)|;  mean, median, and the share of pixels with e > 1 px and e > 0.1 px
    PSNR             10 log10(255^2 / MSE(I1, I1~)),  I1~(x) = I2(x + V(x)), 8 bit, all pixels and channels
    SSIM             Wang et al. 2004: Gaussian window 11 x 11, sigma 1.5, K1 = .01, K2 = .03, of the 8-bit luma,
                     mean over the whole image, mirrored at its border
    marker distance  median of |(x1, y1) + V(x1, y1) - (x2, y2)|
    closure          |V(x) + W(x + V(x))|, W the method's flow from image 2 to image 1; median and 90th percentile

PSNR and SSIM are those of the GelFlow paper (n = 8 bit); they tell how well image 2 can be brought to image 1, not
where the gel went.
"""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from gelflow.arrays import Bytes3, FlowArray, Grey8, ImageArray, MarkerArray, MaskArray, PointArray
from gelflow.errors import InputError
from gelflow.files.image import to_bytes, to_grey
from gelflow.ops.warp import warp_image


def endpoint_error(flow: FlowArray, truth: FlowArray) -> NDArray[np.float64]:
    """|flow - truth| at each pixel, (H, W) float64 in px; NaN where either is."""
    difference = flow.astype(np.float64) - truth
    return np.hypot(difference[..., 0], difference[..., 1])


def flow_errors(flow: FlowArray, truth: FlowArray, visible: MaskArray) -> dict[str, float]:
    """Endpoint errors over the pixels where the truth is finite and visible, by the names of `scores.Measures`.

    A NaN in the estimate is an outlier at both limits and makes mean and median NaN. InputError where the shapes
    differ, or no pixel can be compared.
    """
    if flow.shape != truth.shape or visible.shape != truth.shape[:2]:
        raise InputError(f"flow {flow.shape}, exact flow {truth.shape} and visibility {visible.shape} do not fit")
    compared = np.logical_and(visible, np.isfinite(truth).all(axis=-1))
    if not compared.any():
        raise InputError("the exact flow has no visible pixel that sees gel; nothing can be compared")
    error = endpoint_error(flow, truth)[compared]
    return {
        "endpoint_error_px": float(error.mean()),
        "median_error_px": float(np.median(error)),
        "outliers_1px": float(np.mean(~(error <= 1.0))),
        "outliers_01px": float(np.mean(~(error <= 0.1))),
    }


def psnr(image: Bytes3, other: Bytes3) -> float:
    """Peak signal-to-noise ratio (dB) of two 8-bit images over all pixels and channels; infinite if they are equal."""
    mean_square = float(np.mean((image.astype(np.float64) - other) ** 2))
    return float("inf") if mean_square == 0 else 10.0 * float(np.log10(255.0**2 / mean_square))


def ssim_map(grey: Grey8, other: Grey8) -> NDArray[np.float64]:
    """Structural similarity at each pixel of two grey 8-bit images, (H, W)."""

    def blurred(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(cv2.GaussianBlur(values, (11, 11), 1.5, borderType=cv2.BORDER_REFLECT_101))

    x, y = grey.astype(np.float64), other.astype(np.float64)
    c1, c2 = (0.01 * 255.0) ** 2, (0.03 * 255.0) ** 2
    mean_x, mean_y = blurred(x), blurred(y)
    variance_x, variance_y = blurred(x * x) - mean_x**2, blurred(y * y) - mean_y**2
    covariance = blurred(x * y) - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    denominator = (mean_x**2 + mean_y**2 + c1) * (variance_x + variance_y + c2)
    return np.asarray(numerator / denominator)


def image_similarity(image1: ImageArray, image2: ImageArray, flow: FlowArray) -> tuple[float, float]:
    """PSNR in dB and SSIM of image 1 and image 2 warped by the flow, both rounded to 8 bit.

    Where the flow is NaN the warped image is black.
    """
    warped = np.nan_to_num(warp_image(image2, flow))
    similarity = ssim_map(to_grey(image1), to_grey(warped))
    return psnr(to_bytes(image1), to_bytes(warped)), float(np.mean(similarity))


def marker_distance(flow: FlowArray, markers: MarkerArray) -> float:
    """Median distance in px between dots moved by the flow and the same dots tracked in image 2.

    The flow is read bilinearly at (x1, y1), in OpenCV's coordinates: (0, 0) is the centre of the first pixel.
    """
    return float(np.median(np.hypot(*(moved_points(flow, markers[:, :2]) - markers[:, 2:]).T)))


def moved_points(flow: FlowArray, points: PointArray) -> PointArray:
    """Points (N, 2), moved by a flow that is read bilinearly; NaN where the flow is."""
    at = points[:, ::-1].T
    motion = [map_coordinates(flow[..., k].astype(np.float64), at, order=1, mode="nearest") for k in (0, 1)]
    return points + np.stack(motion, axis=1)


def closure(flow: FlowArray, back: FlowArray) -> NDArray[np.float64]:
    """|V(x) + W(x + V(x))| at each pixel, (H, W) float64 px, W the flow from image 2 to image 1.

    NaN where V leaves the image or either is NaN.
    """
    left = flow + warp_image(back, flow)
    height, width = flow.shape[:2]
    rows, columns = np.indices((height, width))
    x, y = columns + flow[..., 0], rows + flow[..., 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return np.where(inside, np.hypot(left[..., 0], left[..., 1], dtype=np.float64), np.nan)

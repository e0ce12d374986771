"""Methods of flow: error against processor time on one core, and is their sigma calibrated?

Takes data sets with exact flow. Times are those of one core, medians over the pairs of each method's flow, without
sigma but for "fast", which always has it; the first pair of each scene is computed once before. Errors are mean
endpoint errors where the point is seen, averaged over the pairs of a scene and then over scenes.

Sigma is the radius in px that 68 % of errors do not exceed. Pixels are sorted by sigma into ten bins of equal size for
each method; the curve shows the 68th percentile of their errors. AUSE is the area between two curves of the mean error
that is left when pixels are taken out one after the other, by sigma or by the true error, over the mean error of all.
"""

import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.rows import Row, arguments, machine, plot, show, write
from gelflow.baselines import named_methods
from gelflow.compare.metrics import endpoint_error
from gelflow.data.open import open_all
from gelflow.methods.fast import Fast
from gelflow.methods.learned import Learned, open_network
from gelflow.methods.method import uncertainty
from gelflow.models.weights import weights_file

CLASSICAL = ["dis-ultrafast", "dis-fast", "dis-medium", "farneback", "lucas-kanade", "tvl1"]
PIXELS, BINS = 4000, 10
"""Pixels of a pair that count for sigma, and bins of them."""


def main(argv: list[str]) -> int:
    """Measure, print and plot."""
    import cv2
    import torch

    parser = arguments("methods", __doc__)
    parser.add_argument("data", nargs="+", type=Path)
    parser.add_argument("--pairs", type=int, default=3, help="pairs of each data set")
    given = parser.parse_args(argv)
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    methods: dict[str, Any] = {str(method.name): method for method in named_methods(CLASSICAL, "cpu")}
    methods |= {"fast": Fast(), "network": Learned(weights_file(None), None, None, "cpu", "none")}
    methods["best"] = open_network(weights_file(None), device="cpu")
    found: dict[tuple[str, str], list[tuple[float, float, float]]] = defaultdict(list)
    pixels: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
    for path in given.data:
        dataset = open_all([path])
        for index in range(min(given.pairs, len(dataset))):
            images, truth = dataset.images(index), dataset.truth(index)
            if truth is None:
                continue
            for name, method in methods.items():
                if index == 0:
                    method.flow(*images)
                started = time.process_time()
                estimate = method.estimate(*images) if isinstance(method, Fast) else None
                flow = method.flow(*images) if estimate is None else estimate.flow
                spent = time.process_time() - started
                sigma = uncertainty(flow, *images, "cpu")[0] if estimate is None else estimate.sigma
                off = endpoint_error(flow, truth.flow)
                counts = np.isfinite(off) & (truth.visible > 0)
                both = np.stack([sigma[counts], off[counts]]).astype(np.float64)
                found[name, path.name].append((1e3 * spent, both[1].mean(), ause(both[0], both[1])))
                pixels[name].append(both[:, :: max(1, both.shape[1] // PIXELS)])
        print(f"{path.name} is done", flush=True)
    rows: list[Row] = []
    for name in methods:
        scenes = {scene: np.array(values) for (method, scene), values in found.items() if method == name}
        spent = np.median(np.concatenate(list(scenes.values()))[:, 0])
        px, area = np.mean([values[:, 1:].mean(axis=0) for values in scenes.values()], axis=0)
        rows.append({"method": name, "ms": float(spent), "mean_px": float(px), "ause": float(area)})
    curve = [row for name, parts in pixels.items() for row in calibration(name, np.concatenate(parts, axis=1))]
    write(given.out / "methods.csv", rows)
    write(given.out / "methods_sigma.csv", curve)
    print(f"{machine()}; one core, {torch.backends.cpu.get_cpu_capability()}; OpenCV: {cv2.getCPUFeaturesLine()}")
    show(rows, list(rows[0]), f"Error against time, {len(given.data)} data sets")
    plot(given.out / "methods.png", rows, x="ms", y="mean_px", group="method", style="o")
    shown = [row for row in curve if row["method"] in ("fast", "best", "DIS medium")]
    plot(given.out / "methods_sigma.png", shown, x="sigma_px", y="error_px", group="method")
    return 0


def ause(sigma: NDArray[np.float64], error: NDArray[np.float64]) -> float:
    """Area under the sparsification error; 0 if sigma sorts pixels as their errors do."""
    kept = np.arange(1, len(error) + 1)
    by_sigma, by_error = (np.cumsum(error[np.argsort(key, kind="stable")]) / kept for key in (sigma, error))
    return float((by_sigma - by_error).mean() / error.mean())


def calibration(name: str, pairs: NDArray[np.float64]) -> list[Row]:
    """Sigma and the 68th percentile of errors in bins of pixels (2, N), sigma and error."""
    bins = np.array_split(pairs[:, np.argsort(pairs[0], kind="stable")], BINS, axis=1)
    return [
        {"method": name, "sigma_px": float(np.median(sigma)), "error_px": float(np.percentile(error, 68))}
        for sigma, error in bins
    ]

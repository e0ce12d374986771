"""Is the flow's sigma calibrated? Fits CURVATURE of `gelflow.models.uncertainty` to exact flow.

Takes data sets of synth; px are those of the size at which images are worked on. By scene and pattern: the share of
pixels with sigma <= 0.1 px, and how many of these, and of those up to 1 px, err by less than sigma (68 % if
calibrated). The mean distance of that share from 68 % over the scenes is least with the fitted constant (the window of
a pixel is chosen with the present one), on pixels with sigma <= 0.1 px of gels with a pattern. Beside it, the error
against the Cramer-Rao bound: that of a flow which is constant in the narrow window, from the noise that the exact flow
leaves, as medians over pixels. Files of flows in `--out` are used again by a repeated run.
"""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.rows import Row, arguments, show
from gelflow.compare.metrics import endpoint_error
from gelflow.data.open import open_all
from gelflow.data.pairs import PairDataset
from gelflow.data.record import PatternedScene
from gelflow.methods.method import as_array, as_tensor
from gelflow.models.evidence import evidence, step
from gelflow.models.uncertainty import CURVATURE, combined, error_squares
from gelflow.models.working_size import sized_sigma, working_sizes
from gelflow.ops.pyramid import resize_flow, resize_images
from gelflow.ops.spline import SplineImage
from gelflow.predict.model import load_model

WINDOW_PX, BACKGROUND_PX = 5.0, 4.0
"""The last window of registration for motion, and the neighbourhood whose mean does not count."""
EVERY = 7
"""Every so many-th pixel counts; neighbours hardly differ."""
CURVATURES = (0.0, 0.1, 0.14, 0.17, 0.2, 0.24, 0.28, 0.4)
Scenes = Mapping[PatternedScene | None, NDArray[np.float64]]
"""By scene and pattern: sigma with each of CURVATURES, the bound's square, and endpoint error; (10, N)."""


def pixels(dataset: PairDataset, folder: Path) -> Scenes:
    """The errors of the shipped network's flow and its sigmas."""
    model = load_model()
    found: dict[PatternedScene | None, list[NDArray[np.float64]]] = {}
    folder.mkdir(parents=True, exist_ok=True)
    for index, record in enumerate(dataset.records):
        image1, image2 = dataset.images(index)
        truth = dataset.truth(index)
        if truth is None:
            continue
        stored = folder / f"{record.name.replace('/', '_')}.npy"
        if not stored.exists():
            np.save(stored, model.flow(image1, image2))
        flow = np.load(stored)
        moved, true, first, second = (as_tensor(array, "cpu") for array in (flow, truth.flow, image1, image2))
        sigmas = {size: sized_sigma(moved, first, second, size)[0] for size in working_sizes(*image1.shape[:2])}
        size = min(sigmas, key=lambda one: float(sigmas[one].mean()))
        moved, true = resize_flow(moved, size), resize_flow(true, size)
        first, second = resize_images(first, size), resize_images(second, size)
        squares = error_squares(moved, first, second)
        error = endpoint_error(as_array(moved), as_array(true))
        counts = np.isfinite(error) & (cv2.resize(truth.visible.astype(np.float32), size[::-1]) == 1)
        values = [combined(*squares, factor)[0, 0].double().numpy() for factor in CURVATURES]
        bound = step(evidence(true.nan_to_num(), first, SplineImage(second).at, BACKGROUND_PX), WINDOW_PX).variance
        values += [bound[0, 0].double().numpy(), error]
        found.setdefault(record.scene, []).append(np.stack([value[counts][::EVERY] for value in values]))
        print(f"{len(found)} scenes, pair {index + 1} of {len(dataset)}", flush=True)
    return {scene: np.concatenate(parts, axis=1) for scene, parts in found.items()}


def hits(part: NDArray[np.float64], curvature: float, low: float, high: float) -> tuple[float, float]:
    """Share of pixels with a sigma in (low, high] px, and how many of these err by at most sigma."""
    sigma, error = part[CURVATURES.index(curvature)], part[-1]
    chosen = (sigma > low) & (sigma <= high)
    return float(chosen.mean()), float((error <= sigma)[chosen].mean()) if chosen.any() else np.nan


def fitted(scenes: Scenes) -> float:
    """CURVATURE."""
    away = {}
    for curvature in CURVATURES:
        shares = np.array([hits(part, curvature, 0.0, 0.1)[1] for part in scenes.values()])
        away[curvature] = float(np.nanmean(np.abs(shares - 0.68)))
        print(f"CURVATURE {curvature:g}: {100 * np.nanmean(shares):.1f} % right, {100 * away[curvature]:.1f} % away")
    return min(CURVATURES, key=lambda one: away[one])


def main(argv: list[str]) -> int:
    """Fit and print the table."""
    parser = arguments("sigma", __doc__)
    parser.add_argument("data", nargs="+", type=Path)
    given = parser.parse_args(argv)
    scenes = pixels(open_all(given.data), given.out / "sigma")
    curvature = fitted({name: part for name, part in scenes.items() if name is None or not name.bare})
    print(f"fitted: CURVATURE {curvature:g}; as it stands: {CURVATURE:g}")
    rows: list[Row] = []
    for name, part in sorted(scenes.items(), key=lambda item: str(item[0])):
        row: Row = {"scene": str(name), "pixels": part.shape[1]}
        for low, high in ((0.0, 0.1), (0.1, 1.0)):
            share, right = hits(part, CURVATURE, low, high)
            row |= {f"sigma <= {high:g} px %": 100 * share, f"of these right % ({high:g})": 100 * right}
        # Of a normal distribution in the plane half are within sqrt(ln 2) of the deviation.
        bound, error = np.sqrt(np.log(2) * np.median(part[-2])), np.median(part[-1])
        row |= {"bound px": bound, "error px": error, "multiple": error / bound}
        rows.append(row | {"sigma > 1 px %": 100 * hits(part, CURVATURE, 1.0, np.inf)[0]})
    show(rows, list(rows[0]), "Sigma with the constant as it stands")
    return 0

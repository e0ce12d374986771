"""Is the flow's sigma calibrated? Fits the two constants of `gelflow.models.uncertainty` to exact flow.

Takes data sets of synth. By scene and pattern: the share of pixels with sigma <= 0.1 px, and how many of these, and of
those up to 1 px, err by less than sigma (68 % if calibrated). The constants are fitted to the pixels with
sigma <= 0.1 px of gels with a pattern: CURVATURE so that the scenes differ least in that share, SCALE so that its mean
is 68 %. Files of flows in `--out` are used again by a repeated run.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.rows import Row, arguments, show
from gelflow.baselines.tensors import as_tensor
from gelflow.compare.metrics import endpoint_error
from gelflow.data.open import open_all
from gelflow.data.pairs import PairDataset, without_pattern
from gelflow.models.uncertainty import CURVATURE, SCALE, error_squares, smoothed
from gelflow.predict.model import load_model

EVERY = 7
"""Every so many-th pixel counts; neighbours hardly differ."""
CURVATURES = (0.05, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.56, 0.8)
Scenes = Mapping[str, NDArray[np.float64]]
"""By scene and pattern: squares of step and curvature, px^2, and endpoint error, px; (3, N)."""


def pixels(dataset: PairDataset, folder: Path) -> Scenes:
    """The errors of the shipped network's flow and what sigma is made of."""
    model = load_model()
    found: dict[str, list[NDArray[np.float64]]] = {}
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
        squares = error_squares(*(as_tensor(array, "cpu") for array in (flow, image1, image2)))
        counts = truth.visible & np.isfinite(truth.flow).all(axis=-1)
        step, bent = (smoothed(one)[0, 0].double().numpy() for one in squares)
        values = [step, bent, endpoint_error(flow, truth.flow)]
        found.setdefault(str(record.scene), []).append(np.stack([value[counts][::EVERY] for value in values]))
        print(f"{len(found)} scenes, pair {index + 1} of {len(dataset)}", flush=True)
    return {scene: np.concatenate(parts, axis=1) for scene, parts in found.items()}


def hits(part: NDArray[np.float64], scale: float, curvature: float, low: float, high: float) -> tuple[float, float]:
    """Share of pixels with a sigma in (low, high] px, and how many of these err by at most sigma."""
    step, bent, error = part
    sigma = scale * np.sqrt(step + curvature**2 * bent)
    chosen = (sigma > low) & (sigma <= high)
    return float(chosen.mean()), float((error <= sigma)[chosen].mean()) if chosen.any() else np.nan


def fitted(scenes: Scenes) -> tuple[float, float]:
    """SCALE and CURVATURE."""
    spreads = {}
    for curvature in CURVATURES:
        low, high = 0.1, 10.0
        for _ in range(30):
            scale = float(np.sqrt(low * high))
            shares = [hits(part, scale, curvature, 0.0, 0.1)[1] for part in scenes.values()]
            low, high = (scale, high) if np.nanmean(shares) < 0.68 else (low, scale)
        spreads[curvature] = float(np.nanstd(shares)), scale
        print(f"CURVATURE {curvature:g}, SCALE {scale:.3f}: scenes differ by {100 * spreads[curvature][0]:.1f} %")
    best = min(CURVATURES, key=lambda one: spreads[one])
    return spreads[best][1], best


def main(argv: list[str]) -> int:
    """Fit and print the table."""
    parser = arguments("sigma", __doc__)
    parser.add_argument("data", nargs="+", type=Path)
    given = parser.parse_args(argv)
    scenes = pixels(open_all(given.data), given.out / "sigma")
    scale, curvature = fitted({name: part for name, part in scenes.items() if not without_pattern(name)})
    print(f"fitted: SCALE {scale:.3g}, CURVATURE {curvature:g}; as they stand: {SCALE:g}, {CURVATURE:g}")
    rows: list[Row] = []
    for name, part in sorted(scenes.items()):
        row: Row = {"scene": name, "pixels": part.shape[1]}
        for low, high in ((0.0, 0.1), (0.1, 1.0)):
            share, right = hits(part, SCALE, CURVATURE, low, high)
            row |= {f"sigma <= {high:g} px %": 100 * share, f"of these right % ({high:g})": 100 * right}
        rows.append(row | {"sigma > 1 px %": 100 * hits(part, SCALE, CURVATURE, 1.0, np.inf)[0]})
    show(rows, list(rows[0]), "Sigma with the constants as they stand")
    return 0

"""The numbers of one view: a JSON-able record with one form for samples and flow files."""

from typing import Any

import numpy as np

from synth.arrays import BoolArray, FloatArray
from synth.flow.field import FlowArray
from synth.inspect.view import View


def numbers_of(view: View) -> dict[str, Any]:
    """What a view says in numbers; None where there is nothing to say it from.

    Returns:
        name, width, height, bits, forward and backward (min_px, median_px, p95_px, max_px over the pixels that see gel;
        nan_share of all pixels; visible_share of those with gel), closure, sigma (median_px, p95_px, max_px, pixels),
        difference (before_rmse, after_rmse as shares of full scale over visible pixels), and from a sample's meta.json
        index, trajectory, frames, force_n, torque_nmm, solver.
    """
    height, width = view.size
    flow, meta = view.flow, view.meta
    backward = None
    if flow.backward is not None and flow.backward_visible is not None:
        backward = _motion(flow.backward, flow.backward_visible > 0.5, view.visible_known)
    difference = None
    if view.differences is not None:
        difference = dict(zip(("before_rmse", "after_rmse"), map(_rms, view.differences), strict=True))
    return {
        "name": view.name,
        "index": meta.get("index"),
        "trajectory": meta.get("trajectory"),
        "frames": meta.get("frames"),
        "width": width,
        "height": height,
        "bits": None if view.image1 is None else 8 * view.image1.itemsize,
        "forward": _motion(flow.forward, view.visible, view.visible_known),
        "backward": backward,
        "closure": None if view.closure is None else _spread(view.closure),
        "sigma": None if view.sigma is None else _spread(view.sigma),
        "difference": difference,
        "force_n": meta.get("force_n"),
        "torque_nmm": meta.get("torque_nmm"),
        "solver": meta.get("diagnostics", {}).get("solver") if isinstance(meta.get("diagnostics"), dict) else None,
        "channels": sorted(flow.extras),
    }


def _motion(flow: FlowArray, visible: BoolArray, visible_known: bool) -> dict[str, float | None]:
    length = np.hypot(flow[..., 0].astype(np.float64), flow[..., 1].astype(np.float64))
    gel = np.isfinite(length)
    share = float(visible[gel].mean()) if visible_known and gel.any() else None
    found = _percentiles(length[gel], min_px=0, median_px=50, p95_px=95, max_px=100)
    return {**found, "nan_share": float(1 - gel.mean()), "visible_share": share}


def _spread(values: FloatArray) -> dict[str, float | int | None]:
    found = values[np.isfinite(values)]
    return {**_percentiles(found, median_px=50, p95_px=95, max_px=100), "pixels": int(found.size)}


def _percentiles(values: FloatArray, **percents: int) -> dict[str, float | None]:
    """By the names of the percents; None of no values."""
    if not values.size:
        return dict.fromkeys(percents)
    return {
        name: float(value) for name, value in zip(percents, np.percentile(values, [*percents.values()]), strict=True)
    }


def _rms(values: FloatArray) -> float | None:
    found = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(found**2))) if found.size else None

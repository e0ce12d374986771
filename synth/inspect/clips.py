"""What is shown of a clip beside the pictures of its last frame: a film, and force and slip over time."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from synth.dataset.sample_reader import ClipData
from synth.inspect.inspection import evenly_spaced
from synth.inspect.panels import Panel, Rgb, flow_colours, image_picture, panels_of, robust_scale
from synth.inspect.view import View

STRIP = 8
"""Frames of a film that stand for it where nothing plays; half as many where there are no images."""


def pictures_of(view: View, numbers: Mapping[str, Any]) -> list[Panel]:
    """`panels_of` the view, after a clip's film and curves."""
    clip = view.clip
    own = [] if clip is None else [_film(clip), Panel("force, contact and slip over time", _curves(clip))]
    return own + panels_of(view, numbers)


def _film(clip: ClipData) -> Panel:
    count = STRIP if clip.images else STRIP // 2
    strip = _frames(clip, evenly_spaced(len(clip), count))
    strip += [np.full_like(strip[0], 255)] * (count - len(strip))
    rows = [np.concatenate(strip[at : at + 2], axis=1) for at in range(0, count, 2)]
    time = clip.states["time_s"]
    rate = float((len(clip) - 1) / (time[-1] - time[0]))
    caption = f"frames 0 to {len(clip) - 1}, {rate:g} a second: image, and flow from frame 0"
    return Panel(caption, np.concatenate(rows), film=lambda: _frames(clip, list(range(len(clip)))), rate=rate)


def _frames(clip: ClipData, numbers: list[int]) -> list[Rgb]:
    """Image and flow of each frame, side by side, on one scale of colours."""
    flows = [clip.flows[number - 1].forward if number else 0 * clip.flows[0].forward for number in numbers]
    scale = max(map(robust_scale, flows))
    shown = [[flow_colours(flow, scale)] for flow in flows]
    if clip.images:
        shown = [[image_picture(clip.images[n]), *one] for n, one in zip(numbers, shown, strict=True)]
    return [np.concatenate(one, axis=1) for one in shown]


def _curves(clip: ClipData) -> Rgb:
    """The wrench's force, and the contact's area and slip, over time; gross slip is shaded."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    states, figure = clip.states, Figure(figsize=(5.4, 4.0), dpi=110, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    time = states["time_s"]
    for axis in "xyz":
        upper.plot(time, states[f"f{axis}_n"], label=f"F{axis}", marker=".")
    lower.plot(time, states["slip_ratio"], "C3.-")
    area = lower.twinx()
    area.plot(time, states["contact_area_mm2"], "C4.--")
    step = time[1] - time[0]
    for at in time[states["gross_slip"] == 1]:
        for axes in (upper, lower):
            axes.axvspan(at - step / 2, at + step / 2, color="C3", alpha=0.12, linewidth=0)
    upper.set(ylabel="N")
    lower.set(xlabel="s (shaded: all of the contact slides)", ylabel="slip ratio (line)", ylim=(-0.05, 1.05))
    area.set(ylabel="contact, mm² (dashed)")
    upper.legend(loc="upper left", fontsize=8)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()

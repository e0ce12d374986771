"""Plots of `bench render`: image error against time, and what DIS makes of render noise."""

import io
from typing import Any

from synth.bench.render_findings import Results, pareto_front
from synth.bench.render_flow import SEEN_PX
from synth.render.sample_count import SHARE

MARKERS = "os^vD"


def plots(results: Results) -> bytes:
    """A PNG of three panels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17.0, 5.4), dpi=110)
    image, error, change = figure.subplots(1, 3)
    _image(image, results)
    _flow_error(error, results)
    _change(change, results)
    figure.tight_layout()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _image(axis: Any, results: Results) -> None:
    """RMSE against the time of a frame; a line for each variant and depth."""
    cells = [cell for cell in results.cells if cell.is_error]
    families = dict.fromkeys((cell.setting.variant.name, cell.setting.max_depth) for cell in cells)
    for number, (variant, depth) in enumerate(families):
        members = sorted(
            (c for c in cells if (c.setting.variant.name, c.setting.max_depth) == (variant, depth)),
            key=lambda c: c.setting.samples,
        )
        x, y = [c.cost for c in members], [c.errors.rmse for c in members]
        axis.plot(x, y, "-", marker=MARKERS[number % len(MARKERS)], markersize=5, linewidth=1,
                  label=f"{variant}, depth {depth}")  # fmt: skip
    longest = max(families, key=lambda f: sum((c.setting.variant.name, c.setting.max_depth) == f for c in cells))
    for cell in cells:
        if (cell.setting.variant.name, cell.setting.max_depth) == longest:
            axis.annotate(str(cell.setting.samples), (cell.cost, cell.errors.rmse), xytext=(4, -11),
                          textcoords="offset points", fontsize=8, color="grey")  # fmt: skip
    front = pareto_front(cells)
    axis.plot([c.cost for c in front], [c.errors.rmse for c in front], "-", color="gold", linewidth=7, alpha=0.45,
              zorder=0, label="Pareto front")  # fmt: skip
    for value, name in (
        (results.camera_noise, "camera's own noise"),
        (SHARE * results.camera_noise, "a quarter of it"),
        (results.reference_noise, "noise of the reference"),
    ):
        axis.axhline(value, color="black", linestyle="--", linewidth=0.8)
        axis.annotate(name, (1, value), xycoords=("axes fraction", "data"), ha="right", va="bottom", fontsize=8)
    camera = results.subject.small.sensor.camera
    kind = "time" if results.fastest.startswith("cuda") else "processor time"
    axis.set(xscale="log", yscale="log", xlabel=f"{kind} of a frame of {camera.width} x {camera.height}, s",
             ylabel="RMSE, levels of 255", title="Image error (numbers: samples per pixel)")  # fmt: skip
    _plain_numbers(axis.xaxis)
    _plain_numbers(axis.yaxis)
    axis.grid(True, which="both", alpha=0.25)
    axis.legend(fontsize=8)


def _flow_error(axis: Any, results: Results) -> None:
    for noise, colour in ((False, "tab:blue"), (True, "tab:red")):
        own = [effect for effect in results.effects if effect.camera_noise == noise]
        x, y = [effect.samples for effect in own], [effect.median_px for effect in own]
        spread = [
            [effect.median_px - effect.quartiles_px[0] for effect in own],
            [effect.quartiles_px[1] - effect.median_px for effect in own],
        ]
        axis.errorbar(x, y, spread, marker="o", capsize=3, color=colour, label=_label(noise))
    _samples_axis(axis)
    axis.set(
        ylabel="endpoint error of DIS, px", title="Flow error, mean of the pixels (median and quartiles of the pairs)"
    )
    axis.legend(fontsize=8)


def _change(axis: Any, results: Results) -> None:
    for noise, colour in ((False, "tab:blue"), (True, "tab:red")):
        own = [effect for effect in results.effects if effect.camera_noise == noise]
        x = [effect.samples for effect in own]
        for change, line, name in (
            ([effect.change for effect in own], "-o", "mean of the pixels"),
            ([effect.typical_change for effect in own], "--s", "median pixel"),
        ):
            axis.errorbar(x, [one for one, _ in change], [2 * error for _, error in change], fmt=line, capsize=3,
                          color=colour, markersize=5, label=f"{name}, {_label(noise)}")  # fmt: skip
    axis.axhspan(-SEEN_PX, SEEN_PX, color="green", alpha=0.15, label=f"within {SEEN_PX:g} px")
    _samples_axis(axis)
    axis.set(ylabel="change of the endpoint error, px", title="Change by render noise (± 2 standard errors)")
    axis.legend(fontsize=8)


def _samples_axis(axis: Any) -> None:
    axis.set(xscale="log", xlabel="samples per pixel")
    _plain_numbers(axis.xaxis)
    axis.grid(True, which="both", alpha=0.25)


def _plain_numbers(scale: Any) -> None:
    """1, 2, 5, 10 ... on a logarithmic scale."""
    from matplotlib.ticker import LogLocator, NullFormatter

    scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    scale.set_major_formatter("{x:g}")
    scale.set_minor_formatter(NullFormatter())


def _label(noise: bool) -> str:
    return "with camera noise" if noise else "without camera noise"

"""`bench flow` as CSV, Markdown and a few lines for the terminal."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, field

from synth.bench.flow_measure import REPEATS, Pair, Row
from synth.bench.flow_methods import SHIPPED
from synth.bench.flow_picture import pareto_front
from synth.bench.machine import machine_line
from synth.bench.render_subject import Subject

SIMPLER = ("pixels", "vertices", "camera")
"""Families that do not trace every pixel with the scene's own camera."""
NOT_COVERED = (
    "The simulation's own error, another number (fem.md, budget.md): every way gets the same deformed surface.",
    "Other presses: one pair of each scene, undeformed and pressed.",
    "Occlusion where a scene's line says that nothing is hidden: no test for it can fail there.",
    "GPUs, and more than one thread.",
)


@dataclass(eq=False)
class Results:
    """All of one run; grows scene by scene.

    Attributes:
        subjects: by the scenes' names.
        pairs: their independent derivations.
        rows: of all scenes, the shipped way first in each.
        failures: what `synth verify` would object to.
        seconds: of the whole run.
    """

    subjects: dict[str, Subject] = field(default_factory=dict)
    pairs: dict[str, Pair] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def of(self, scene: str) -> list[Row]:
        """A scene's rows."""
        return [row for row in self.rows if row.scene == scene]

    def record(self) -> list[dict[str, object]]:
        """A plain dictionary per row."""
        front = [row for scene in self.subjects for row in pareto_front(self.of(scene))]
        return [dict(_rounded(vars(row))) | {"pareto": row in front} for row in self.rows]


def table(results: Results) -> bytes:
    """CSV."""
    text = io.StringIO()
    rows = results.record()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode("utf-8")


def summary(results: Results) -> list[str]:
    """Two sentences a scene, then what failed."""
    lines = []
    for scene in results.subjects:
        rows = results.of(scene)
        shipped = next(row for row in rows if row.method == SHIPPED)
        lines.append(
            f"{scene}: the shipped flow is at most {shipped.max_px:.2g} px from the independent derivation, "
            f"visibility differs at {shipped.mask_px} pixels, {shipped.ms:.0f} ms a pair"
        )
        nearest = min((row for row in rows if row.family in SIMPLER), key=lambda row: row.p99_px)
        lines.append(
            f"{scene}: of the ways that interpolate or simplify the camera, *{nearest.method}* comes nearest: "
            f"{nearest.p99_px:.2g} px at 99 % of the pixels, {nearest.max_px:.2g} px at worst, visibility wrong at "
            f"{nearest.mask_px}, {nearest.ms:.0f} ms"
        )
    return [*lines, *(f"verify would object: {line}" for line in results.failures)]


def report(results: Results, command: str) -> str:
    """The Markdown.

    Args:
        results: of a whole run.
        command: that made it.
    """
    parts = [
        "# Error of the flow against its run time",
        f"Made by `{command}` on {machine_line()}, in {results.seconds / 60:.1f} min.",
        "Why is the flow traced? Below, what a simpler generator would give for the same deformed gel. One pair of "
        "each scene, undeformed and pressed, both directions. Errors are distances from the derivation that "
        "`synth verify` has: no rays, refraction by Fermat's principle, OpenCV's lens model, a root search over the "
        "projected surface, in float64. They are of all pixels that see gel and get a value; *mask*: pixels whose "
        "visibility in the other image differs, missing values included. Time is processor time of one thread, median "
        f"of {REPEATS}, both directions; rays of the pixels and fitted maps belong to the camera and exist before. "
        "Bold: no other row is both faster and, in the mean, more exact (Pareto front); the mask has no part in it.",
        "![Error against run time](flow.png)",
        "\n".join(f"- {line}." for line in summary(results)),
        *(part for scene in results.subjects for part in _scene(results, scene)),
        "## The ways",
        "\n".join(f"- *{name}*: {text}" for name, text in _WAYS.items()),
        "## Not covered",
        "\n".join(f"- {line}" for line in NOT_COVERED),
    ]
    return "\n\n".join(parts) + "\n"


_WAYS: Mapping[str, str] = {
    SHIPPED: "`synth.flow.exact`: rays of the pixel centres in float64, projection by lens and window, occlusion "
    "tested by a second ray where the surface may cover itself.",
    "every pixel tested for occlusion, no test": "the same with a second ray for every pixel, or for none.",
    "traced in float32": "Warp's `Mesh` queries, as precise as Embree's or OptiX's; projection in float64.",
    "every k x k pixels": "traced for an image of 1/k of the size, enlarged bilinearly.",
    "vertices, corners": "projected exactly in both states, their motion interpolated linearly in the image "
    "(Delaunay); what lies inside the image counts as visible.",
    "no refraction": "traced through a window of index 1; with the scene's focal length, or with the one that fits the "
    "undeformed gel best, as a calibration without refraction would find it.",
    "affine camera": "motion in x and y times the matrix that fits the undeformed gel best; no perspective.",
}


def _scene(results: Results, scene: str) -> list[str]:
    subject, pair, rows = results.subjects[scene], results.pairs[scene], results.of(scene)
    camera, surface = subject.own.sensor.camera, subject.own.surface
    lengths = pair.lengths
    front = pareto_front(rows)
    lines = ["| way | mean px | 99 % px | max px | mask px | ms a pair |", "| --- | ---: | ---: | ---: | ---: | ---: |"]
    for row in rows:
        name = f"**{row.method}**" if row in front else row.method
        numbers = " | ".join(f"{value:.2g}" for value in (row.mean_px, row.p99_px, row.max_px))
        lines.append(f"| {name} | {numbers} | {row.mask_px} | {row.ms:.0f} |")
    lines.append(f"| verify's derivation, which the others are held against | | | | | {pair.ms:.0f} |")
    hidden = (
        f"{pair.hidden} pixels hidden behind the gel itself" if pair.hidden else "no pixel hidden behind the gel itself"
    )
    return [
        f"## {scene}",
        f"Seed {subject.seed}: {subject.scene.contact.indenter.shape}, {subject.scene.motion.depth_mm:.2f} mm deep; "
        f"{camera.width} x {camera.height} px; a surface of {len(surface.triangles):,} triangles; motion "
        f"{lengths.mean():.2f} px in the mean, {lengths.max():.1f} px at most; {hidden}.",
        "\n".join(lines),
    ]


def _rounded(values: Mapping[str, object]) -> dict[str, object]:
    """Five digits; None for what there is no number of."""
    return {
        name: (float(f"{value:.5g}") if value == value else None) if isinstance(value, float) else value
        for name, value in values.items()
    }

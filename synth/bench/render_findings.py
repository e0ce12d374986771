"""What `bench render` measured, and what follows from it."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from synth.bench.render_auto import Choice
from synth.bench.render_error import Reference, measured_camera_noise, reference_noise, slope
from synth.bench.render_flow import Effect, Truth
from synth.bench.render_measure import DEEPEST, Cell, StartUp
from synth.bench.render_subject import Subject
from synth.render.renderer import full_grid
from synth.render.sample_count import MOST

_Z = 4.0
"""Standard errors within which the bias of full paths must lie; some ten rows share the reference's error."""


@dataclass(eq=False)
class Results:
    """All of one run; grows row by row.

    Attributes:
        subject: what was rendered.
        reference: of the cells.
        exact: flow of the pair.
        cells, start_ups, effects, choices: measured so far.
        absent: a line for each thing that could not be measured.
        seconds: of the whole run.
    """

    subject: Subject
    reference: Reference
    exact: Truth
    cells: list[Cell] = field(default_factory=list)
    start_ups: list[StartUp] = field(default_factory=list)
    effects: list[Effect] = field(default_factory=list)
    choices: list[Choice] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def own_depth(self) -> int:
        """The scene's path depth."""
        return self.subject.scene.render.max_depth

    @property
    def deepest(self) -> int:
        """The reference's path depth."""
        return max(DEEPEST, self.own_depth)

    @property
    def own_samples(self) -> int | None:
        """What the scene's samples per pixel come to; None for "auto"."""
        wanted = self.subject.scene.render.samples_per_pixel
        lights = sum(light.power > 0 for light in self.subject.scene.sensor.lights)
        return None if wanted == "auto" else full_grid(wanted, lights)

    @property
    def fastest(self) -> str:
        """Name of the variant of most pictures."""
        return self.cells[0].setting.variant.name

    @property
    def reference_noise(self) -> float:
        """Levels of 255."""
        return reference_noise(self.reference, self.subject.small.sensor.camera)

    @property
    def camera_noise(self) -> float:
        """The camera's own on the pressed gel, levels of 255."""
        return measured_camera_noise(self.reference.halves[0], self.subject.small.sensor.camera)

    def ladder(self, depth: int) -> list[Cell]:
        """The fastest variant's cells of a path depth, with window, by samples."""
        chosen = [
            cell
            for cell in self.cells
            if cell.setting.window and cell.setting.max_depth == depth and cell.setting.variant.name == self.fastest
        ]
        return sorted(chosen, key=lambda cell: cell.setting.samples)

    def slopes(self) -> tuple[float, float]:
        """Exponent of the full paths' noise in the number of samples, over the lower and the upper half of the ladder.

        NaN where there are fewer than three numbers of samples.
        """
        cells = self.ladder(self.deepest)
        samples, noise = [cell.setting.samples for cell in cells], [cell.errors.noise for cell in cells]
        if len(cells) < 3:
            return float("nan"), float("nan")
        middle = len(cells) // 2
        return slope(samples[: middle + 1], noise[: middle + 1]), slope(samples[middle:], noise[middle:])

    def by_depth(self) -> list[Cell]:
        """Cells that differ in path depth only: the number of samples that most depths have."""
        cells = [cell for cell in self.cells if cell.setting.window and cell.setting.variant.name == self.fastest]
        counts = [cell.setting.samples for cell in cells]
        common = max(dict.fromkeys(counts), key=counts.count)
        chosen = [cell for cell in cells if cell.setting.samples == common]
        return sorted(chosen, key=lambda cell: cell.setting.max_depth)

    def checks(self) -> dict[str, bool]:
        """What must hold, and whether it does."""
        found = {}
        full = self.ladder(self.deepest)
        if full:
            worst = max(abs(cell.errors.bias_percent) / cell.errors.bias_se_percent for cell in full)
            found[f"full paths have no bias ({worst:.1f} standard errors at most, allowed {_Z:g})"] = worst <= _Z
        if self.choices:
            share = max(choice.share for choice in self.choices)
            text = f'with "auto" render noise is under a quarter of the camera\'s ({share:.3f} at most)'
            if any(choice.is_capped for choice in self.choices):
                text += f"; it takes no more than {MOST} samples"
            found[text] = all(choice.met for choice in self.choices)
        return found


def pareto_front(cells: Sequence[Cell]) -> list[Cell]:
    """Cells that no other beats in both cost and error, by rising cost."""
    best, front = float("inf"), []
    for cell in sorted((c for c in cells if c.is_error), key=lambda c: (c.cost, c.errors.rmse)):
        if cell.errors.rmse < best:
            best = cell.errors.rmse
            front.append(cell)
    return front

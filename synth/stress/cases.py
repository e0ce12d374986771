"""Cases and their expected outcomes, as `scenes/extreme/expected.toml` writes them down."""

import fnmatch
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationError, model_validator

from synth.errors import InputError
from synth.scene import Part
from synth.scene.template import SCENES
from synth.untrusted import read_toml

EXTREME = SCENES / "extreme"
"""Folder of the base scene and the expectations."""
END = Literal["complete", "partial", "failed", "refused"]
"""How a case may end: a trajectory's status, or an InputError ("refused"); "crashed" and "hung" are never accepted."""
SurfaceVariant = Literal["ball", "inside out", "mixed", "slivers", "open", "metres", "pane"]
Range = tuple[float, float]


class Comparison(Part):
    """A comparison with the last state of another case, "with" in the file.

    The displacement is the largest accepted difference at any node over the largest displacement, and needs the same
    mesh; the ratio is the accepted range of this case's normal force over the other's.
    """

    with_case: Annotated[str, Field(alias="with")]
    displacement: float | None = None
    force_ratio: Range | None = None


class Expectation(Part):
    """What holds for a case when it has ended: acceptable outcomes, and the comparison with another case.

    `says` appears in the reason or message of every end but "complete"; `bounds` are accepted ranges of quantities of
    `synth.stress.check.measured`, where a pressed state was recorded.
    """

    outcome: tuple[END, ...] = Field(min_length=1)
    says: str = ""
    bounds: Mapping[str, Range] = Field(default_factory=dict)
    compare: Comparison | None = None


class Deviation(Expectation):
    """What holds instead, known to be otherwise than expected; `because` explains."""

    because: Annotated[str, Field(min_length=1)]


class Case(Expectation):
    """One entry of the file; see its head for the meaning of the fields."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_.\-]+$")]
    group: str
    why: Annotated[str, Field(min_length=1)]
    set: tuple[str, ...] = ()
    elements: tuple[str, ...] = Field(default=(), max_length=4)
    factor: Literal["single", "double"] = "single"
    surface: SurfaceVariant | None = None
    object: str | None = None
    budget_s: Annotated[float, Field(gt=0)] | None = None
    deviation: Deviation | None = None


class Expectations(Part):
    """The whole file."""

    elements: tuple[str, ...] = Field(min_length=1)
    budget_s: Annotated[float, Field(gt=0)]
    case: tuple[Case, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _names(self) -> "Expectations":
        names = [case.name for case in self.case]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"there are two cases {name!r}")
        for case in self.case:
            for entry in (case, case.deviation):
                if entry and entry.compare and entry.compare.with_case not in names:
                    raise ValueError(f"case {case.name!r} compares with {entry.compare.with_case!r}, which is none")
        return self


@dataclass(frozen=True)
class Run:
    """A case with one element, as one process runs it on the base scene, for at most `budget_s` of wall time."""

    case: Case
    element: str
    budget_s: float
    base: Path

    @property
    def name(self) -> str:
        """Unique, and the name of the run's folder."""
        return self.case.name if self.element == "auto" else f"{self.case.name}-{self.element}"

    @property
    def assignments(self) -> list[str]:
        """Values of --set over the base scene; the element comes last, because a case may replace all of numerics."""
        file = SCENES / "objects" / f"{self.case.object}.stl"
        indenter = [f"contact.indenter={{ shape = 'mesh', file = '{file}' }}"] if self.case.object else []
        return [*indenter, *self.case.set, f"numerics.element={self.element!r}"]


def load_expectations(path: Path) -> Expectations:
    """Read the file; InputError where it is missing, not TOML, or breaks the schema above."""
    try:
        return Expectations.model_validate(read_toml(path))
    except ValidationError as error:
        problems = [f"{'.'.join(map(str, p['loc']))}: {p['msg']}" for p in error.errors()]
        raise InputError("\n".join(f"{path}: {problem}" for problem in problems)) from error


def all_runs(expectations: Expectations, base: Path = EXTREME / "base.toml") -> list[Run]:
    """Every case with every element it is to run with, in the file's order."""
    return [
        Run(case, element, case.budget_s or expectations.budget_s, base)
        for case in expectations.case
        for element in case.elements or expectations.elements
    ]


def selected(runs: Sequence[Run], patterns: Sequence[str] | None) -> list[Run]:
    """The runs whose name, case or group fits one of the shell patterns, and those that they are compared with.

    InputError where a pattern fits none.
    """
    if not patterns:
        return list(runs)
    chosen: list[Run] = []
    for pattern in patterns:
        found = [r for r in runs if any(fnmatch.fnmatch(n, pattern) for n in (r.name, r.case.name, r.case.group))]
        if not found:
            names = ", ".join(dict.fromkeys(run.case.name for run in runs))
            raise InputError(f"--only {pattern!r}: no case or group of that name; cases are {names}")
        chosen += found
    wanted = {run.name for run in chosen}
    while True:
        more = {other.name for run in runs if run.name in wanted for other in compared(run, runs)} - wanted
        if not more:
            return [run for run in runs if run.name in wanted]
        wanted |= more


def compared(run: Run, runs: Sequence[Run]) -> list[Run]:
    """The runs that a run is compared with: the same element's, or the only one there is."""
    comparisons = [run.case.compare, run.case.deviation.compare if run.case.deviation else None]
    names = {comparison.with_case for comparison in comparisons if comparison}
    return [
        other
        for other in runs
        if other.case.name in names and (other.element == run.element or len(other.case.elements) == 1)
    ]

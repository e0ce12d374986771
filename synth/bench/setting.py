"""What the benchmark compares: a mesh, an element and the solver's parameters."""

from dataclasses import dataclass, field
from typing import Literal

from synth.bench.cases import GEL, Case
from synth.mesh import Counts, Focus, PadMesh, graded_box
from synth.mesh.tetrahedralise import tetrahedralise_box
from synth.scene import Numerics
from synth.simulate.driver import STANDARD, Driver
from synth.simulate.element import Element, p1, p1p1, p2p1
from synth.simulate.resolution import graded_mesh

ElementName = Literal["p2p1", "p1p1", "p1"]
WRITTEN = {"p2p1": "P2/P1", "p1p1": "P1/P1", "p1": "P1"}


@dataclass(frozen=True)
class Graded:
    """The structured mesh that scenes are simulated on: elements across the contact, and through the thickness or, for
    None, as many as keep them no higher than wide.
    """

    across: int
    through: int | None = None

    def __str__(self) -> str:
        return f"{self.across} across" + ("" if self.through is None else f", {self.through} through")

    def mesh(self, case: Case) -> PadMesh:
        """The mesh of a case."""
        return graded_mesh(GEL, case.focus, self.across, self.through)[0]


@dataclass(frozen=True)
class Fine:
    """A structured mesh for a reference: more elements than `Graded` has also beside and beneath the contact."""

    across: int
    through: int = 5

    def __str__(self) -> str:
        return f"{self.across} across, {self.through} through"

    def mesh(self, case: Case) -> PadMesh:
        """The mesh of a case."""
        counts = Counts((self.across, self.across), (4, 3), self.through, growth=1.5)
        return graded_box(GEL.size_mm, case.focus, counts)


@dataclass(frozen=True)
class Wild:
    """fTetWild's mesh, edges of fine_mm in the contact's zone growing to coarse_mm away from it."""

    fine_mm: float
    coarse_mm: float

    def __str__(self) -> str:
        return f"{self.fine_mm:g} to {self.coarse_mm:g} mm"

    def mesh(self, case: Case) -> PadMesh:
        """A mesh of a case; fTetWild is not deterministic."""
        return tetrahedralise_box(GEL.size_mm, self.fine_mm, focus=case.focus, coarse_mm=self.coarse_mm)


@dataclass(frozen=True)
class Uniform:
    """Equal cells, x, y and z; x and y even."""

    counts: tuple[int, int, int]

    def __str__(self) -> str:
        return "x".join(map(str, self.counts))

    def mesh(self, case: Case) -> PadMesh:
        """The mesh, the same for all cases."""
        x, y, z = self.counts
        whole = Focus((0.0, 0.0), (GEL.size_mm[0] / 2, GEL.size_mm[1] / 2))
        return graded_box(GEL.size_mm, whole, Counts((x - 2, y - 2), (1, 1), z, growth=1.0))


MeshKind = Graded | Fine | Wild | Uniform


@dataclass(frozen=True)
class Setting:
    """One way to simulate a case.

    Attributes:
        family: settings of one family differ in their mesh only.
        mesh: which mesh.
        element: on it.
        contact_split: contact is integrated at 3 points on each of contact_split² parts of a face.
        numerics: steps, tolerance and penalty.
        driver: of Newton's method.
        detail: what differs from the standard, for a variant.
    """

    family: str
    mesh: MeshKind
    element: ElementName = "p2p1"
    contact_split: int = 3
    numerics: Numerics = field(default_factory=Numerics)
    driver: Driver = STANDARD
    detail: str = ""

    @property
    def name(self) -> str:
        """Of the setting within its case, unique."""
        return f"{self.detail or self.family}, {self.mesh}"

    @property
    def contact_points(self) -> int:
        """On a face."""
        return 3 * self.contact_split**2

    def built_element(self) -> Element:
        """Its tables."""
        if self.element == "p2p1":
            return p2p1(self.contact_split)
        return p1p1(contact_split=self.contact_split) if self.element == "p1p1" else p1(self.contact_split)


def of_family(kind: str, element: ElementName, *meshes: MeshKind) -> list[Setting]:
    """Standard settings on meshes of one kind."""
    return [Setting(f"{kind} {WRITTEN[element]}", mesh, element) for mesh in meshes]

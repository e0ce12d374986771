"""How large is the error of displacement and force at a run time, by mesh, element and solver options?

    python -m benchmarks fem            one case and a few meshes, in about two minutes
    python -m benchmarks fem --all      three cases and all settings, in about half an hour

A rigid ball of 4 mm radius presses a pad of 20 x 15 x 4 mm, E = 0.2 MPa, Poisson ratio 0.4999, to 0.5, 1.2 and 2 mm
without friction (*centred*, *off-centre*), or to 1.2 mm and is sheared and twisted back and forth with friction 0.5
(*sheared*). Errors are taken against a much finer mesh, the worst of the states that count: with u and r the two
displacements at points of the contact face,

    displacement_percent  100 sqrt(mean |u - r|² / mean |r|²)
    displacement_px       the root mean square of the part along the face, in the picture of a GelSight Mini
    force_percent         of the normal and, with friction, of the tangential force (length of the vectors' difference)

The reference's own error is less than about 1.7 times that of the family "reference mesh", which is a coarser one of
its kind. Times are processor times of one press, set-up included; kernels are compiled before.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks.focused_mesh import around_focus
from benchmarks.press import (
    PAD_MM,
    ball_scene,
    face_displacement,
    face_grid,
    root_mean_square,
    timed,
)
from benchmarks.rows import Row, arguments, machine, measure, plot, show
from synth.mesh import Counts, Focus, PadMesh, graded_box
from synth.mesh.element import Element, p1p1, p2p1
from synth.mesh.tetrahedralise import tetrahedralise_box
from synth.press.footprint import footprint
from synth.press.resolution import MARGIN, graded_mesh
from synth.press.scene_path import path_of
from synth.scene import Scene
from synth.simulate import Trajectory
from synth.simulate.direct import DirectPress
from synth.simulate.material import pad_material
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.policy.load_steps import LoadSteps
from synth.simulate.policy.newton import MAX_ITERATIONS
from synth.simulate.space import function_space
from synth.simulate.system import System

PX_PER_MM = 17.2
LEAST_TANGENTIAL = 0.05
"""Share of the normal force below which a ratio to the tangential force says nothing."""
LARGEST_PENETRATION_MM = 0.01
"""Of a reference; one that is deeper in the ball was not corrected, and its force is some per cent too low."""
ELEMENTS: dict[str, Callable[[int], Element]] = {
    "P2/P1": p2p1,
    "P1/P1": p1p1,
    "P1": lambda contact_split: replace(p1p1(contact_split), name="p1", stabilisation=0.0),  # no pressure: it locks
}
POINTS = face_grid(PAD_MM, (61, 46))
PLAIN = SolverOptions(relaxed_tolerance=0.0, extrapolate=False, single_precision=False, reuse_factors=False)
"""What a textbook would do: every step from the last state to the full tolerance, every tangent factorised in double
precision."""


def _deeper(x: float, y: float) -> Scene:
    motion = {"depth_mm": 0.5, "position_mm": [x, y], "steps": 3, "then": [{"depth_mm": 1.2}, {"depth_mm": 2.0}]}
    return ball_scene(4.0, 0.0, motion)


CASES = {"centred": _deeper(0.0, 0.0), "off-centre": _deeper(3.7, -2.3)}
CASES["sheared"] = ball_scene(
    4.0,
    0.5,
    {
        "depth_mm": 1.2,
        "position_mm": [1.3, -0.7],
        "shear_mm": [1.0, 0.4],
        "twist_deg": 8.0,
        "steps": 3,
        "then": [{"depth_mm": 1.2, "shear_mm": [-0.5, 0.4], "twist_deg": -8.0}],
    },
)
COUNTED = {"centred": [2, 3], "off-centre": [2, 3], "sheared": [1, 2, 3]}
"""Numbers of the states whose errors count."""


@dataclass(frozen=True)
class Setting:
    """One way to simulate a case.

    Attributes:
        family: settings of a family differ in the size of their mesh only.
        mesh: kind and sizes, see `mesh_of`.
        element: a name of ELEMENTS.
        contact_split: contact is integrated at 3 points on each of contact_split² parts of a face.
        numerics: what differs from a scene's defaults.
        options: options of Newton's method.
    """

    family: str
    mesh: tuple[Any, ...]
    element: str = "P2/P1"
    contact_split: int = 3
    numerics: dict[str, float] = field(default_factory=dict)
    options: SolverOptions = STANDARD

    def case(self, name: str, across: int) -> Row:
        """The key columns of a case simulated in this way."""
        kind, *sizes = self.mesh
        return {"case": name, "family": self.family, "mesh": f"{kind} {' '.join(map(str, sizes))}", "reference": across}


def mesh_of(mesh: tuple[Any, ...], scene: Scene) -> PadMesh:
    """The mesh of a case.

    Args:
        mesh: ("graded", elements across the contact, perhaps elements through the thickness) as scenes have it;
            ("wide", across, through) with more elements beside the contact, too; ("fTetWild", edge in the contact's
            zone, edge far from it, mm); ("uniform", x, y, z) equal cells.
        scene: the case.
    """
    gel = scene.sensor.gel
    zone = footprint(path_of(scene), PAD_MM, MARGIN)
    kind, *sizes = mesh
    if kind == "graded":
        return graded_mesh(gel, zone, *sizes)[0]
    if kind == "wide":
        return graded_box(PAD_MM, zone, Counts((sizes[0], sizes[0]), (4, 3), sizes[1], growth=1.5))
    if kind == "fTetWild":
        return tetrahedralise_box(PAD_MM, sizes[0], around_focus(PAD_MM, sizes[0], zone, sizes[1]))
    whole = Focus((0.0, 0.0), (PAD_MM[0] / 2, PAD_MM[1] / 2))
    return graded_box(PAD_MM, whole, Counts((sizes[0] - 2, sizes[1] - 2), (1, 1), sizes[2], growth=1.0))


def press_of(scene: Scene, mesh: PadMesh, setting: Setting) -> DirectPress:
    """A case at the start of its path, with elements and contact points that scenes do not offer, too."""
    numerics = scene.numerics.model_copy(update=setting.numerics)
    space = function_space(mesh, ELEMENTS[setting.element](setting.contact_split))
    gel, options = scene.sensor.gel, setting.options
    system = System(space, pad_material(gel, mesh), options)
    path = path_of(scene, None, mesh.spacing_mm / (2 * space.element.order))
    steps = LoadSteps(path, mesh.size_mm, scene.contact.friction > 0, numerics, options)
    return DirectPress(system, path, scene.contact.friction, gel.youngs_modulus_kpa / 1000, steps)


def forces(trajectory: Trajectory, states: list[int]) -> np.ndarray:
    """(k, 3) N in some states."""
    return np.array([trajectory.states[state].force_n for state in states])


def errors(found: Trajectory, truth: Trajectory, states: list[int]) -> Row:
    """The largest errors in some states, see the module; `found` must have reached them."""
    u, r = (face_displacement(each, POINTS, states) for each in (found, truth))
    force, should = forces(found, states), forces(truth, states)
    normal = np.abs(force[:, 2] / should[:, 2] - 1)
    size = np.linalg.norm(should[:, :2], axis=1)
    counts = size > LEAST_TANGENTIAL * np.abs(should[:, 2])
    tangential = np.linalg.norm(force[:, :2] - should[:, :2], axis=1)[counts] / size[counts]
    return {
        "displacement_percent": 100 * float((root_mean_square(u - r) / root_mean_square(r)).max()),
        "displacement_px": PX_PER_MM * float(root_mean_square((u - r)[..., :2]).max()),
        "force_percent": 100 * float(max(normal.max(), tangential.max(initial=0.0))),
    }


@cache
def reference(case: str, across: int) -> Trajectory:
    """The much finer solution of a case.

    Raises:
        RuntimeError: it is no reference, since it did not reach its end or was not corrected.
    """
    setting = Setting("reference", ("wide", across, 5), options=SolverOptions(correction_iterations=MAX_ITERATIONS))
    scene = CASES[case]
    found = press_of(scene, mesh_of(setting.mesh, scene), setting).run()
    deepest = max(state.max_penetration_mm for state in found.states)
    if found.status != "complete" or deepest > LARGEST_PENETRATION_MM:
        raise RuntimeError(f"the reference of {case} is {found.status}, {deepest:.2g} mm in the ball")
    return found


@cache
def compile_kernels(element: str, contact_split: int) -> None:
    """Press once on a coarse mesh, so that compilation is not timed."""
    scene, setting = CASES["centred"], Setting("", ("graded", 2, 2), element, contact_split)
    press_of(scene, mesh_of(setting.mesh, scene), setting).run()


def press(case: Row, settings: dict[tuple[str, str], Setting]) -> Row:
    """One row of the table."""
    scene, setting = CASES[case["case"]], settings[case["family"], case["mesh"]]
    truth = reference(case["case"], case["reference"])
    mesh = mesh_of(setting.mesh, scene)
    compile_kernels(setting.element, setting.contact_split)
    found, seconds = timed(lambda: press_of(scene, mesh, setting).run())
    complete = found.status == "complete"
    return {
        "status": found.status,
        "unknowns": len(press_of(scene, mesh, setting).system.free),
        "seconds": round(seconds, 3),
        "iterations": sum(state.newton_iterations for state in found.states),
        **(errors(found, truth, COUNTED[case["case"]]) if complete else {}),
        "penetration_mm": max(state.max_penetration_mm for state in found.states),
    }


def family(name: str, element: str, *meshes: tuple[Any, ...]) -> list[Setting]:
    """Settings that differ in their mesh only."""
    return [Setting(f"{name} {element}", mesh, element) for mesh in meshes]


def settings_of(every: bool, across: int) -> dict[str, list[Setting]]:
    """The settings of each case; the plain ones come first.

    Args:
        every: all of them, else those of about two minutes.
        across: elements across the contact in the reference.
    """
    uniform = ("uniform", 20, 16, 4)
    plain = Setting("plain solver", uniform, options=PLAIN)
    check = Setting("reference mesh", ("wide", across - 4, 5))
    base = Setting("graded P2/P1", ("graded", 8))
    if not every:
        meshes = family("graded", "P2/P1", *(("graded", n) for n in (4, 6, 8)))
        meshes += family("graded", "P1/P1", *(("graded", n) for n in (6, 10)))
        return {"centred": [plain, *meshes, *family("fTetWild", "P2/P1", ("fTetWild", 1.0, 3.0)), check]}
    graded = [("graded", n) for n in (4, 6, 8, 10, 12, 14)]
    few = [("graded", n, 2) for n in (6, 8, 10)]
    wild = [("fTetWild", 1.0, 3.0), ("fTetWild", 0.75, 2.5), ("fTetWild", 0.6, 2.2)]
    centred = [*family("graded", "P2/P1", *graded), *family("graded, few layers", "P2/P1", *few)]
    centred += family("graded", "P1/P1", *graded) + family("graded", "P1", graded[2])
    centred += family("fTetWild", "P2/P1", *wild) + family("fTetWild", "P1/P1", wild[-1])
    for element in ("P2/P1", "P1/P1"):
        centred += family("uniform", element, ("uniform", 14, 10, 3), uniform)
    centred += family("uniform", "P1", uniform)
    others = family("graded", "P2/P1", *graded[:5]) + family("graded, few layers", "P2/P1", *few[:2])
    others += family("graded", "P1/P1", graded[2], graded[4]) + family("fTetWild", "P2/P1", *wild[:2])
    changed = [replace(base, family=f"steps of {step} mm", numerics={"max_step_mm": step}) for step in (0.125, 0.5)]
    changed += [replace(base, family="3 points a face", contact_split=1)]
    changed += [replace(base, family="float64", options=SolverOptions(single_precision=False))]
    changed += [replace(base, family="every tangent factorised", options=SolverOptions(reuse_factors=False))]
    stiff = [
        replace(base, family=f"penalty {value:g} E/mm", numerics={"penalty": value}) for value in (25.0, 100.0, 200.0)
    ]
    return {
        "centred": [plain, *centred, check, *changed, *stiff, replace(base, family="plain solver", options=PLAIN)],
        "off-centre": [plain, *others, check],
        "sheared": [plain, *others, check, *changed],
    }


def mark_best(rows: list[Row]) -> None:
    """Add to the rows of one case the speed-up over the plain solver, and whether no other row beats the row in both
    time and displacement error.
    """
    best = np.inf
    for row in sorted(rows, key=lambda row: (row["seconds"], row.get("displacement_percent", np.inf))):
        error = row.get("displacement_percent", np.inf)
        row["best"] = "*" if error < best else ""
        best = min(best, error)
        row["speed_up"] = round(rows[0]["seconds"] / row["seconds"], 1)


def main(argv: list[str]) -> int:
    """Run the command line; 1 if a mesh as scenes have it did not reach the end of its path."""
    parser = arguments("fem", __doc__)
    parser.add_argument("--all", action="store_true", help="all cases and settings")
    given = parser.parse_args(argv)
    across = 16 if given.all else 12
    asked = settings_of(given.all, across)
    settings = {
        (setting.family, setting.case(name, across)["mesh"]): setting for name in asked for setting in asked[name]
    }
    print(machine())
    complete = True
    every: list[Row] = []
    for name, ways in asked.items():
        cases = [setting.case(name, across) for setting in ways]
        rows = measure(given.out / "fem.csv", cases, partial(press, settings=settings))
        mark_best(rows)
        columns = ["family", "mesh", "unknowns", "seconds", "speed_up", "iterations", "displacement_percent"]
        columns += ["displacement_px", "force_percent", "penetration_mm", "best", "status"]
        show(rows, columns, f"{name}, errors against a wide mesh with {across} elements across the contact")
        complete &= all(row["status"] == "complete" for row in rows if row["family"] == "graded P2/P1")
        every += rows
    plot(given.out / "fem.png", every, "seconds", "displacement_percent", "family", "case")
    return 0 if complete else 1

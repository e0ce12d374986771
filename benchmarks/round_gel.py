"""How large is the error of the flow of a round gel at a run time, by the size of its mesh?

A ball of 4 mm radius presses the tip of allsight 0.8 mm deep and is sheared by 0.4 mm. Meshes are even, as scenes have
them, or finer around the contact; the reference is much finer there. "whole" solves for all of the gel, the others for
the vicinity of the contact. "flow_percent" is the root mean square of the exact flow's difference from the reference's
over that of the flow, "largest_px" the largest difference, over pixels of the gel; "force_percent" is the length of the
force's difference. Times are processor times of one press on a mesh that is there.
"""

from functools import cache

import numpy as np

from benchmarks.focused_mesh import SLOPE
from benchmarks.press import timed
from benchmarks.rows import Row, arguments, machine, measure, plot, show
from synth.flow.exact import exact_flow
from synth.flow.field import FlowArray
from synth.flow.view import View
from synth.mesh import PadMesh, face_of, pad_mesh
from synth.mesh.cache import CHORDS, SURFACE
from synth.mesh.capsule import CapsuleFace
from synth.mesh.graded import kuhn_tets
from synth.mesh.tetrahedralise import ROOM, Background, tetrahedralise
from synth.optics import Optics
from synth.pipeline.render_session import SUBDIVISIONS
from synth.scene import Scene
from synth.scene.template import load_scene
from synth.simulate import Trajectory
from synth.simulate.press import Press
from synth.simulate.solve import direct_press, simulate_press
from synth.surface import GelSurface

SETTINGS = (
    'contact.indenter={shape="sphere", radius_mm=4.0}', "contact.friction=0.5", "motion.depth_mm=0.8",
    "motion.shear_mm=[0.4, 0.0]", "motion.twist_deg=0.0", "motion.polar_deg=0.0", "motion.azimuth_deg=0.0",
    "motion.steps=2",
)  # fmt: skip
ZONE_MM, COARSE_MM = 6.5, 1.6
"""Distance from the tip within which a finer mesh is fine; edges far from there."""
EVEN = (2.4, 1.6, 1.2, 1.0)
FINER = (1.2, 0.85)
REFERENCE = 0.6


def mesh_of(scene: Scene, family: str, edge_mm: float) -> PadMesh:
    """An even mesh, or one with such edges around the contact and longer ones elsewhere."""
    gel = scene.sensor.gel
    if family != "finer at the contact":
        return pad_mesh(gel, scene.numerics.model_copy(update={"edge_length_mm": edge_mm}))
    face = face_of(gel)
    assert isinstance(face, CapsuleFace)
    surface, triangles = face.triangles(SURFACE * COARSE_MM / 2)
    sizes = _background(gel.size_mm, edge_mm)
    points, tets = tetrahedralise(surface, triangles, face.sides, sizes, face.volume_mm3, CHORDS)
    return PadMesh(points, tets, gel.size_mm, face=face)


def _background(size_mm: tuple[float, float, float], edge_mm: float) -> Background:
    """Edges of edge_mm near the tip, SLOPE longer per distance from there, at most COARSE_MM."""
    cells = 16
    x, y, z = (ROOM * np.linspace(-length / 2, length / 2, cells + 1) for length in size_mm)
    points = np.stack(np.meshgrid(x, y, z + size_mm[2] / 2, indexing="ij"), axis=-1).reshape(-1, 3)
    away = np.maximum(np.linalg.norm(points, axis=1) - ZONE_MM, 0)
    return Background(points, kuhn_tets(cells, cells, cells), np.minimum(edge_mm + SLOPE * away, COARSE_MM))


def flow_of(scene: Scene, found: Trajectory) -> FlowArray:
    """(height, width, 2) px: flow from rest to the last state."""
    space = found.space
    surface = GelSurface(space.surface, SUBDIVISIONS[space.surface.is_quadratic])
    pressed = surface.positions(found.states[-1].displacement[space.surface_nodes])
    view = View(surface, Optics.of(scene.sensor))
    return exact_flow(view, surface.material, pressed, backward=False).forward


def main(argv: list[str]) -> int:
    """Measure, or go on measuring."""
    parser = arguments("round_gel", __doc__)
    given = parser.parse_args(argv)
    (scene,) = load_scene("allsight", SETTINGS).corners[:1]

    def solved(family: str, edge_mm: float) -> tuple[Trajectory, float, int]:
        press = Press.of(scene, mesh_of(scene, family, edge_mm))
        found, seconds = timed(lambda: direct_press(press).run() if family == "whole" else simulate_press(press))
        assert found.status == "complete", found.reason
        return found, seconds, len(press.mesh.tets)

    @cache
    def reference() -> tuple[Trajectory, FlowArray]:
        found = solved("finer at the contact", REFERENCE)[0]
        return found, flow_of(scene, found)

    def row(case: Row) -> Row:
        found, seconds, elements = solved(case["family"], case["edge_mm"])
        true, flow = reference()
        off = np.linalg.norm(flow_of(scene, found) - flow, axis=2)
        share = np.sqrt(np.nanmean(off**2) / np.nanmean((flow**2).sum(axis=2)))
        force = np.array(true.states[-1].force_n)
        lack = np.linalg.norm(np.array(found.states[-1].force_n) - force) / np.linalg.norm(force)
        errors = {"flow_percent": 100 * float(share), "largest_px": float(np.nanmax(off))}
        return {"elements": elements, "seconds": seconds, **errors, "force_percent": 100 * float(lack)}

    settings = [*(("even", edge) for edge in EVEN), ("whole", 1.6), *(("finer at the contact", edge) for edge in FINER)]
    cases = [{"family": family, "edge_mm": edge} for family, edge in settings]
    rows = measure(given.out / "round_gel.csv", cases, row)
    print(machine())
    show(rows, list(rows[0]), "Error of a round gel's flow")
    plot(given.out / "round_gel.png", rows, x="seconds", y="flow_percent", group="family")
    return 0

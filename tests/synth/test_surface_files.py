"""Surface files: bodies that touch, every format that is read with its unit, and files that lie."""

import os
import struct
from collections.abc import Sequence
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import pyvista as pv
import trimesh
from commands import refused
from pads import complete, scene

from synth.arrays import FloatArray
from synth.mesh import Counts, Focus, graded_box
from synth.press.indenter import EVERYTHING, RigidBody, Touchable, rigid_body
from synth.press.measure import Distance
from synth.scene import Box, MeshIndenter, Sphere
from synth.scene.surface_file import FORMATS, read_surface
from synth.scene.surface_shells import is_closed, outward

Surface = tuple[FloatArray, np.ndarray]


def block(low: Sequence[float], high: Sequence[float], mirrored: bool = False) -> Surface:
    """A block's surface; mirrored, its faces are cut along their other diagonals."""
    bounds = [edge for pair in zip(low, high, strict=True) for edge in pair]
    cube = pv.Cube(bounds=bounds).triangulate().clean()
    points, faces = np.asarray(cube.points, dtype=float), cube.regular_faces
    if mirrored:
        points = points * [-1, 1, 1] + [low[0] + high[0], 0, 0]
        faces = faces[:, ::-1]
    return points, faces


PIECES = {
    "two": [block((-4, -2, -2), (0, 2, 2)), block((0, -2, -2), (4, 2, 2))],
    "other diagonals": [block((-4, -2, -2), (0, 2, 2)), block((0, -2, -2), (4, 2, 2), True)],
    "four": [block((x, -2, -3), (x + 2, 2, 3), bool(x % 4)) for x in (-4, -2, 0, 2)],
    "three in a T": [block((-4, -1, -2), (0, 1, 2)), block((0, -1, -2), (4, 1, 2)), block((-1.3, 1, -2), (1.7, 4, 2))],
    "overlap": [block((-3, -2, -2), (1, 2, 2)), block((-1, -1.5, -2.5), (3, 2.5, 2))],
    "plate with a rib": [block((-4, -4, -1), (4, 4, 0)), block((-0.7, -3, 0), (0.7, 3, 1.5))],
}


def saved(path: Path, *pieces: Surface) -> Path:
    starts = np.cumsum([0, *(len(points) for points, _ in pieces)])
    faces = np.concatenate([faces + start for (_, faces), start in zip(pieces, starts, strict=False)])
    pv.PolyData.from_regular_faces(np.concatenate([points for points, _ in pieces]), faces).save(path)
    return path


def in_one(path: Path, pieces: list[Surface]) -> Path:
    """The union of solids, by manifold3d."""
    solids = [manifold3d.Manifold(manifold3d.Mesh(p.astype(np.float32), f.astype(np.uint32))) for p, f in pieces]
    union = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).to_mesh()
    return saved(path, (np.asarray(union.vert_properties, dtype=float)[:, :3], np.asarray(union.tri_verts)))


def body_of(path: Path, touchable: Touchable = EVERYTHING, **fields: object) -> RigidBody:
    return rigid_body(MeshIndenter(shape="mesh", file=path.name, **fields), path.parent, touchable=touchable)


def distances(body: RigidBody, points: FloatArray) -> FloatArray:
    place = np.zeros((1, 3)), body.rotation[None]
    return Distance(body, *place)(points, np.zeros(len(points), dtype=np.int32))[1]


@pytest.mark.parametrize("turned", [(0.0, 0.0, 0.0), (20.0, 10.0, 30.0)])
@pytest.mark.parametrize("kind", PIECES)
def test_solids_that_touch_or_overlap_are_the_body_in_one(tmp_path: Path, kind: str, turned) -> None:
    fields = {"cell_mm": 0.12, "fillet_mm": 0.3, "rotation_deg": turned}
    files = saved(tmp_path / "pieces.stl", *PIECES[kind]), in_one(tmp_path / "one.stl", PIECES[kind])
    pieces, one = (body_of(file, **fields) for file in files)
    places = np.random.default_rng(3).uniform(-5, 5, (20_000, 3))
    found, exact = distances(pieces, places), distances(one, places)
    near = np.abs(exact) < 0.25
    # The vertices of contours are off edges by less than a tenth of the grid's spacing.
    np.testing.assert_allclose(found[near], exact[near], atol=0.012)
    # A place counts for .05 mm³; the surface moves by less than .01 mm.
    assert abs(np.sum(found < 0) - np.sum(exact < 0)) <= 5
    assert pieces.reach_mm == pytest.approx(one.reach_mm, abs=1e-3)


def test_four_slabs_press_as_their_block(tmp_path: Path) -> None:
    size = (12.0, 10.0, 3.0)
    mesh = graded_box(size, Focus((0.0, 0.0), (2.0, 2.0)), Counts((4, 4), (2, 2), 2))
    saved(tmp_path / "pieces.stl", *PIECES["four"])
    in_one(tmp_path / "one.stl", PIECES["four"])
    states = []
    for name in ("pieces.stl", "one.stl"):
        body = {"shape": "mesh", "file": name, "size_mm": 4.0}
        drawn = scene(size, indenter=body, motion={"depth_mm": 0.3}, numerics={"element": "auto"})
        states.append(complete(drawn, mesh, tmp_path).states[-1])
    pieces, one = (np.array([*state.force_n, *state.torque_nmm]) for state in states)
    assert np.linalg.norm((pieces - one)[:3]) < 0.01 * one[2]
    assert np.linalg.norm((pieces - one)[3:5]) < 0.03 * one[2]  # a tilt torque, by an arm of .03 mm


@pytest.mark.parametrize("turned", [0, 1])
def test_walls_between_chambers_are_left_out_however_they_are_oriented(turned: int) -> None:
    """Four chambers in a row with one face between two, so that three faces meet at an edge."""
    corners = np.array([(x, y, z) for x in range(5) for y, z in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=float)
    quads = [(4 * k, 4 * k + 1, 4 * k + 2, 4 * k + 3) for k in range(5)]
    quads += [
        (4 * k + i, 4 * k + (i + 1) % 4, 4 * k + 4 + (i + 1) % 4, 4 * k + 4 + i) for k in range(4) for i in range(4)
    ]
    faces = np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])
    faces[turned::2] = faces[turned::2, ::-1]
    found = outward(corners, faces)
    assert len(found) == 2 * (2 + 16)
    assert is_closed(found)
    assert np.linalg.det(corners[found]).sum() / 6 == pytest.approx(4.0)


BALL = """ISO-10303-21;
HEADER;
FILE_DESCRIPTION((''),'2;1');
FILE_NAME('','',(''),(''),'','','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));
ENDSEC;
DATA;
#1=APPLICATION_CONTEXT('');
#2=PRODUCT_CONTEXT('',#1,'mechanical');
#3=PRODUCT('ball','ball','',(#2));
#4=PRODUCT_DEFINITION_FORMATION('','',#3);
#5=PRODUCT_DEFINITION_CONTEXT('part definition',#1,'design');
#6=PRODUCT_DEFINITION('design','',#4,#5);
#7=PRODUCT_DEFINITION_SHAPE('','',#6);
#8=SHAPE_DEFINITION_REPRESENTATION(#7,#9);
#9=ADVANCED_BREP_SHAPE_REPRESENTATION('',(#10,#20),#11);
#10=AXIS2_PLACEMENT_3D('',#12,#13,#14);
#11=(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNIT_ASSIGNED_CONTEXT((#15,#16,#17))REPRESENTATION_CONTEXT('',''));
#12=CARTESIAN_POINT('',(0.,0.,0.));
#13=DIRECTION('',(0.,0.,1.));
#14=DIRECTION('',(1.,0.,0.));
#15=(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.CENTI.,.METRE.));
#16=(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.));
#17=(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT());
#20=MANIFOLD_SOLID_BREP('',#21);
#21=CLOSED_SHELL('',(#22));
#22=ADVANCED_FACE('',(#23),#26,.T.);
#23=FACE_BOUND('',#24,.T.);
#24=VERTEX_LOOP('',#25);
#25=VERTEX_POINT('',#27);
#26=SPHERICAL_SURFACE('',#10,.4);
#27=CARTESIAN_POINT('',(0.,0.,-.4));
ENDSEC;
END-ISO-10303-21;
"""


@pytest.mark.parametrize(("ending", "unit_mm"), [("glb", 1000), ("dae", 1000), ("3mf", 1), ("vtp", 1), ("stl", 1)])
def test_formats_and_their_units(tmp_path: Path, ending: str, unit_mm: int) -> None:
    """3MF files are in mm here, as 3MF says; an STL in letters has no unit, and is taken to be in mm."""
    path, solid = tmp_path / f"block.{ending}", trimesh.creation.box((8, 4, 3))
    if ending == "vtp":
        saved(path, (solid.vertices, solid.faces))
    else:
        solid.apply_scale(1 / unit_mm)
        solid.export(path, **({"file_type": "stl_ascii"} if ending == "stl" else {}))
    np.testing.assert_allclose(np.ptp(read_surface(path).points, axis=0), (8, 4, 3), rtol=1e-6)


def test_step_files_are_read_in_their_unit(tmp_path: Path) -> None:
    pytest.importorskip("cascadio")
    (tmp_path / "ball.step").write_text(BALL)
    ball = read_surface(tmp_path / "ball.step")
    assert ball.closed
    # The surface is at most .01 mm inside of the ball: 3 * .01 / 4 of its volume.
    assert np.linalg.det(ball.points[ball.faces]).sum() / 6 == pytest.approx(4 / 3 * np.pi * 4**3, rel=0.0075)


def test_other_formats_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "part.iges").write_text("")
    said = refused("part.iges", body_of, tmp_path / "part.iges")
    assert all(ending in said for ending in FORMATS)


def ply(vertices: int, faces: int, form: str = "ascii") -> bytes:
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    return (
        f"ply\nformat {form} 1.0\nelement vertex {vertices}\n{properties}element face {faces}\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 77777777\n"
    ).encode()


def stl(count: int, *corners: float) -> bytes:
    return bytes(80) + struct.pack("<I12fH", count, 0, 0, 0, *corners, 0)


TRIANGLE = (0, 0, 0, 1, 0, 0, 0, 1, 0)
LIES = {
    "index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999\n",
    "index.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 88888888\n",
    "index.ply": ply(3, 1),
    "negative.ply": ply(-5, -5),
    "promise.ply": ply(3, 10**12),
    "promise_binary.ply": ply(10**9, 1, "binary_little_endian"),
    "promise.stl": stl(10**9, *TRIANGLE),
    "nan.stl": stl(1, *TRIANGLE[:-1], float("nan")),
    "flat.stl": stl(1, *TRIANGLE[:3] * 3),
    "nothing.glb": b"glTF" + struct.pack("<II", 2, 2**32 - 1),
    "nothing.3mf": b"PK\3\4",
}


@pytest.mark.parametrize("name", LIES)
def test_a_file_that_lies_gets_one_message(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(LIES[name])
    assert len(refused(name, body_of, tmp_path / name).splitlines()) == 1


def test_what_is_no_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.stl")
    refused("there is no file", body_of, tmp_path / "pipe.stl")


TURNED = (90.0, 0.0, 30.0)


def test_a_point_of_an_analytic_body_comes_to_the_place() -> None:
    """As if the body had been moved sideways by as much, in the axes of the gel."""
    offset, places = np.array([0.7, -0.4, 1.1]), np.random.default_rng(5).uniform(-3, 3, (500, 3))
    for kind, fields in ((Box, {"size_mm": (3.0, 2.0, 4.0)}), (Sphere, {"radius_mm": 2.0})):
        plain = {"shape": kind.__name__.lower(), "rotation_deg": TURNED, **fields}
        middle, moved = rigid_body(kind(**plain)), rigid_body(kind(**plain, offset_mm=tuple(offset)))
        aside = middle.rotation @ offset * [1, 1, 0]
        np.testing.assert_allclose(distances(moved, places), distances(middle, places + aside), atol=1e-12)
        assert moved.reach_mm == middle.reach_mm


def test_a_point_of_a_mesh_comes_to_the_place(tmp_path: Path) -> None:
    """Of a plate with two pegs, which is 8 mm wide; files have y up, the gel's frame has it down."""
    plate = block((10, 20, 0), (18, 26, 1))
    pegs = block((11, 21, 0.5), (12, 22, 2.5)), block((16, 24, 0.5), (17, 25, 3))
    path = saved(tmp_path / "plate.stl", plate, *pegs)
    for offset, within in (
        (None, (2.5, -1.5)),
        ("lowest", (0.0, 0.0)),
        ((2.5, 1.5, 0.0), (0.0, 0.0)),
        ((-2.5, -1.5, 0.0), (5.0, -3.0)),
        ("origin", (16.5, -24.5)),
    ):
        body = body_of(path, offset_mm=offset, cell_mm=0.15)
        places = np.array([[x, y, body.reach_mm - 0.3] for x, y in (within, np.add(within, (1.0, 0.0)))])
        inside, beside = distances(body, places)
        assert inside < 0 < beside
    round_gel = Touchable(at_tip=True)
    for offset, within in ((None, (0.0, 0.0)), ((0.0, 0.0, 0.0), (2.5, -1.5))):
        body = body_of(path, round_gel, offset_mm=offset, cell_mm=0.15)
        assert distances(body, np.array([[*within, body.reach_mm - 0.3]]))[0] < 0

"""Poses from outside: as a press of the same motion, by symmetry, with objects, and what is refused."""

import io
import math
import re
from base64 import b64decode
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refused, said
from pads import brick, capsule, capsule_mesh, complete, scene
from PIL import Image
from scipy.spatial.transform import Rotation
from tiny_scene import write_tiny

from synth.cli import main
from synth.dataset.export import export
from synth.dataset.reader import read_dataset
from synth.mesh import PadMesh, domed
from synth.mesh.face import face_height
from synth.pipeline.generate import generate
from synth.planning import plan, predict
from synth.press.measure import Distance
from synth.press.scene_path import path_of
from synth.render.variant import Variant
from synth.sampling import draw
from synth.scene import Scene
from synth.scene.pose_file import HEADER
from synth.scene.template import load_scene
from synth.simulate import Trajectory, simulate
from synth.verify import verify_dataset

pytestmark = pytest.mark.usefixtures("one_cache")
MESH = brick(counts=(6, 4, 3))
BAR = {"shape": "cylinder", "radius_mm": 2.0, "length_mm": 3.0, "rotation_deg": [90.0, 0.0, 0.0]}
BOX = {"shape": "box", "size_mm": [2.4, 2.0, 2.0], "fillet_mm": 0.3}
BALL = {"shape": "sphere", "radius_mm": 3.0}


def row(time: float, place: tuple[float, float, float], turn: Rotation | None = None) -> tuple[float, ...]:
    return (time, *map(float, place), *map(float, (turn or Rotation.identity()).as_quat()))


def about(axis: str, degrees: float) -> Rotation:
    return Rotation.from_euler(axis, degrees, degrees=True)


def posed(rows: list[tuple[float, ...]], mesh: PadMesh = MESH, **parts: Any) -> Trajectory:
    drawn = scene(**parts, motion={"depth_mm": 0.0})
    content = drawn.model_dump()
    content["motion"] = {"poses": rows, "steps": len(rows) - 1}
    return complete(type(drawn).model_validate(content), mesh)


@pytest.mark.parametrize(("indenter", "dome"), [
    (BALL, None), ({**BOX, "rotation_deg": [10.0, 5.0, 0.0]}, None), (BALL, 12.0),
], ids=["ball", "tilted box", "ball on a dome"])  # fmt: skip
def test_the_same_press_by_motion_and_by_poses_gives_the_same_states(
    indenter: dict[str, Any], dome: float | None
) -> None:
    """Press, shear with twist, and release."""
    motion: dict[str, Any] = {"depth_mm": 0.5, "shear_mm": [0.4, -0.2], "twist_deg": 8.0, "steps": 5}
    motion["position_mm"] = [0.1, 0.2]
    motion["then"] = [{"depth_mm": 0.2, "shear_mm": [0.4, -0.2], "twist_deg": 8.0}]
    # Both are solved to this share of the nodal forces, which leaves less than 1e-6 of the displacement.
    parts = {
        "indenter": indenter,
        "friction": 0.4,
        "numerics": {"tolerance": 1e-11},
        "gel": {"shape": "dome", "dome_radius_mm": dome} if dome else {},
    }
    mesh = domed(MESH, dome)
    by_motion = complete(scene(**parts, motion=motion), mesh)
    path = path_of(scene(**parts, motion=motion))
    lengths = [0.0, *path.records().tolist()]
    body = Rotation.from_matrix(path.body.rotation)
    poses = [path.pose(s) for s in lengths]
    rows = [
        row(number, tuple(pose.centre), Rotation.from_matrix(pose.rotation) * body.inv())
        for number, pose in enumerate(poses)
    ]
    by_poses = posed(rows, mesh, **parts)
    assert len(by_poses.states) == len(by_motion.states) == 6
    above = face_height(np.array([motion["position_mm"]]), dome).item()  # a press's depth begins there, a pose's at 0
    for one, two in zip(by_motion.states, by_poses.states, strict=True):
        largest = np.abs(by_motion.states[-2].displacement).max()
        np.testing.assert_allclose(two.displacement, one.displacement, rtol=0, atol=1e-6 * largest)
        assert two.depth_mm == pytest.approx(one.depth_mm + above, abs=1e-9)
        assert two.shear_mm == pytest.approx(one.shear_mm, abs=1e-9)
        assert two.twist_deg == pytest.approx(one.twist_deg, abs=1e-9)
    assert by_poses.states[3].force_n[2] > 0.1


def test_an_offset_names_the_point_that_poses_are_of() -> None:
    """Of a tilted box: the pose of its own centre is that of the point less what lies between."""
    point, turn = np.array([0.3, -0.2, 0.5]), about("y", 12.0)
    content = scene(indenter={**BOX, "offset_mm": point}).model_dump()
    rows = [row(0, (0, 0, -2.0), turn), row(1, (0.1, 0, -1.0), turn)]
    content["motion"] = {"poses": rows, "steps": 1}
    moved = [(*one[:1], *(np.array(one[1:4]) - turn.apply(point)), *one[4:]) for one in rows]
    own = {**content, "contact": scene(indenter=BOX).model_dump()["contact"], "motion": {"poses": moved, "steps": 1}}
    one, two = (path_of(Scene.model_validate(given)) for given in (content, own))
    places = np.random.default_rng(0).uniform(-2, 2, (50, 3))
    for s in (0.0, one.length_mm):
        distances = [
            Distance(path.body, path.pose(s).centre[None], path.pose(s).rotation[None])(places, np.zeros(50, int))[1]
            for path in (one, two)
        ]
        np.testing.assert_allclose(distances[0], distances[1], atol=1e-12)
        assert one.pose(s).depth_mm == pytest.approx(two.pose(s).depth_mm, abs=1e-12)


def mirrored(field: np.ndarray) -> np.ndarray:
    """A field of the brick, which is its own mirror image in x = 0, in that mirror."""
    points = MESH.points
    order = np.lexsort(points.T.round(6))
    there = np.lexsort((points * [-1, 1, 1]).T.round(6))
    image = np.empty_like(field)
    image[order] = field[there] * [-1, 1, 1]
    return image


def test_a_cylinder_that_rolls_to_either_side_gives_mirror_images_and_pulls_little() -> None:
    """It rolls without sliding: what it carries along is of the gel's own making, far below friction's limit."""

    def rolled(sign: int) -> Trajectory:
        rows = [row(0, (0, 0, -2.0)), row(1, (0, 0, -1.5))]
        for number, x in enumerate((0.3, 0.6, 0.9), 2):  # a wheel at z < 0 that rolls toward +x turns x toward -z
            rows.append(row(number, (sign * x, 0, -1.5), about("y", -sign * math.degrees(x / 2.0))))
        return posed(rows, indenter=BAR, friction=0.5, numerics={"tolerance": 1e-9})

    right, left = rolled(1), rolled(-1)
    largest = np.abs(right.states[-1].displacement).max()
    for one, two in zip(right.states, left.states, strict=True):
        # Rounding and the tolerance: equilibria to 1e-9 of the forces.
        np.testing.assert_allclose(mirrored(two.displacement), one.displacement, rtol=0, atol=1e-6 * largest)
    force = np.array(right.states[-1].force_n)
    assert force[2] > 0.1
    slid = posed(
        [row(0, (0, 0, -2.0)), row(1, (0, 0, -1.5)), row(2, (0.9, 0, -1.5))], indenter=BAR, friction=0.5
    ).states[-1]
    assert slid.slip_ratio > 0.5
    assert abs(force[0]) / force[2] < 0.5 * slid.force_n[0] / slid.force_n[2]


def test_boxes_tilted_to_either_side_give_mirror_images() -> None:
    def tilted(sign: int) -> Trajectory:
        rows = [row(0, (0, 0, -1.6)), row(1, (0, 0, -1.0)), row(2, (0, 0, -0.7), about("y", 12.0 * sign))]
        return posed(rows, indenter=BOX, friction=0.3, numerics={"tolerance": 1e-9})

    one, two = tilted(1).states[-1], tilted(-1).states[-1]
    largest = np.abs(one.displacement).max()
    np.testing.assert_allclose(mirrored(two.displacement), one.displacement, rtol=0, atol=1e-6 * largest)
    assert np.array(two.torque_nmm) == pytest.approx(np.array(one.torque_nmm) * [1, -1, -1], abs=1e-6)
    assert abs(one.torque_nmm[1]) > 0.05


HEAD = ",".join(HEADER) + "\n"
REST = "0,0,0,-4,0,0,0,1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x,y,z,qx,qy,qz,qw\n" + REST, r"line 1: the header is 't,x,y,z.*allowed is time_s,x_mm"),
        ("", "line 1: the header is .*allowed is time_s"),
        (HEAD + REST + "1,0,0,nan,0,0,0,1\n", "line 3: a pose has 8 finite numbers"),
        (HEAD + REST + "1,0,0,-3,0,0,1\n", "line 3: a pose has 8 finite numbers"),
        (HEAD + REST + "1,0,0,abc,0,0,0,1\n", "line 3: a pose has 8 finite numbers"),
        (HEAD + REST + "\n1,0,0,-3,0,0,0,1\n", "line 3: a pose has"),
        (HEAD + REST + "1,0,0,-3,0,0,0,1\n1,0,0,-2,0,0,0,1\n", "line 4: time_s = 1 does not come after 1"),
        (HEAD + REST + "1,0,0,-3,0,0,0,0.5\n", "line 3: the quaternion .* has length 0.5"),
        (HEAD + REST + "1,0,0,-3000,0,0,0,1\n", "line 3: the place .* is farther than 1000 mm off"),
        (HEAD + REST, "line 3: 1 poses; allowed are 2 to 1001"),
        (HEAD + "0,0,0,-3.5,0,0,0,1\n1,0,0,-3,0,0,0,1\n", "line 2: the object is in the gel in its first pose"),
        (
            HEAD + REST + "1,0,0,-3.5,0,0,0,1\n2,0,0,-0.9,0,0,0,1\n",
            r"line 4: the object is at least 2\.12 mm.* deep in the gel",
        ),
    ],
)
def test_what_is_no_path_is_refused_with_its_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "grasp.csv").write_text(text)
    path = write_tiny(tmp_path)
    ball = 'contact.indenter={ shape = "sphere", radius_mm = 4.0 }'
    overrides = [ball, f'motion={{ poses = "{tmp_path}/grasp.csv" }}']
    refused(message, lambda: plan(load_scene(path, overrides)))


def test_one_of_several_files_is_drawn(tmp_path: Path) -> None:
    for name, depth in (("a", 0.3), ("b", 0.4), ("c", 0.5)):
        lines = [REST, *(f"{k},0,0,{k * depth / 2 - 4},0,0,0,1\n" for k in range(1, 3 if name == "a" else 4))]
        (tmp_path / f"{name}.csv").write_text(HEAD + "".join(lines))
    template = load_scene(write_tiny(tmp_path), [f'motion={{ poses = "{tmp_path}/*.csv" }}'])
    drawn = [draw(template, 0, number).motion for number in range(12)]
    assert {(motion.steps, motion.poses[1][3]) for motion in drawn} == {(2, -3.85), (3, -3.8), (3, -3.75)}


def test_on_a_round_gel_a_press_by_poses_is_that_by_motion_and_must_not_begin_within() -> None:
    def at(*heights: float) -> Trajectory:
        content = {**capsule().model_dump(), "motion": {"poses": [row(k, (0, 0, z)) for k, z in enumerate(heights)]}}
        content["motion"]["steps"] = len(heights) - 1
        drawn = Scene.model_validate(content)
        return simulate(drawn, capsule_mesh(drawn.sensor.gel))

    by_motion = capsule(motion={"depth_mm": 0.3, "steps": 2})
    expected = simulate(by_motion, capsule_mesh(by_motion.sensor.gel)).states[-1]
    # Both leave penetrations of at most .2 % of what they are measured by, .3 mm and .2 mm: .6 um of 300.
    np.testing.assert_allclose(at(-2.0, -1.85, -1.7).states[-1].displacement, expected.displacement, atol=6e-4)
    assert expected.force_n[2] > 0.05
    within = at(-1.9, -1.7)
    assert within.status == "failed"
    assert "in its first pose" in within.reason


def test_poses_stand_alone_and_are_simulated_one_by_one(tmp_path: Path) -> None:
    (tmp_path / "grasp.csv").write_text(HEAD + REST + "1,0,0,-3.7,0,0,0,1\n")  # two states: one pair
    path, poses = write_tiny(tmp_path), f'"{tmp_path}/grasp.csv"'
    refused(r"^motion\.poses: .*nofile\.csv: cannot be read", load_scene, path, ['motion={ poses = "nofile.csv" }'])
    refused("leave out depth_mm", lambda: load_scene(path, [f"motion.poses={poses}"]))
    refused("steps = 7: 2 poses have 1", lambda: load_scene(path, [f"motion={{ poses = {poses}, steps = 7 }}"]))
    refused("motion: depth_mm is missing; give it, or poses", lambda: load_scene(path, ["motion={ steps = 2 }"]))
    given = [f"motion={{ poses = {poses} }}", "sampling.pairs_per_trajectory=1"]
    assert not plan(load_scene(path, given), Variant("cuda_ad_rgb", "a test")).is_batched
    batched = 'numerics={ solver = "batched" }'
    refused("it takes no motion.poses", lambda: plan(load_scene(path, [*given, batched])))


GRASP = """time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw
0,0,0,-3.5,0,0,0,1
0.5,0,0,-2.75,0,0,0,1
0.6,0.3,0,-2.7,0,0,0,1
0.7,0.3,0,-2.7,0,0,0,1
0.8,0.3,0.1,-2.7,0.0,0.06976,0,0.99756
0.9,0.3,0.1,-2.75,0.06976,0.06976,0.03,0.9947
1.5,0.2,0,-5.5,0,0,0,1
2.0,-0.5,0,-2.7,0,0,0,1
"""


def test_a_grasp_of_an_object_rolled_lifted_and_taken_again_is_a_clip(tmp_path: Path, capsys) -> None:
    """The object's frame is its file's, whose origin is 1 mm above its middle; the file is no longer needed then."""
    pyvista = pytest.importorskip("pyvista")
    block = pyvista.ParametricSuperEllipsoid(xradius=2.0, yradius=1.5, zradius=2.0, n1=0.5, n2=0.5)
    block = block.triangulate()
    block.points += [0.0, 0.0, 1.0]
    block.save(tmp_path / "block.stl")
    log = tmp_path / "grasp.csv"
    log.write_text(GRASP)
    text = write_tiny(tmp_path).read_text()
    start, end = text.index("[contact]"), text.index("[sampling]")
    contact = '[contact]\nindenter = { shape = "mesh", file = "block.stl" }\nfriction = 0.5\n'
    scene_file = write_tiny(tmp_path, text[:start] + contact + '[motion]\nposes = "grasp.csv"\n' + text[end:])
    template = load_scene(scene_file, ['sampling.kind="clips"', "outputs.slip=true"])
    assert predict(plan(template)).seconds_per_pair["simulate"] > 0
    generate(template, 1, tmp_path / "d")
    log.unlink()
    (clip,) = read_dataset(tmp_path / "d")
    assert verify_dataset(tmp_path / "d").ok
    given = np.array([[float(cell) for cell in line.split(",")] for line in GRASP.splitlines()[1:]])
    np.testing.assert_array_equal(np.column_stack([clip.states[name] for name in HEADER]), given)
    pressed = clip.states["fz_n"] > 0.01
    assert pressed.tolist() == [False, *[True] * 5, False, True]
    # Two equal poses: the same equilibrium, but for some elastic slip of the penalty, of which more is taken away.
    np.testing.assert_allclose(clip.states["fz_n"][3], clip.states["fz_n"][2], rtol=0.01)
    assert abs(clip.states["ty_nmm"][4] - clip.states["ty_nmm"][3]) > 0.01
    # Lifted, the gel is at rest again, within the solver's tolerance.
    assert np.nanmax(np.abs(clip.flows[5].forward)) < 1e-3 * np.nanmax(np.abs(clip.flows[4].forward))
    said(capsys, main, "inspect", tmp_path / "d", "--html", tmp_path / "page.html")
    (film,) = re.findall(r"data:image/webp;base64,([^\"]+)", (tmp_path / "page.html").read_text())
    played = Image.open(io.BytesIO(b64decode(film)))
    played.load()
    # Whole milliseconds: 8 frames that begin within 2 s.
    assert played.info["duration"] == pytest.approx(2000 / 7, abs=1)
    h5py = pytest.importorskip("h5py")
    export(tmp_path / "d", "hdf5", tmp_path / "o")
    with h5py.File(tmp_path / "o" / "dataset.hdf5") as whole:
        np.testing.assert_array_equal(whole["data/demo_0/actions"][:-1], given[1:, 1:])

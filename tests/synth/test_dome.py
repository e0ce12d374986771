"""Domed gels: schema, mesh, face, load path, footprint and presses against closed forms; a scene as a whole."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bonded_layer import ball
from commands import refused
from kinematic_double import pixel_centres
from kinematic_double import sensor as flat_sensor
from pads import area_vectors, brick, complete, contact_faces, scene, simulate_scenes
from pydantic import ValidationError
from render_scenes import needs_llvm
from scipy.integrate import dblquad

from synth.arrays import FloatArray
from synth.dataset.reader import read_dataset
from synth.errors import InputError
from synth.flow.trace import trace
from synth.mesh import Counts, Focus, PadMesh, domed, graded_box, rest_surface
from synth.mesh.cache import pad_mesh
from synth.mesh.element import p2p1
from synth.optics import Optics
from synth.pipeline.generate import generate
from synth.press.footprint import footprint
from synth.press.indenter import rigid_body
from synth.press.load_path import LoadPath
from synth.press.resolution import graded_mesh
from synth.scene import Box, BoxGel, DomeGel, Gel, Indenter, Motion, Numerics, PlaneWindow, Scene, Sphere, Torus
from synth.scene.template import load_scene
from synth.simulate import Trajectory, simulate
from synth.simulate.space import function_space
from synth.surface import GelSurface
from synth.verify import verify_dataset

SIZE, RADIUS = (16.0, 12.0, 8.0), 13.0
BALL = Sphere(shape="sphere", radius_mm=3.0)
PLATE = Box(shape="box", size_mm=(60.0, 60.0, 20.0), fillet_mm=0.5)
YOUNG_MPA = 0.2


def gel(radius: float | None = RADIUS, size: tuple[float, float, float] = SIZE, **more: object) -> Gel:
    content = {"size_mm": size, "youngs_modulus_kpa": 200, **more}
    if radius is None:
        return BoxGel.model_validate(content)
    return DomeGel.model_validate({"shape": "dome", "dome_radius_mm": radius, **content})


def sphere_z(places: FloatArray) -> FloatArray:
    return RADIUS - np.sqrt(RADIUS**2 - places[:, 0] ** 2 - places[:, 1] ** 2)


def cap_volume() -> float:
    """Volume mm³ of the gel of SIZE and RADIUS: below the window, above R - √(R² - x² - y²)."""
    height = dblquad(lambda y, x: math.sqrt(RADIUS**2 - x * x - y * y), 0, SIZE[0] / 2, 0, SIZE[1] / 2)[0]
    return SIZE[0] * SIZE[1] * (SIZE[2] - RADIUS) + 4 * height


def test_mesh_fills_the_cap_at_second_order() -> None:
    """Chords of a convex face leave a little of the gel out, a quarter of it with elements half as long."""
    exact, lack = cap_volume(), []
    for cells in (2, 4, 8):
        counts = Counts((2 * cells, 2 * cells), (cells, cells), cells)
        mesh = domed(graded_box(SIZE, Focus((1.0, -0.5), (4.0, 3.0)), counts), RADIUS)
        assert mesh.volumes.min() > 0
        lack.append(exact - mesh.volumes.sum())
    # Second order: the ratio tends to 4; the next term is a relative h²/R², at most (2 / 13)² on the coarsest mesh,
    # and the graded planes are no exact halvings of one another.
    assert lack[2] > 0
    assert lack[0] / lack[1] == pytest.approx(4, rel=0.15)
    assert lack[1] / lack[2] == pytest.approx(4, rel=0.15)
    assert lack[2] < 1e-3 * exact


def test_structured_and_ftetwild_meshes_have_their_face_on_the_sphere(tmp_path: Path) -> None:
    counts = Counts((6, 4), (3, 2), 3)
    flat = graded_box(SIZE, Focus((2.0, 1.0), (2.0, 2.0)), counts, (0.5,))
    mesh = domed(flat, RADIUS)
    assert mesh.on_face.sum() == 13 * 9
    np.testing.assert_array_equal(mesh.on_face, flat.on_face)
    np.testing.assert_array_equal(mesh.bonded, flat.bonded)
    np.testing.assert_array_equal(contact_faces(mesh).faces, contact_faces(flat).faces)
    # Rounding of coordinates of some 10 mm in double precision, twice the cancellation's.
    np.testing.assert_allclose(mesh.points[mesh.on_face, 2], sphere_z(mesh.points[mesh.on_face]), atol=1e-14)
    face = sphere_z(mesh.points)
    share = (mesh.points[:, 2] - face) / (SIZE[2] - face)
    np.testing.assert_allclose(share, flat.points[:, 2] / SIZE[2], atol=1e-13)
    film = mesh.tets[mesh.layer == 0]
    assert share[film].max() == pytest.approx(0.5 / SIZE[2])
    assert mesh.hash != flat.hash
    assert domed(flat, None) is flat
    numerics = Numerics(edge_length_mm=2.0)
    mesh = pad_mesh(gel(), numerics, [tmp_path])
    again = pad_mesh(gel(), numerics, [tmp_path])
    np.testing.assert_array_equal(mesh.points, again.points)
    assert len(list(tmp_path.iterdir())) == 1  # the box is kept, for any dome
    np.testing.assert_allclose(mesh.points[mesh.on_face, 2], sphere_z(mesh.points[mesh.on_face]), atol=1e-13)
    # Chords of edges l take the mean of r_1 r_2 / 2R, about l² / 12R, off the height: here 2 % of 4.5 mm at most.
    assert mesh.volumes.sum() == pytest.approx(cap_volume(), rel=0.02)
    # A low tetrahedron around the apex: its three outer corners rise by 5² / 2R = 0.63 mm, past the inner one.
    points = np.array([[5.0, 0, 0], [-2.5, 4.33, 0], [-2.5, -4.33, 0], [0, 0, 0.05]])
    with pytest.raises(InputError, match=r"turns over.*dome_radius_mm = 20"):
        domed(PadMesh(points, np.array([[0, 1, 2, 3]], dtype=np.int32), (10.0, 10.0, 5.0)), 20.0)


@pytest.mark.parametrize(("thickness", "least"), [(4.0, (100 + 2.8**2) / 5.6), (20.0, 10 / math.sin(math.radians(60)))])
def test_a_dome_must_stay_clear_of_the_window(thickness: float, least: float) -> None:
    """At 10 mm from the apex at most 70 % of 4 mm are left out; of a thick pad the slope of 60 degrees decides."""
    size = (16.0, 12.0, thickness)
    assert gel(least * 1.001, size).dome_radius_mm == least * 1.001
    with pytest.raises(ValidationError, match=r"dome_radius_mm = .* at its corners, 10 mm .* use at least"):
        gel(least * 0.999, size)
    with pytest.raises(ValidationError, match="greater than 0"):
        gel(0.0, size)


@pytest.mark.parametrize("parts", [3, 6])
def test_rays_meet_the_undeformed_dome_where_they_meet_the_sphere(parts: int) -> None:
    """Those of a fisheye behind a window, whose corners see almost the pad's corners."""
    lens = {"lens": "fisheye", "distortion": (0.02, -0.01, 0.002, 0.0), "fx": 44.0, "fy": 44.0, "cx": 32.3, "cy": 24.1}
    flat = flat_sensor(**lens, position_mm=(0.2, -0.1, 14.0), look_at_mm=(0.0, 0.0, 0.0))
    window = PlaneWindow(refractive_index=1.41, thickness_mm=2)
    optics = Optics.of(flat.model_copy(update={"gel": gel(), "window": window}))
    mesh = domed(graded_box(SIZE, Focus((0.0, 0.0), (4.0, 3.0)), Counts((8, 8), (4, 4), 2)), RADIUS)
    surface = GelSurface(function_space(mesh, p2p1()).surface, parts)
    rays = optics.look(pixel_centres().reshape(-1, 2))
    hits = trace(surface.material, surface.triangles, rays.origins, rays.directions)
    assert (hits.triangle >= 0).all()
    arm = rays.origins - (0, 0, RADIUS)
    b = (rays.directions * arm).sum(1)
    distance = -b + np.sqrt(b**2 - (arm**2).sum(1) + RADIUS**2)
    off = np.abs(hits.distance - distance)
    # Elements have legs of 1 and 0.75 mm in x and y, and hypotenuses of up to 1.25 / 0.77 mm where the face slopes by
    # 40 degrees. A right triangle of hypotenuse l / parts lies up to (l / parts)² / 8R under the sphere; rays meet the
    # face within 11 degrees of its normal. Inside a quadratic face of width h corners are off by t h³ / (72 √3) along
    # z; the third derivative t = 3 r R² / (R² - r²)^(5/2) is 0.082 / mm² at r = 9.4 mm: 1.3e-3 mm.
    assert off.max() < (1.62 / parts) ** 2 / (8 * RADIUS) / 0.98 + 1.3e-3


def test_shape_of_the_surface_at_rest() -> None:
    """Two triangles for a flat pad as before; a dome's has its corners on the sphere and normals out of the gel."""
    assert len(rest_surface(gel(None)).triangles) == 2 * 24**2
    surface = rest_surface(gel())
    assert np.ptp(surface.material[:, :2], axis=0) == pytest.approx([16, 12])
    assert surface.material[:, :2].max(0) == pytest.approx([8, 6])
    # As above, with faces of 0.94 mm and a third derivative of 0.128 / mm² in the corners.
    np.testing.assert_allclose(surface.material[:, 2], sphere_z(surface.material), atol=8.6e-4)
    assert (area_vectors(surface.material, surface.triangles)[:, 2] < 0).all()


def path(indenter: object, position: tuple, depth: float, radius: float | None, **motion: object) -> LoadPath:
    given = {"depth_mm": depth, "position_mm": position, **motion}
    return LoadPath(Motion.model_validate(given), rigid_body(indenter), radius)


def test_depth_counts_from_the_face_and_the_path_starts_where_the_body_first_touches() -> None:
    way = path(BALL, (3.0, -4.0), 0.7, RADIUS, shear_mm=(1.0, 0.5))
    lowest = [way.pose(s).centre[2] + 3.0 for s in (way.press_mm, way.length_mm)]
    assert lowest == pytest.approx([0.7 + 13 - 12] * 2, abs=1e-12)  # 5 mm from the apex of R = 13: √(169 - 25) = 12
    assert way.pose(way.length_mm).centre[:2] == pytest.approx([4.0, -3.5])
    flat = path(BALL, (3.0, -4.0), 0.7, None)
    assert (flat.touch_mm, flat.face_mm, flat.press_mm) == (0.0, 0.0, 0.7)
    p, r = 5.0, 3.0
    s = math.sqrt(RADIUS**2 - p**2)
    # Two balls touch where their centres are R + r apart: (R + r)² = p² + (s + r - t)².
    beside = path(BALL, (3.0, -4.0), 0.7, RADIUS)
    assert beside.touch_mm == pytest.approx(s + r - math.sqrt((RADIUS + r) ** 2 - p**2), abs=2e-6)
    assert beside.touch_mm < -0.05
    assert beside.pose(0.0).depth_mm == beside.touch_mm
    assert beside.pose(beside.press_mm).depth_mm == pytest.approx(0.7)
    plate = path(PLATE, (3.0, -4.0), 0.2, RADIUS)  # A plate meets the apex, whatever its position
    assert plate.touch_mm == pytest.approx(-(RADIUS - s), abs=2e-6)
    # The circle in a ring's tube lies sqrt((R + t)² - ρ²) below the sphere's centre when the two touch.
    ring = Torus(shape="torus", radius_mm=4.0, tube_mm=1.0)
    assert path(ring, (0.0, 0.0), 1.5, RADIUS).touch_mm == pytest.approx(14 - math.sqrt(14**2 - 4**2), abs=2e-6)
    early = path(ring, (0.0, 0.0), 0.3, RADIUS)  # it would touch at 0.58 mm
    assert early.press_mm == 0
    assert early.may_touch
    assert not path(ring, (3.0, -4.0), -1.5, RADIUS).may_touch  # above the apex, which is 1 mm above that place


@pytest.mark.parametrize("depth", [0.05, 0.8])
def test_footprint_is_the_lens_that_two_spheres_share(depth: float) -> None:
    r = 3.0
    way = path(BALL, (0.0, 0.0), depth, RADIUS)
    apart = RADIUS + r - depth
    half = math.sqrt(r**2 - ((apart**2 + r**2 - RADIUS**2) / (2 * apart)) ** 2)
    found = footprint(way, SIZE, 0.0)
    # RESOLUTION: 0.2 % of the smaller width on each side.
    assert found.half_mm == pytest.approx((half, half), rel=4.1e-3)
    assert found.centre_mm == pytest.approx((0, 0), abs=4.1e-3 * half)
    box = footprint(path(BALL, (0.0, 0.0), depth, None), SIZE, 0.0)
    assert box.half_mm[0] > 1.05 * half
    plate = footprint(path(PLATE, (2.0, 0.0), depth, RADIUS), SIZE, 0.0)  # A plate cuts the dome in a circle
    level = depth + float(sphere_z(np.array([[2.0, 0.0]]))[0])
    circle = math.sqrt(2 * RADIUS * level - level**2)
    assert plate.half_mm == pytest.approx((circle, circle), rel=4.1e-3)
    assert plate.centre_mm == pytest.approx((0, 0), abs=4.1e-3 * circle)


def test_a_dome_of_a_kilometre_is_flat_and_one_with_lights_outside_refused() -> None:
    ring, motion = Torus(shape="torus", radius_mm=3.0, tube_mm=1.0), {"shear_mm": (0.5, -0.4), "twist_deg": 10.0}
    flat, dome = (footprint(path(ring, (2.0, 1.0), 0.5, radius, **motion), SIZE, -0.05) for radius in (None, 1e6))
    # The face is r² / 2R = 5e-5 mm lower at the corners, which changes the overlap as much; 0.2 % of 8 mm is known.
    assert dome.half_mm == pytest.approx(flat.half_mm, abs=0.02)
    assert dome.centre_mm == pytest.approx(flat.centre_mm, abs=0.02)
    raw = scene(SIZE, gel={"shape": "dome", "dome_radius_mm": RADIUS}).model_dump()
    assert raw["sensor"]["lights"][0]["position_mm"] == (0.0, 0.0, 0.1)
    raw["sensor"]["lights"][0]["position_mm"] = (SIZE[0] / 2, SIZE[1] / 2, 0.1)
    with pytest.raises(ValidationError, match="outside the curved gel"):
        Scene.model_validate(raw)


@needs_llvm
@pytest.mark.usefixtures("one_cache")
def test_a_dome_generates_and_verifies(tmp_path: Path) -> None:
    camera = {"width": 120, "height": 120, "fx": 75.0, "fy": 75.0, "cx": 60.0, "cy": 60.0}
    overrides = [f"sensor.camera.{name}={value}" for name, value in camera.items()]
    gel = "{shape='dome', size_mm=[25.0, 25.0, 12.0], dome_radius_mm=23.0, youngs_modulus_kpa=200.0}"
    overrides += [f"sensor.gel={gel}", "sensor.window={thickness_mm=2.0}", "sensor.camera.position_mm=[0.0, 0.0, 18.5]"]
    overrides += ["render.samples_per_pixel=16", "numerics.target_error_px=2.0", "sensor.pattern.placing=z"]
    overrides += ["contact.indenter={shape='sphere', radius_mm=5.0}", "sensor.pattern.grain_mm=1.2"]
    overrides += ["motion={depth_mm=1.2, position_mm=[2.0, -1.5], shear_mm=[0.5, -0.4], steps=2}"]
    overrides += ["sampling.pairs_per_trajectory=1"]
    generate(load_scene("densetact", overrides), 1, tmp_path / "out")
    report = verify_dataset(tmp_path / "out")
    checks = {check.name: check for check in report.samples[0].checks}
    assert report.ok, [check for check in checks.values() if not check.passed]
    assert max(checks[f"{way} flow"].figure for way in ("forward", "backward")) < 1e-3
    assert checks["image 2 warped to image 1"].figure is not None
    data = read_dataset(tmp_path / "out").read(0)
    assert np.nanmax(np.abs(data.flow.forward)) > 1
    off = np.linalg.norm(data.surface.material - (0.0, 0.0, 23.0), axis=1) - 23.0
    # Corners inside quadratic faces as wide as 6 mm: t h³ / (72 √3) with a third derivative t of 0.02 / mm².
    assert np.abs(off).max() < 0.04


def posed(radius: float | None, size: tuple, indenter: Indenter, friction: float = 0, **motion: Any) -> Scene:
    face = gel(radius, size, youngs_modulus_kpa=1e3 * YOUNG_MPA, poisson_ratio=0.5).model_dump()
    numerics = {"element": "auto", "edge_length_mm": None}
    return scene(size, gel=face, indenter=indenter.model_dump(), friction=friction, motion=motion, numerics=numerics)


def pressed(drawn: Scene, focus: Focus, across: int) -> Trajectory:
    return complete(drawn, graded_mesh(drawn.sensor.gel, focus, across)[0])


def test_a_dome_of_a_kilometre_is_a_flat_pad_but_mesh_and_scene_must_be_of_one() -> None:
    motion, focus = {"position_mm": (0.8, -0.5), "depth_mm": 0.5, "steps": 1}, Focus((0.8, -0.5), (1.0, 1.0))
    drawn = (posed(radius, (10.0, 8.0, 4.0), BALL, **motion) for radius in (None, 1e6))
    flat, dome = (pressed(one, focus, 4).states[-1] for one in drawn)
    # Two balls have the curvature 1/r + 1/R: by Hertz's law the force changes by r / 2R = 1.5e-6; the face at the
    # corners lies 41 mm² / 2R = 2e-5 mm, 5e-6 of the thickness, lower, and a layer's force answers the thickness with
    # an exponent of 2 at most; the place is on a slope of x / R = 1e-6. Newton leaves 1e-6 of the force.
    np.testing.assert_allclose(dome.force_n, flat.force_n, atol=2e-5 * flat.force_n[2])
    # The face itself moved by 2e-5 mm at most; displacements of up to 0.5 mm differ by less than that.
    np.testing.assert_allclose(dome.displacement, flat.displacement, atol=2e-5)
    assert np.abs(flat.displacement).max() > 0.4
    flat, dome = (posed(radius, (10.0, 8.0, 4.0), BALL, depth_mm=0.1) for radius in (None, 20.0))
    mesh = graded_mesh(flat.sensor.gel, Focus((0.0, 0.0), (1.0, 1.0)), 4)[0]
    refused(r"the mesh is of a \([^)]*\) mm pad, the scene's .* of dome radius 20", simulate, dome, mesh)


def test_a_plate_on_a_dome_follows_hertz_and_the_layer() -> None:
    """The linear problem knows only the gap r²/2R between the two: a plate on a dome is a ball on a layer."""
    radius, size = 24.0, (24.0, 24.0, 12.0)
    depths, forces = [0.04, 0.08], []
    contact, _ = ball(depths[-1], radius, size[2])
    for shape, bulge in ((PLATE, radius), (Sphere(shape="sphere", radius_mm=radius), None)):
        drawn = posed(bulge, size, shape, depth_mm=depths[-1], steps=2)
        states = pressed(drawn, Focus((0.0, 0.0), (1.1 * contact, 1.1 * contact)), 4).states[1:]
        assert [state.depth_mm for state in states] == pytest.approx(depths)
        forces.append([state.force_n[2] / YOUNG_MPA for state in states])
    plate, on_flat = np.array(forces)
    theory = np.array([ball(depth, radius, size[2])[1] for depth in depths])
    hertz = 4 / 3 / 0.75 * np.sqrt(radius) * np.array(depths) ** 1.5
    # Elements of a quarter of the contact's width make it up to 2 % stiffer (test_verify_solver_bonded_layer); sides
    # that are free 12 mm away make it softer by up to a third of what the layer adds to Hertz, 12 %.
    np.testing.assert_allclose(plate / theory, 1.0, atol=0.04)
    assert ((plate / hertz > 1) & (plate / hertz < 1.17)).all()
    # Hertz's exponent is 1.5; the layer's is 1.54 here. The mesh is finer for the larger contact: 1.5 % over ln 2.
    assert np.log(plate[1] / plate[0]) / np.log(2) == pytest.approx(1.54, abs=0.04)
    # The same mesh, but for slopes of a/R = 0.06 and a pad thinner by a²/2R, 0.4 % at the rim, 20 % in the mean: 1 %.
    np.testing.assert_allclose(plate / on_flat, 1.0, atol=0.012)


def test_pressed_beside_the_apex_the_plate_meets_the_apex() -> None:
    """A plate has no position: its force is that of the level it is at."""
    radius, size, focus = 24.0, (14.0, 14.0, 6.0), Focus((0.0, 0.0), (3.0, 3.0))
    level = 0.4
    force = []
    for x in (0.0, 4.0):
        rise = radius - np.sqrt(radius**2 - x**2)
        drawn = posed(radius, size, PLATE, position_mm=(x, 0.0), depth_mm=level - rise, steps=1)
        force.append(pressed(drawn, focus, 4).states[-1])
    # Both end at the same level of the same plate, moved along itself without friction: Newton's tolerance of 1e-6,
    # and penetration that the passes leave, below 0.002 of each depth, that is up to 0.3 % of the force.
    assert force[1].force_n[2] == pytest.approx(force[0].force_n[2], rel=5e-3)
    assert force[1].depth_mm < 0.1 < force[0].depth_mm


def test_many_at_once_press_the_dome_as_one_does() -> None:
    drawn = posed(8.0, (8.0, 6.0, 4.0), BALL, position_mm=(2.0, -1.2), depth_mm=0.3, steps=2, friction=0.4)
    drawn = drawn.model_copy(update={"numerics": Numerics(element="p1p1", tolerance=1e-9)})
    mesh = domed(brick(counts=(4, 4, 2)), 8.0)
    alone = simulate(drawn, mesh)
    (result,) = simulate_scenes([drawn], mesh)
    assert alone.status == result.status == "complete"
    assert len(alone.states) == len(result.states) == 3
    for one, other in zip(alone.states, result.states, strict=True):
        assert (one.depth_mm, one.shear_mm) == (other.depth_mm, other.shear_mm)
        # Both follow the way to 1e-3 and end at 1e-9 of the force; friction remembers the way, to some 1e-4 of it.
        np.testing.assert_allclose(one.force_n, other.force_n, atol=1e-3 * alone.states[-1].force_n[2])
    assert alone.states[-1].force_n[2] > 0.05

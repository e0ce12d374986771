"""Capsules: schema, mesh, places and face at rest; in the simulation a thick shell against its closed form.

An incompressible hemispherical shell whose inner face moves outward by a uniform amount moves radially, r³ = R³ + c;
the pressure on that face is P = 2 ∫ μ (λ² - λ⁻⁴) dr / r with λ = r / R (Green & Zerna, Theoretical Elasticity, 1968).
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from closed_forms import shear_modulus
from commands import refused
from integrals import integrals
from pads import CAPSULE, area_vectors, capsule, capsule_mesh, complete, equilibrium
from pydantic import ValidationError
from scipy.integrate import quad

from synth.arrays import FloatArray
from synth.mesh import check_mesh, mesh_key
from synth.mesh.capsule import CapsuleFace
from synth.mesh.element import p2p1
from synth.press.press import MeshRule, Press
from synth.press.scene_path import path_of
from synth.scene import CapsuleGel, Numerics, Scene
from synth.simulate import Trajectory, simulate
from synth.simulate.material import pad_material
from synth.simulate.solve import direct_press
from synth.simulate.space import function_space
from synth.simulate.system import Unknowns

RADIUS, THICKNESS, MOVED = 4.0, 1.6, 0.3
INNER = RADIUS - THICKNESS
FILM = 0.6
SHELL = {"shape": "capsule", "radius_mm": RADIUS, "thickness_mm": THICKNESS, "youngs_modulus_kpa": 100.0}
FACE = CapsuleFace(5.0, 2.0, 2.0)


def expanded(edge_mm: float, stiffness: float) -> tuple[float, float, float]:
    """Mean size of the elements, and relative errors of displacement and pressure; with an outer layer unless 1."""
    layers = [{"thickness_mm": FILM, "youngs_modulus_kpa": 100 * stiffness, "poisson_ratio": 0.5}] * (stiffness != 1)
    gel = CapsuleGel.model_validate({**SHELL, "poisson_ratio": 0.5, "layers": layers})
    mesh = capsule_mesh(gel, edge_mm)
    space = function_space(mesh, p2p1())
    cut = np.abs(space.points[:, 2] - RADIUS) < 1e-9
    held = space.held.copy()
    held[cut, 2] = True  # the plane of symmetry to the other hemisphere
    space = replace(space, held=held)
    c = (INNER + MOVED) ** 3 - INNER**3

    def radial(points: FloatArray) -> FloatArray:
        offset = points - [0.0, 0.0, RADIUS]
        r = np.linalg.norm(offset, axis=-1, keepdims=True)
        return np.asarray(((r**3 + c) ** (1 / 3) / r - 1) * offset)

    exact = radial(space.points)
    guess = Unknowns(exact, np.zeros(space.pressures))
    _, state, force = equilibrium(space, pad_material(gel, mesh), exact, guess=guess)
    rule = integrals(space)
    truth = radial(rule.positions)
    off = rule.norm(rule.values(state.u) - truth) / rule.norm(truth)

    def integrand(r: float) -> float:
        stretch = r / (r**3 - c) ** (1 / 3)
        return float(2 * shear_modulus(0.5) * (stretch**2 - stretch**-4) / r)

    ends = [(radius**3 + c) ** (1 / 3) for radius in (INNER, RADIUS - FILM, RADIUS)]
    pressure = quad(integrand, *ends[:2])[0] + stiffness * quad(integrand, *ends[1:])[0]
    offset = space.points - [0.0, 0.0, RADIUS]
    outward = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    found = (force * outward)[space.held.all(axis=1)].sum() / (2 * np.pi * (INNER + MOVED) ** 2)
    return float(np.mean(mesh.volumes)) ** (1 / 3), off, abs(found / pressure - 1)


@pytest.mark.parametrize("stiffness", [1.0, 6.0])
def test_a_thick_shell_expands_as_its_closed_form_says(stiffness: float) -> None:
    """Flat faces bound the shell's volume by O(h²); P2 displacements would be of third order on flat shapes."""
    size, displacement, pressure = np.log(np.array([expanded(edge, stiffness) for edge in (1.2, 0.9, 0.7)])).T
    rates = [np.polyfit(size, errors, 1)[0] for errors in (displacement, pressure)]
    assert np.exp([displacement[-1], pressure[-1]]) == pytest.approx(0.0, abs=0.004)
    assert 2.0 < rates[0] < 3.6  # fTetWild's meshes are random: rates of three of them scatter by some tenths
    assert 1.5 < rates[1] < 3.2


def pressed(posed: Scene) -> Trajectory:
    return complete(posed, capsule_mesh(posed.sensor.gel))


def local(posed: Scene, force: tuple[float, float, float]) -> FloatArray:
    """A force in the frame of the place: along polar angle, azimuth and inward normal."""
    frame = path_of(posed).frame
    np.testing.assert_allclose(frame.axes.T @ frame.axes, np.eye(3), atol=1e-15)
    return np.array(force) @ frame.axes


def test_a_press_does_not_depend_on_its_place() -> None:
    """A hemisphere is alike everywhere that the cut is far: force along the normal, and the same."""
    found = []
    for place in ({}, {"polar_deg": 40.0, "azimuth_deg": 70.0}, {"height_mm": 0.8, "azimuth_deg": -135.0}):
        posed = capsule(motion={"depth_mm": 0.5, "steps": 1, **place})
        found.append(local(posed, pressed(posed).states[-1].force_n))
    forces = np.array(found)
    # Some three elements across the contact: errors of a few percent, and as much lack of symmetry.
    np.testing.assert_allclose(forces[:, 2], forces[:, 2].mean(), rtol=0.05)
    assert np.abs(forces[:, :2]).max() < 0.02 * forces[:, 2].mean()
    assert found[0][2] > 0.1


def test_shear_drags_in_the_tangent_plane_and_a_held_end_is_stiffer() -> None:
    motion = {"depth_mm": 0.5, "shear_mm": (0.3, 0.0), "steps": 2, "height_mm": 5.0, "azimuth_deg": 30.0}
    posed = capsule(friction=0.8, motion=motion)
    free = local(posed, pressed(posed).states[-1].force_n)
    held = local(posed, pressed(capsule({"cut_end": "held"}, friction=0.8, motion=motion)).states[-1].force_n)
    assert free[0] > 0.1 * free[2]
    assert abs(free[1]) < 0.1 * free[0]
    assert held[2] > 1.02 * free[2]  # 2 mm from the end


def test_a_ring_touches_where_the_face_has_curved_away() -> None:
    """It first touches at a depth of R + t - √((R + t)² - r²) below its tangent plane."""
    reach = 5.7 - np.sqrt(5.7**2 - 2.0**2)
    ring = {"shape": "torus", "radius_mm": 2.0, "tube_mm": 0.7}
    states = pressed(capsule(indenter=ring, motion={"depth_mm": reach + 0.3, "steps": 2})).states
    assert states[1].depth_mm < reach + 0.1
    assert states[2].force_n[2] > 0.05


def test_a_layer_of_the_gels_own_material_changes_nothing_and_a_stiff_one_below_it_does() -> None:
    forces = []
    for moduli in ((), (200.0,), (200.0, 800.0)):
        gel = {"layers": [{"thickness_mm": 0.2, "youngs_modulus_kpa": kpa} for kpa in moduli]}
        forces.append(pressed(capsule(gel, motion={"polar_deg": 40.0})).states[-1].force_n)
    plain, own, stiff = np.linalg.norm(forces, axis=1)
    assert own == pytest.approx(plain, rel=0.05)  # errors of a few percent, see above; the layer's elements are finer
    assert stiff > 1.15 * own


def test_far_from_the_press_the_gel_is_left_out() -> None:
    """Less than 1 % of displacement and force, also under a film whose shear lag is twice the gel's thickness."""
    motion = {"depth_mm": 0.3, "shear_mm": (0.2, 0.0), "steps": 2, "polar_deg": 30.0}
    thin = {"thickness_mm": 0.8, "length_mm": 9.0, "layers": [{"thickness_mm": 0.1, "youngs_modulus_kpa": 2000.0}]}
    posed = capsule(thin, friction=0.5, motion=motion, numerics={"element": "p1p1", "edge_length_mm": 0.8})
    mesh = capsule_mesh(posed.sensor.gel, 0.8)
    near, whole = simulate(posed, mesh), direct_press(Press.of(posed, mesh)).run()
    found, true = near.states[-1], whole.states[-1]
    moved = np.linalg.norm(true.displacement, axis=1)
    np.testing.assert_allclose(found.displacement, true.displacement, atol=0.01 * moved.max())
    np.testing.assert_allclose(found.force_n, true.force_n, atol=0.01 * np.linalg.norm(true.force_n))
    np.testing.assert_allclose(found.traction, true.traction, atol=0.02 * np.abs(true.traction).max())
    still = ~found.displacement.any(axis=1)
    assert still[moved < 1e-6 * moved.max()].all()
    assert still.mean() > 0.4


@pytest.mark.parametrize(("gel", "message"), [
    ({"thickness_mm": 4.6}, r"leaves no room for a window in radius_mm = 5.0: at most 4.5"),
    ({"layers": [{"thickness_mm": 2.0, "youngs_modulus_kpa": 900.0}]}, "leave nothing of the gel's 2.0 mm"),
])  # fmt: skip
def test_impossible_capsules_are_refused(gel: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        CapsuleGel.model_validate({**CAPSULE, **gel})


def test_an_indenter_that_stays_far_away_leaves_the_gel_at_rest() -> None:
    away = capsule(motion={"depth_mm": -45.0})
    found = simulate(away, capsule_mesh(away.sensor.gel, 1.5))
    assert found.status == "complete"
    assert not any(state.displacement.any() for state in found.states)


@pytest.mark.parametrize(("motion", "message"), [
    ({"depth_mm": 1.8}, "more than 85 % of the gel's thickness"),
    ({"position_mm": (1.0, 0.0)}, "position_mm is for flat gels and domes"),
    ({"polar_deg": 10.0, "height_mm": 1.0}, "both say where the press is"),
    ({"polar_deg": 112.0}, "is beyond the gel's end; at most 111.8"),
    ({"height_mm": 7.1}, "is beyond the gel's end; at most 7"),
])  # fmt: skip
def test_impossible_places_are_refused(motion: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        capsule(motion=motion)


def test_the_mesh_fills_the_shape_and_its_nodes_lie_on_it() -> None:
    gel = capsule().sensor.gel
    mesh = capsule_mesh(gel)
    check_mesh(mesh)
    assert mesh.volumes.sum() == pytest.approx(np.pi * (2 / 3 * (5**3 - 3**3) + 2 * (5**2 - 3**2)), rel=0.03)
    space = function_space(mesh, p2p1())
    surface = space.surface
    assert surface.is_quadratic
    # Vertices and mid-edge nodes of the coated face, and the held vertices, on spheres and cylinders.
    for points, radius in ((surface.nodes, 5.0), (mesh.points[mesh.bonded], 3.0)):
        centres = np.column_stack([np.zeros((len(points), 2)), np.maximum(points[:, 2], 5.0)])
        np.testing.assert_allclose(np.linalg.norm(points - centres, axis=1), radius, rtol=1e-12)
    free = space.points[space.faces[~space.coated]]
    np.testing.assert_allclose(free[:, :, 2], 7.0, rtol=1e-12)  # nothing but the cut end
    normal = area_vectors(surface.nodes, surface.faces)
    assert (np.einsum("ij,ij->i", normal, surface.nodes[surface.faces[:, 0]] - [0.0, 0.0, 5.0]) > 0).all()
    assert np.linalg.norm(normal, axis=1).sum() == pytest.approx(2 * np.pi * 5 * 7, rel=0.03)


def test_layers_lie_at_their_depths_in_the_same_mesh() -> None:
    def with_layers(*heights: float) -> CapsuleGel:
        layers = [{"thickness_mm": height, "youngs_modulus_kpa": 900.0} for height in heights]
        return CapsuleGel.model_validate({**CAPSULE, "layers": layers})

    mesh = capsule_mesh(with_layers(0.05, 0.6))
    check_mesh(mesh)
    assert mesh.volumes.sum() == pytest.approx(capsule_mesh(with_layers()).volumes.sum(), rel=1e-12)
    for number, ends in enumerate(((4.95, 5.0), (4.35, 4.95), (3.0, 4.35))):
        nodes = mesh.points[np.unique(mesh.tets[mesh.layer == number])]
        away = np.linalg.norm(nodes - np.maximum(nodes, 5.0) * (0, 0, 1), axis=1)
        # The face's triangles are up to some 2 degrees off the sphere's tangent planes.
        assert (away.min(), away.max()) == pytest.approx(ends, abs=5e-3)
    refused("1.99 mm of layers leave no room", capsule_mesh, with_layers(1.99))


def test_a_mesh_is_named_by_its_shape_alone() -> None:
    gel, numerics = CapsuleGel.model_validate(CAPSULE), Numerics(edge_length_mm=1.5)
    key = mesh_key(gel, numerics)
    assert mesh_key(gel.model_copy(update={"youngs_modulus_kpa": 7.0}), numerics) == key
    for field, value in (("thickness_mm", 1.9), ("radius_mm", 5.1), ("length_mm", 1.0)):
        assert mesh_key(CapsuleGel.model_validate({**CAPSULE, field: value}), numerics) != key
    assert MeshRule.of(capsule()).kind == "tetwild"


def test_places_and_their_frames() -> None:
    for motion, place, inward in (
        ({}, (0, 0, 0), (0, 0, 1)),
        ({"polar_deg": 90.0}, (5, 0, 5), (-1, 0, 0)),
        ({"polar_deg": 100.0, "azimuth_deg": 90.0}, (0, 5, 5 + 5 * np.tan(np.radians(10))), (0, -1, 0)),
        ({"height_mm": 2.5}, (5 * np.sqrt(0.75), 0, 2.5), (-np.sqrt(0.75), 0, 0.5)),
        ({"height_mm": 6.0, "azimuth_deg": 180.0}, (-5, 0, 6), (1, 0, 0)),
    ):
        frame = path_of(capsule(motion=motion)).frame
        np.testing.assert_allclose(frame.origin, place, atol=1e-14)
        np.testing.assert_allclose(frame.axes[:, 2], inward, atol=1e-15)
        np.testing.assert_allclose(np.linalg.det(frame.axes), 1.0, rtol=1e-14)
        further = {**motion, "polar_deg": motion["polar_deg"] - 1} if "polar_deg" in motion else motion
        back = path_of(capsule(motion=further)).frame
        assert further is motion or (frame.origin - back.origin) @ frame.axes[:, 0] > 0  # along rising polar angle
    at_tip = path_of(capsule()).frame
    np.testing.assert_array_equal(at_tip.axes, np.eye(3))

"""Capsules: what a scene may say of them, their meshes, their places and their face at rest."""

from typing import Any

import numpy as np
import pytest
from capsules import SHAPE, capsule, capsule_mesh
from pads import area_vectors
from pydantic import ValidationError

from synth.mesh import check_mesh, face_of, mesh_key, rest_surface
from synth.mesh.capsule import CapsuleFace
from synth.scene import Gel, Numerics, Scene
from synth.simulate.element import p2p1
from synth.simulate.load_path import path_of
from synth.simulate.mesh_rule import MeshRule
from synth.simulate.space import function_space

FACE = CapsuleFace(5.0, 2.0, 2.0)


@pytest.mark.parametrize(
    ("gel", "message"),
    [
        ({"radius_mm": None}, "needs radius_mm and thickness_mm"),
        ({"thickness_mm": 4.6}, r"leaves no room for a window in radius_mm = 5.0: at most 4.5"),
        ({"size_mm": (9.0, 9.0, 7.0)}, "follows from radius_mm and length_mm: leave it out"),
        ({"layers": [{"thickness_mm": 0.1, "youngs_modulus_kpa": 900.0}]}, "a capsule is of one material"),
        ({"shape": "box", "size_mm": (9.0, 9.0, 7.0)}, 'radius_mm belongs to shape = "capsule"'),
    ],
)
def test_impossible_capsules_are_refused(gel: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Gel.model_validate({**SHAPE, **gel})


@pytest.mark.parametrize(
    ("motion", "message"),
    [
        ({"depth_mm": 1.8}, "more than 85 % of the gel's thickness"),
        ({"position_mm": (1.0, 0.0)}, "position_mm is for flat gels and domes"),
        ({"polar_deg": 10.0, "height_mm": 1.0}, "both say where the press is"),
        ({"polar_deg": 112.0}, "is beyond the gel's end; at most 111.8"),
        ({"height_mm": 7.1}, "is beyond the gel's end; at most 7"),
    ],
)
def test_impossible_places_are_refused(motion: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        capsule(motion=motion)


def test_a_written_scene_is_read_again() -> None:
    posed = capsule(motion={"polar_deg": 20.0})
    assert posed.sensor.gel.size_mm == (10.0, 10.0, 7.0)
    assert Scene.model_validate(posed.model_dump()) == posed


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


def test_a_mesh_is_named_by_its_shape_alone() -> None:
    gel, numerics = Gel.model_validate(SHAPE), Numerics(edge_length_mm=1.5)
    key = mesh_key(gel, numerics)
    assert mesh_key(gel.model_copy(update={"youngs_modulus_kpa": 7.0}), numerics) == key
    for field, value in (("thickness_mm", 1.9), ("radius_mm", 5.1), ("length_mm", 1.0)):
        assert mesh_key(Gel.model_validate({**SHAPE, field: value}), numerics) != key
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


def test_the_face_at_rest_lies_on_the_shape() -> None:
    gel = Gel.model_validate(SHAPE)
    assert face_of(gel) == FACE
    surface = rest_surface(gel)
    assert FACE.holds(surface.coarse.nodes).all()
    normal, first = area_vectors(surface.material, surface.triangles), surface.material[surface.triangles[:, 0]]
    # 24 edges along the diameter and three parts of each: chords of 0.15 mm lack some (h / R)² / 12 of the area.
    assert np.linalg.norm(normal, axis=1).sum() == pytest.approx(2 * np.pi * 5 * 7, rel=2e-3)
    centres = np.column_stack([np.zeros((len(first), 2)), np.maximum(first[:, 2], 5.0)])
    assert (np.einsum("ij,ij->i", normal, first - centres) > 0).all()

"""Poses along a path, and where states are recorded."""

import numpy as np
import pytest
from pads import scene

from synth.simulate.indenter import rigid_body, rotation_about
from synth.simulate.path import TWIST_ARM_MM, Path


def path(indenter: dict | None = None, **motion: object) -> Path:
    posed = scene(motion=motion, **({"indenter": indenter} if indenter else {}))
    return Path(posed.motion, rigid_body(posed.contact.indenter))


def test_lowest_point_follows_the_depth() -> None:
    # Fails with the reach left out.
    way = path(depth_mm=1.0, shear_mm=[0.5, -0.2], position_mm=[1.0, 2.0])
    for s in (0.0, 0.3, 1.0):
        pose = way.pose(s)
        assert pose.depth_mm == pytest.approx(s)
        np.testing.assert_allclose(pose.centre, [1.0, 2.0, s - 3.0])
    end = way.pose(way.press_mm + way.drag_mm)
    np.testing.assert_allclose(end.centre, [1.5, 1.8, 1.0 - 3.0])
    assert end.shear_mm == pytest.approx((0.5, -0.2))


def test_shear_and_twist_go_together_after_the_press() -> None:
    way = path(depth_mm=1.0, shear_mm=[0.6, 0.8], twist_deg=30.0)
    assert way.drag_mm == pytest.approx(1.0 + np.radians(30.0) * TWIST_ARM_MM)
    assert way.pose(1.0).twist_deg == 0.0
    half = way.pose(1.0 + way.drag_mm / 2)
    assert (half.depth_mm, half.twist_deg) == (1.0, pytest.approx(15.0))
    assert half.shear_mm == pytest.approx((0.3, 0.4))
    np.testing.assert_allclose(half.rotation, rotation_about(2, np.radians(15.0)), atol=1e-15)
    np.testing.assert_allclose(half.rotation @ [1, 0, 0], [np.cos(np.radians(15)), np.sin(np.radians(15)), 0])


def test_twist_turns_the_turned_body_about_the_world_axis() -> None:
    bar = {"shape": "cylinder", "radius_mm": 1.0, "length_mm": 4.0, "rotation_deg": [90.0, 0.0, 20.0]}
    way = path(bar, depth_mm=0.5, twist_deg=40.0)
    start, end = way.pose(0.0), way.pose(way.press_mm + way.drag_mm)
    np.testing.assert_allclose(end.rotation, rotation_about(2, np.radians(40.0)) @ start.rotation, atol=1e-15)
    assert start.centre[2] == end.centre[2] - 0.5 == pytest.approx(-1.0)


@pytest.mark.parametrize("motion", [
    {"depth_mm": 1.0, "steps": 1}, {"depth_mm": 1.0, "steps": 5}, {"depth_mm": 0.2, "shear_mm": [2.0, 0.0], "steps": 6},
    {"depth_mm": 1.0, "shear_mm": [0.1, 0.0], "steps": 2}, {"depth_mm": 1.0, "twist_deg": 5.0, "steps": 1},
    {"depth_mm": -1.0, "shear_mm": [1.0, 0.0], "steps": 3}, {"depth_mm": -1.0, "steps": 3}, {"depth_mm": 0.0, "steps":
    2},
])  # fmt: skip
def test_records_are_as_many_as_steps_and_end_at_the_end(motion: dict) -> None:
    way = path(**motion)
    records = way.records()
    assert len(records) == motion["steps"]
    assert (np.diff(records) >= 0).all()
    last = way.pose(float(records[-1]))
    assert last.depth_mm == motion["depth_mm"]
    assert last.shear_mm == pytest.approx(tuple(motion.get("shear_mm", (0.0, 0.0))))
    assert last.twist_deg == pytest.approx(motion.get("twist_deg", 0.0))
    assert set(records) <= set(way.waypoints())
    # No step may cut the corner between press and drag.
    assert way.press_mm == 0 or way.press_mm in way.waypoints()


def test_both_legs_get_their_share_of_records() -> None:
    way = path(depth_mm=1.0, shear_mm=[2.0, 0.0], steps=6)
    np.testing.assert_allclose(way.records(), [0.5, 1.0, 1.5, 2.0, 2.5, 3.0])

"""Poses along a path of several legs, and where states are recorded."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pads import SPHERE, scene

from synth.press.indenter import rigid_body, rotation_about
from synth.press.load_path import TWIST_ARM_MM, LoadPath, PressFrame
from synth.scene import Motion


def path(indenter: dict | None = None, **motion: Any) -> LoadPath:
    posed = scene(indenter=indenter or SPHERE)
    return LoadPath(Motion.model_validate(motion), rigid_body(posed.contact.indenter))


def test_poses_follow_the_depth_then_shear_and_twist_together() -> None:
    way = path(depth_mm=1.0, shear_mm=[0.5, -0.2], position_mm=[1.0, 2.0])
    for s in (0.0, 0.3, 1.0):
        pose = way.pose(s)
        assert pose.depth_mm == pytest.approx(s)
        np.testing.assert_allclose(pose.centre, [1.0, 2.0, s - 3.0])
    end = way.pose(way.length_mm)
    np.testing.assert_allclose(end.centre, [1.5, 1.8, 1.0 - 3.0])
    assert end.shear_mm == pytest.approx((0.5, -0.2))
    way = path(depth_mm=1.0, shear_mm=[0.6, 0.8], twist_deg=30.0)
    drag = way.length_mm - way.press_mm
    assert drag == pytest.approx(1.0 + np.radians(30.0) * TWIST_ARM_MM)
    assert way.pose(1.0).twist_deg == 0.0
    half = way.pose(1.0 + drag / 2)
    assert (half.depth_mm, half.twist_deg) == (1.0, pytest.approx(15.0))
    assert half.shear_mm == pytest.approx((0.3, 0.4))
    np.testing.assert_allclose(half.rotation, rotation_about(2, np.radians(15.0)), atol=1e-15)
    np.testing.assert_allclose(half.rotation @ [1, 0, 0], [np.cos(np.radians(15)), np.sin(np.radians(15)), 0])
    bar = {"shape": "cylinder", "radius_mm": 1.0, "length_mm": 4.0, "rotation_deg": [90.0, 0.0, 20.0]}
    way = path(bar, depth_mm=0.5, twist_deg=40.0)
    start, end = way.pose(0.0), way.pose(way.length_mm)
    np.testing.assert_allclose(end.rotation, rotation_about(2, np.radians(40.0)) @ start.rotation, atol=1e-15)
    assert start.centre[2] == end.centre[2] - 0.5 == pytest.approx(-1.0)


@pytest.mark.parametrize("motion", [
    {"depth_mm": 1.0, "steps": 1}, {"depth_mm": 1.0, "steps": 5}, {"depth_mm": 0.2, "shear_mm": [2.0, 0.0], "steps": 6},
    {"depth_mm": 1.0, "shear_mm": [0.1, 0.0], "steps": 2}, {"depth_mm": 1.0, "twist_deg": 5.0, "steps": 1},
    {"depth_mm": -1.0, "shear_mm": [1.0, 0.0], "steps": 3}, {"depth_mm": -1.0, "steps": 3}, {"depth_mm": 0, "steps": 2},
    {"depth_mm": 1.0, "steps": 7, "then": [{"depth_mm": 0.5}, {"depth_mm": 0.5, "twist_deg": 20}]},
])  # fmt: skip
def test_records_are_as_many_as_steps_and_end_at_the_end(motion: dict) -> None:
    way = path(**motion)
    records = way.records()
    assert len(records) == motion["steps"]
    assert (np.diff(records) >= 0).all()
    last, goal = way.pose(float(records[-1])), motion.get("then", [motion])[-1]
    assert last.depth_mm == goal["depth_mm"]
    assert last.shear_mm == pytest.approx(tuple(goal.get("shear_mm", (0.0, 0.0))))
    assert last.twist_deg == pytest.approx(goal.get("twist_deg", 0.0))
    # No step may cut a corner, and where nothing moves there is nowhere to go.
    assert set(way.waypoints()) == (set(records) | set(way.ends)) - {0.0}


BACK_AND_OFF: dict[str, Any] = {
    "depth_mm": 1.0,
    "shear_mm": [0.6, 0.0],
    "then": [{"depth_mm": 1.0, "shear_mm": [-0.6, 0.0]}, {"depth_mm": 0.0, "shear_mm": [-0.6, 0.0]}],
}


@pytest.mark.parametrize(("start_mm", "touches"), [(-0.1, True), (0.0, False)])
def test_a_gel_that_begins_above_the_place_is_touched_early(start_mm: float, touches: bool) -> None:
    frame = PressFrame(np.zeros(3), np.eye(3), start_mm)
    assert replace(path(depth_mm=-0.05), frame=frame).may_touch == touches


def test_legs_follow_one_another_and_turns_are_seen() -> None:
    way = path(**BACK_AND_OFF)
    np.testing.assert_allclose(way.ends, [0, 1, 1.6, 2.8, 3.8])
    for s, depth, x in ((1.6, 1.0, 0.6), (2.2, 1.0, 0.0), (2.8, 1.0, -0.6), (3.3, 0.5, -0.6), (3.8, 0.0, -0.6)):
        pose = way.pose(s)
        assert pose.depth_mm == pytest.approx(depth)
        assert pose.shear_mm == pytest.approx((x, 0.0))
        np.testing.assert_allclose(pose.centre, [x, 0.0, depth - 3.0], atol=1e-12)
    way = path(depth_mm=0.5, twist_deg=20.0, then=[{"depth_mm": 0.5, "twist_deg": -20.0}])
    assert way.length_mm == pytest.approx(0.5 + np.radians(60.0) * TWIST_ARM_MM)
    assert way.pose((way.ends[1] + way.ends[2]) / 2).twist_deg == pytest.approx(10.0)
    assert way.pose((way.ends[2] + way.ends[3]) / 2).twist_deg == pytest.approx(0.0)
    here: dict[str, Any] = {"depth_mm": 1.0, "shear_mm": [0.5, 0.0]}
    way = path(**here, then=[here, here, {"depth_mm": 0.2, "shear_mm": [0.5, 0.0]}])
    np.testing.assert_allclose(way.ends, [0, 1, 1.5, 2.3])
    way = path(**BACK_AND_OFF)
    assert way.turns_between(0.9, 1.0)  # the way turns at 1.0: what was learnt before does not hold after
    assert way.turns_between(1.5, 1.7)
    assert not way.turns_between(1.0, 1.2)
    assert not way.turns_between(0.2, 0.9)
    # A first pose that stays off the gel may be followed by a press.
    way = path(depth_mm=-0.5, then=[{"depth_mm": 0.4}])
    np.testing.assert_allclose(way.ends, [0.0, 0.9])
    assert way.pose(0.0).depth_mm == -0.5
    assert way.pose(0.9).depth_mm == pytest.approx(0.4)


def test_records_are_dealt_by_length_and_every_leg_has_one_if_there_are_enough() -> None:
    way = path(**BACK_AND_OFF, steps=8)  # legs of 1, 0.6, 1.2 and 1 mm
    np.testing.assert_allclose(way.records(), [0.5, 1.0, 1.3, 1.6, 2.2, 2.8, 3.3, 3.8])
    np.testing.assert_allclose(path(**BACK_AND_OFF, steps=5).records(), [1.0, 1.6, 2.2, 2.8, 3.8])
    two_legs = path(depth_mm=1.0, shear_mm=[2.0, 0.0], steps=6)
    np.testing.assert_allclose(two_legs.records(), [0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
    fewer = path(**BACK_AND_OFF, steps=2)
    np.testing.assert_allclose(fewer.records(), [1.9, 3.8])
    np.testing.assert_allclose(fewer.waypoints(), [1.0, 1.6, 1.9, 2.8, 3.8])  # the corners all the same

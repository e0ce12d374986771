"""The sparse pattern of the tangent: shared by meshes of one topology, and by nothing else.

That every entry lands where it belongs is in test_simulate_bulk (tangent against differences).
"""

from dataclasses import replace

import numpy as np
import pytest
from layered_pad import layered
from pads import ELEMENT, MIXED, crooked

import synth.simulate.pattern as pattern_module
from synth.mesh import PadMesh
from synth.simulate.pattern import pattern_of
from synth.simulate.space import Space, function_space

MESH, OTHER = crooked(), crooked(seed=1)


@pytest.fixture(autouse=True)
def _empty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pattern_module, "_CACHED", type(pattern_module._CACHED)())


def others_of(space: Space, count: int) -> list[Space]:
    """Spaces that differ from one, and from each other, in a node that is held or not."""
    held = [space.held.copy() for _ in range(count)]
    for node, mask in enumerate(held):
        mask[node] = ~mask[node]
    return [replace(space, held=mask) for mask in held]


@pytest.mark.parametrize("element", MIXED)
def test_same_topology_shares_the_pattern_and_its_factor(element: str) -> None:
    assert not np.array_equal(MESH.points, OTHER.points)
    one, other = (pattern_of(function_space(mesh, ELEMENT[element]()), True) for mesh in (MESH, OTHER))
    assert one is other
    assert one.factor() is other.factor()
    assert one.factor() is not one.factor(single=False)


def test_what_differs_in_topology_does_not_share() -> None:
    space = function_space(MESH, ELEMENT["p1p1"]())
    shuffled = MESH.tets[np.random.default_rng(0).permutation(len(MESH.tets))]
    others = [
        (space, False),
        (function_space(layered(MESH), ELEMENT["p1p1"]()), True),
        (others_of(space, 1)[0], True),
        (function_space(PadMesh(MESH.points, shuffled, MESH.size_mm), ELEMENT["p1p1"]()), True),
        (function_space(MESH, ELEMENT["p2p1"]()), True),
    ]
    first = pattern_of(space, True)
    for other, mixed in others:
        assert pattern_of(other, mixed) is not first
        assert pattern_of(space, True) is first


def test_only_the_last_few_are_kept() -> None:
    space = function_space(MESH, ELEMENT["p1p1"]())
    first = pattern_of(space, True)
    most = pattern_module._MAX_CACHED
    for other in others_of(space, most):
        pattern_of(other, True)
        assert len(pattern_module._CACHED) <= most
    assert pattern_of(space, True) is not first


def test_entries_are_bounded_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last ones stay that are together within the bound, and the very last whatever its size."""
    space = function_space(MESH, ELEMENT["p1p1"]())
    large = function_space(MESH, ELEMENT["p2p1"]())
    spaces = others_of(space, 4)
    sizes = [pattern_of(one, True).size for one in spaces]
    assert len(pattern_module._CACHED) == 4
    pattern_module._CACHED.clear()
    monkeypatch.setattr(pattern_module, "_MAX_ENTRIES", sum(sizes[1:]))
    made = [pattern_of(one, True) for one in spaces]
    assert list(pattern_module._CACHED.values()) == made[1:]
    alone = pattern_of(large, True)
    assert alone.size > sum(sizes[1:])
    assert list(pattern_module._CACHED.values()) == [alone]
    assert pattern_of(large, True) is alone


@pytest.mark.parametrize("mixed", [True, False])
@pytest.mark.parametrize("element", MIXED)
def test_upper_triangle_in_order_with_its_diagonal(element: str, mixed: bool) -> None:
    """As Pardiso wants it."""
    space = function_space(MESH, ELEMENT[element]())
    made = pattern_of(space, mixed)
    rows = np.repeat(np.arange(len(made.free)), np.diff(made.indptr))
    assert (made.indices >= rows).all()
    assert (made.indices[made.indptr[:-1]] == np.arange(len(made.free))).all()
    key = rows * len(made.free) + made.indices
    assert (np.diff(key) > 0).all()
    assert len(made.free) == 3 * len(space.points) - space.held.sum() + mixed * space.pressures

"""Scenes through the batched solver."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from synth.mesh import PadMesh
from synth.scene import Scene
from synth.simulate import Trajectory
from synth.simulate.batched import simulate_presses
from synth.simulate.batched.pad import prepare
from synth.simulate.press import Press


def presses_of(scenes: Sequence[Scene], mesh: PadMesh, folder: Path | None = None) -> list[Press]:
    return [Press.of(scene, mesh, folder) for scene in scenes]


def simulate_scenes(
    scenes: Sequence[Scene], mesh: PadMesh, folder: Path | None = None, device: str = "cpu", **options: Any
) -> list[Trajectory]:
    pad = prepare(scenes[0], mesh, device)
    found = dict(simulate_presses(presses_of(scenes, mesh, folder), pad, **options))
    assert sorted(found) == list(range(len(scenes)))
    return [found[number] for number in range(len(scenes))]

"""From scenes and a mesh to trajectories: the stage's entry points."""

from collections.abc import Sequence
from pathlib import Path as FilePath

from synth.errors import InputError
from synth.mesh import PadMesh, default_edge_length
from synth.scene import Scene
from synth.simulate.element import p1p1
from synth.simulate.indenter import rigid_body
from synth.simulate.path import Path
from synth.simulate.stepping import Stepper
from synth.simulate.system import System
from synth.simulate.trajectory import Trajectory


def simulate(scene: Scene, mesh: PadMesh, folder: FilePath | None = None, device: str = "cpu") -> Trajectory:
    """Press, shear and twist one scene's indenter into its pad.

    Args:
        scene: fully drawn.
        mesh: of scene.sensor.gel.
        folder: what a mesh indenter's file name is relative to.
        device: Warp device.

    Raises:
        InputError: the indenter cannot be built.
    """
    return simulate_batch([scene], mesh, folder, device)[0]


def simulate_batch(
    scenes: Sequence[Scene], mesh: PadMesh, folder: FilePath | None = None, device: str = "cpu"
) -> list[Trajectory]:
    """Simulate scenes that share pad, Poisson's ratio and numerics side by side; each as if it were alone.

    Scenes with and without friction are kept apart, because the latter need half a matrix only.
    """
    first = scenes[0]
    for scene in scenes:
        if scene.sensor.gel.size_mm != mesh.size_mm:
            raise InputError(f"the mesh is of a {mesh.size_mm} mm pad, the scene's is {scene.sensor.gel.size_mm} mm")
        if (scene.sensor.gel.poisson_ratio, scene.numerics) != (first.sensor.gel.poisson_ratio, first.numerics):
            raise InputError("the scenes of a batch must share sensor.gel.poisson_ratio and numerics")
    trajectories: dict[int, Trajectory] = {}
    for slippery in (True, False):
        group = [i for i, scene in enumerate(scenes) if (scene.contact.friction == 0) == slippery]
        if group:
            trajectories.update(
                zip(group, _side_by_side([scenes[i] for i in group], mesh, folder, device), strict=True)
            )
    return [trajectories[i] for i in range(len(scenes))]


def _side_by_side(scenes: Sequence[Scene], mesh: PadMesh, folder: FilePath | None, device: str) -> list[Trajectory]:
    first, friction = scenes[0], [scene.contact.friction for scene in scenes]
    system = System(
        mesh,
        first.sensor.gel.poisson_ratio,
        batch=len(scenes),
        symmetric=not any(friction),
        penalty=first.numerics.penalty,
        element=p1p1(),
        device=device,
    )
    edge = first.numerics.edge_length_mm or default_edge_length(first.sensor.gel)
    paths = [Path(scene.motion, rigid_body(scene.contact.indenter, folder, edge / 2)) for scene in scenes]
    moduli = [scene.sensor.gel.youngs_modulus_kpa / 1000 for scene in scenes]
    return Stepper(system, paths, friction, first.numerics, moduli).run()

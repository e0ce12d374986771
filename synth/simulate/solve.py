"""From scenes and a mesh to trajectories: the stage's entry points."""

from collections.abc import Callable, Sequence
from pathlib import Path as FilePath

from synth.errors import InputError
from synth.mesh import PadMesh, check_mesh
from synth.scene import Gel, Scene
from synth.simulate.element import Element, p1p1, p2p1
from synth.simulate.indenter import rigid_body
from synth.simulate.material import pad_material
from synth.simulate.path import Path
from synth.simulate.space import function_space
from synth.simulate.stepping import Stepper
from synth.simulate.system import System
from synth.simulate.trajectory import Trajectory

ELEMENTS: dict[str, Callable[[], Element]] = {"auto": p2p1, "p1p1": p1p1, "p2p1": p2p1}


def simulate(
    scene: Scene,
    mesh: PadMesh,
    folder: FilePath | None = None,
    device: str = "cpu",
    frames: frozenset[int] | None = None,
) -> Trajectory:
    """Press, shear and twist one scene's indenter into its pad.

    Args:
        scene: fully drawn.
        mesh: of scene.sensor.gel.
        folder: what a mesh indenter's file name is relative to.
        device: Warp device.
        frames: numbers of the states that are wanted, default all. The others are part of the trajectory, but keep the
            penalty's penetration; those that are wanted are the same to the bit.

    Raises:
        InputError: the indenter cannot be built.
    """
    return simulate_batch([scene], mesh, folder, device, frames)[0]


def simulate_batch(
    scenes: Sequence[Scene],
    mesh: PadMesh,
    folder: FilePath | None = None,
    device: str = "cpu",
    frames: frozenset[int] | None = None,
) -> list[Trajectory]:
    """Simulate scenes that share pad, materials and numerics side by side; each as if it were alone."""
    first = scenes[0]
    for scene in scenes:
        if scene.sensor.gel.size_mm != mesh.size_mm:
            raise InputError(f"the mesh is of a {mesh.size_mm} mm pad, the scene's is {scene.sensor.gel.size_mm} mm")
        if (_elastic(scene.sensor.gel), scene.numerics) != (_elastic(first.sensor.gel), first.numerics):
            raise InputError("the scenes of a batch must share the gel's materials and numerics")
    check_mesh(mesh)
    gel = first.sensor.gel
    space = function_space(mesh, ELEMENTS[first.numerics.element]())
    system = System(
        space,
        pad_material(gel, mesh),
        batch=len(scenes),
        penalty=first.numerics.penalty,
        device=device,
    )
    resolved = mesh.spacing_mm / (2 * space.element.order)
    paths = [Path(scene.motion, rigid_body(scene.contact.indenter, folder, resolved)) for scene in scenes]
    moduli = [scene.sensor.gel.youngs_modulus_kpa / 1000 for scene in scenes]
    friction = [scene.contact.friction for scene in scenes]
    return Stepper(system, paths, friction, first.numerics, moduli, frames=frames).run()


def _elastic(gel: Gel) -> tuple[float, ...]:
    """What the deformation depends on: Young's modulus of the gel itself only scales forces."""
    layers = [
        (layer.thickness_mm, layer.youngs_modulus_kpa / gel.youngs_modulus_kpa, layer.poisson_ratio, *layer.stiffening)
        for layer in gel.layers
    ]
    return (gel.poisson_ratio, *gel.stiffening, *(value for layer in layers for value in layer))

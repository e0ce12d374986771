"""From scenes and a mesh to trajectories: the stage's entry points."""

from collections.abc import Callable, Sequence
from pathlib import Path as FilePath

from synth.errors import InputError
from synth.mesh import PadMesh, check_mesh
from synth.scene import Gel, Scene
from synth.simulate.driver import STANDARD, Driver
from synth.simulate.material import pad_material
from synth.simulate.press import ELEMENTS, Press
from synth.simulate.space import function_space
from synth.simulate.stepping import Stepper
from synth.simulate.system import System
from synth.simulate.trajectory import Trajectory


def simulate(
    scene: Scene,
    mesh: PadMesh,
    folder: FilePath | None = None,
    device: str = "cpu",
    frames: frozenset[int] | None = None,
    driver: Driver = STANDARD,
) -> Trajectory:
    """Press, shear and twist one scene's indenter into its pad, on a given mesh.

    Args:
        scene: fully drawn.
        mesh: of scene.sensor.gel.
        folder: what a mesh indenter's file name is relative to.
        device: Warp device.
        frames: see `simulate_press`.
        driver: of Newton's method.

    Raises:
        InputError: the indenter cannot be built.
    """
    return stepper_of([scene], mesh, folder, device, frames, driver).run()[0]


def simulate_press(
    press: Press,
    frames: frozenset[int] | None = None,
    on_way: Callable[[float], None] | None = None,
) -> Trajectory:
    """Simulate one press on the processor.

    Args:
        press: scene, mesh and load path.
        frames: numbers of the states that are wanted, default all. The others are part of the trajectory, but keep the
            penalty's penetration and the way's tolerance; those that are wanted are the same to the bit, unless one of
            them misses the full tolerance and its step is halved.
        on_way: told after each step what share of the way is done.

    Raises:
        InputError: no element can be built on the mesh.
    """
    return _stepper([press], "cpu", frames, STANDARD).run(on_way)[0]


def simulate_batch(
    scenes: Sequence[Scene],
    mesh: PadMesh,
    folder: FilePath | None = None,
    device: str = "cpu",
    frames: frozenset[int] | None = None,
    driver: Driver = STANDARD,
) -> list[Trajectory]:
    """Simulate scenes that share pad, materials and numerics side by side; each as if it were alone."""
    return stepper_of(scenes, mesh, folder, device, frames, driver).run()


def stepper_of(
    scenes: Sequence[Scene],
    mesh: PadMesh,
    folder: FilePath | None = None,
    device: str = "cpu",
    frames: frozenset[int] | None = None,
    driver: Driver = STANDARD,
) -> Stepper:
    """What `simulate_batch` runs, at the start of the scenes' paths; arguments and errors as there."""
    return _stepper([Press.of(scene, mesh, folder) for scene in scenes], device, frames, driver)


def _stepper(presses: Sequence[Press], device: str, frames: frozenset[int] | None, driver: Driver) -> Stepper:
    first, mesh, scenes = presses[0].scene, presses[0].mesh, [press.scene for press in presses]
    check_shared(scenes, mesh)
    check_mesh(mesh)
    space = function_space(mesh, ELEMENTS[first.numerics.element]())
    system = System(
        space,
        pad_material(first.sensor.gel, mesh),
        batch=len(scenes),
        penalty=first.numerics.penalty,
        device=device,
        single=driver.single_precision,
        keep=driver.keep_factors,
    )
    moduli = [scene.sensor.gel.youngs_modulus_kpa / 1000 for scene in scenes]
    friction = [scene.contact.friction for scene in scenes]
    return Stepper(system, [press.path for press in presses], friction, first.numerics, moduli, driver, frames)


def check_shared(scenes: Sequence[Scene], mesh: PadMesh) -> None:
    """Refuse scenes that are not of the mesh's pad, or differ in what a batch has in common.

    Raises:
        InputError: a scene's pad is not the mesh's, or its materials or numerics are not the first scene's.
    """
    first = scenes[0]
    for scene in scenes:
        gel = scene.sensor.gel
        own, other = _pad(gel.size_mm, gel.dome_radius_mm), _pad(mesh.size_mm, mesh.dome_radius_mm)
        if own != other:
            raise InputError(f"the mesh is of a {other}, the scene's is a {own}")
        if (_elastic(gel), scene.numerics) != (_elastic(first.sensor.gel), first.numerics):
            raise InputError("the scenes of a batch must share the gel's materials and numerics")


def _pad(size_mm: tuple[float, float, float], dome_radius_mm: float | None) -> str:
    return f"{size_mm} mm pad" + ("" if dome_radius_mm is None else f" of dome radius {dome_radius_mm} mm")


def _elastic(gel: Gel) -> tuple[float, ...]:
    """What the deformation depends on: Young's modulus of the gel itself only scales forces."""
    layers = [
        (layer.thickness_mm, layer.youngs_modulus_kpa / gel.youngs_modulus_kpa, layer.poisson_ratio, *layer.stiffening)
        for layer in gel.layers
    ]
    return (gel.poisson_ratio, *gel.stiffening, *(value for layer in layers for value in layer))

"""Which presses may be simulated together, and what they share."""

from synth.pipeline.records import JobContext
from synth.press.press import Press
from synth.scene import Gel
from synth.simulate.batched.pad import Pad, prepare


class Pads:
    """The pad that was used last: mesh, tables and preconditioner, which take seconds to prepare."""

    def __init__(self, context: JobContext) -> None:
        self._device = context.plan.device
        self._cached: tuple[Gel, Pad] | None = None

    def of(self, press: Press) -> Pad:
        """The pad of a press; InputError for a mesh that allows no element, or CUDA without cuBLAS or cuSOLVER."""
        key = pad_key(press)
        if self._cached is None or self._cached[0] != key:
            self._cached = None  # gives its memory back first
            self._cached = key, prepare(press.scene, press.mesh, self._device)
        return self._cached[1]


def pad_key(press: Press) -> Gel:
    """What presses that may run together have in common, and with it the mesh. Without layers stiffness only scales."""
    gel = press.scene.sensor.gel
    return gel if gel.layers else gel.model_copy(update={"youngs_modulus_kpa": 1.0})

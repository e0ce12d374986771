"""What a scene needs, decided once; what comes later is handed the plan and asks nothing again."""

import re
from dataclasses import dataclass
from typing import Any, Literal

from synth.planning.check import check_buildable
from synth.planning.reasons import Decision, decisions
from synth.render.pattern import is_grey
from synth.render.variant import Device, Variant, choose_variant
from synth.scene.template import Template
from synth.simulate.mesh_rule import MeshRule


@dataclass(frozen=True)
class Plan:
    """What runs, for all samples of a scene; picklable.

    Attributes:
        template: the scene with its distributions; `template.outputs` and `template.sampling` are the same for all.
        variant: that renders.
        is_batched: whether trajectories are simulated many at once, on one mesh for all of a pad.
        mesh: how the meshes of the trajectories are chosen.
        decisions: feature by feature, with reasons; light and lens among them are each sensor's own.
    """

    template: Template
    variant: Variant
    is_batched: bool
    mesh: MeshRule
    decisions: tuple[Decision, ...]

    @property
    def solver_device(self) -> Literal["cuda", "cpu"]:
        """Where the batched solver runs: beside the renderer."""
        return "cuda" if self.variant.is_on_gpu else "cpu"

    def record(self) -> dict[str, Any]:
        named = {"scene": self.template.name, "variant": self.variant.name}
        return {**named, "decisions": [vars(decision) for decision in self.decisions]}


def plan(scene: Template, variant: Variant | None = None) -> Plan:
    """Decide what runs, with reasons.

    Args:
        scene: of `load_scene`.
        variant: the renderer; by default the fastest here that the scene needs.

    Raises:
        InputError: what the scene asks for cannot be built, see `check_buildable`.

    Examples:
        >>> from synth import load_scene
        >>> planned = plan(load_scene("gelsight_mini", set=["contact.friction=0.0"]))
        >>> [decision.reason for decision in planned.decisions if decision.feature == "friction state"]
        ['contact.friction = 0: half the matrix is enough']
    """
    variant = variant or job_variant(scene, "auto")
    check_buildable(scene, variant)
    is_batched = scene.numerics.is_batched
    found = decisions(scene, variant, is_batched)
    round_first = sorted(scene.corners, key=lambda corner: not corner.sensor.gel.is_round)
    return Plan(scene, variant, is_batched, MeshRule.of(round_first[0]), found)


def job_variant(template: Template, device: Device) -> Variant:
    """What renders a job: one channel where every draw of it is grey; InputError where the device is not there."""
    # Corners that are grey say nothing of the draws between them where a single channel is drawn.
    drawn = any(re.search(r"\.(color|reflectance)\[\d\]$|\.saturation$", at) for _, _, at in template.distributions())
    return choose_variant(device, grey=not drawn and all(is_grey(scene.sensor) for scene in template.corners))

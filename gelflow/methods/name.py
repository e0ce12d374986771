"""Names of methods: what a row of a table is called, and which rows are trainings of one kind."""

import re
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class MethodName:
    """A method's name; its text is the parts in this order, "best+motion#0+ft".

    Attributes:
        label: What it is called.
        registration: What registers its flow, of `gelflow.config.REGISTRATIONS`, "registration" for another, or "".
        seed: Number of a training among several that differ in nothing but their seed, as it was given, or "".
        fine_tuned: Whether it was optimised on the very pairs that it is scored on.
    """

    label: str
    registration: str = ""
    seed: str = ""
    fine_tuned: bool = False

    @classmethod
    def parse(cls, text: str) -> "MethodName":
        """The name that a user gave: LABEL, LABEL#SEED, LABEL+ft or LABEL#SEED+ft."""
        ((label, seed, tuned),) = re.findall(r"(?s)^(.*?)(?:#(\d+))?(\+ft)?\Z", text)
        return cls(label, seed=seed, fine_tuned=bool(tuned))

    @property
    def group(self) -> "MethodName":
        """The name without its seed."""
        return replace(self, seed="")

    def __str__(self) -> str:
        added = self.registration and f"+{self.registration}"
        seed = self.seed and f"#{self.seed}"
        return f"{self.label}{added}{seed}{'+ft' if self.fine_tuned else ''}"

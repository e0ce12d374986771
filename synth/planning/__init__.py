"""What a scene needs, decided once, and what it will cost."""

from synth.planning.plan import Plan, check_buildable, plan

__all__ = ["Plan", "check_buildable", "plan"]

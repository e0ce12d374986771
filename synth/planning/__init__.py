"""What a scene needs, decided once (`plan`), and what it will cost (`predict`)."""

from synth.planning.plan import Plan, check_buildable, plan
from synth.planning.prediction import Prediction, predict
from synth.render.variant import job_variant

__all__ = ["Plan", "Prediction", "check_buildable", "job_variant", "plan", "predict"]

"""The recorded ground truth, derived again by another route: no rays are traced, and the camera is another one."""

from synth.verify.dataset import verify_dataset, verify_sample
from synth.verify.report import Check, Report, SampleReport

__all__ = ["Check", "Report", "SampleReport", "verify_dataset", "verify_sample"]

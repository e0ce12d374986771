"""The recorded ground truth, derived again by another route: no rays are traced, and the camera is another one."""

from synth.verify.dataset import verify_dataset

__all__ = ["verify_dataset"]

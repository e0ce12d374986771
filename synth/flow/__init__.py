"""Exact optical flow.

Import from the modules: `synth.flow.field` holds the record and is light, `synth.flow.exact` computes it with Warp.
"""

from synth.flow.field import FlowField

__all__ = ["FlowField"]

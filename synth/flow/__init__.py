"""Exact optical flow: `synth.flow.field` holds the record and is light, `synth.flow.exact` computes it with Warp."""

"""A press before its first iteration: the indenter and its distance, the load path, the footprint, the mesh's rule."""

from synth.warp_start import start_warp

start_warp()

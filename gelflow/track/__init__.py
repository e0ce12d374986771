"""Flow of a stream of frames from one reference, and the markers that move with it."""

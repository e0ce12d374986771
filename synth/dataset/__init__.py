"""The dataset on disk: writing it in several goes and by several workers, reading it, exporting it."""

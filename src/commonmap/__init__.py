"""commonmap: one common map from what two robots' lidars saw of the same place."""

from commonmap.version import __version__

__all__ = ["__version__"]

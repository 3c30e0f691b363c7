"""commonmap: one common map from what two robots' lidars saw of the same place.

    import commonmap
    match = commonmap.match(target_xyz, source_xyz)                 # (N, 3) arrays, metres, z up
    if match.accepted:
        common = commonmap.merge(target_xyz, source_xyz, match.T_target_source)

Names are loaded when they are first used, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from commonmap.version import __version__

if TYPE_CHECKING:
    from commonmap.config import Config
    from commonmap.io.formats import read_map, write_map
    from commonmap.pipeline import match_maps as match
    from commonmap.pipeline import merge_maps as merge
    from commonmap.pipeline import run
    from commonmap.types import Cloud, Leaves, Match

__all__ = [
    "Cloud",
    "Config",
    "Leaves",
    "Match",
    "__version__",
    "match",
    "merge",
    "read_map",
    "run",
    "write_map",
]

_PLACES = {
    "Cloud": "types.Cloud",
    "Config": "config.Config",
    "Leaves": "types.Leaves",
    "Match": "types.Match",
    "match": "pipeline.match_maps",
    "merge": "pipeline.merge_maps",
    "read_map": "io.formats.read_map",
    "run": "pipeline.run",
    "write_map": "io.formats.write_map",
}


def __getattr__(name: str) -> Any:
    """Return a public name from the module that holds it."""
    if name not in _PLACES:
        raise AttributeError(f"module 'commonmap' has no attribute {name!r}")
    module, _, attribute = _PLACES[name].rpartition(".")
    value = getattr(import_module(f"commonmap.{module}"), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)

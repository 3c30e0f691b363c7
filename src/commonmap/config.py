"""Every knob on one screen, grouped as the pipeline is. The resolved tree is saved beside a result.

`None` means: derived from the data. Metres and radians throughout.
"""

from __future__ import annotations

import json
import math
import tomllib
import types
import typing
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

from commonmap.errors import InputError
from commonmap.version import __version__

Section = TypeVar("Section")


@dataclass(frozen=True)
class GridConfig:
    """The height map that is matched.

    resolution: edge of a cell; None takes it from the density of the sparser map.
    max_height: only what is less than this above ground is used (1 m is the paper's set-up);
        None uses all heights.
    rays: where a map has them (ray origins, or free space of an octree), they say what of it is
        known; else a column with points is known at all heights. The verdict was fitted without.
    """

    resolution: float | None = None
    max_height: float | None = None
    rays: bool = False

    def __post_init__(self) -> None:
        _require_positive("grid.resolution", self.resolution)
        _require_positive("grid.max_height", self.max_height)


@dataclass(frozen=True)
class LevelConfig:
    """How a map that does not know gravity is made level. Files with a CRS are taken as level."""

    mode: Literal["auto", "off"] = "auto"


@dataclass(frozen=True)
class SearchConfig:
    """The search over x, y and yaw.

    metric: a name of the table `commonmap metrics`.
    normalise: what a distribution sums to one over (entropy metrics): the overlap, the map, or
        nothing.
    floor: the height that stands for "flat ground" where a metric needs positive heights, metres.
    min_overlap: a pose at which a smaller share of the source's known cells meets known cells of
        the target cannot win. None: a tenth for the evidence, which grows with the overlap; half
        for metrics that are means over the overlap, which a few cells reach by luck.
    n_rivals: how many other poses are kept.
    """

    metric: str = "evidence"
    normalise: Literal["overlap", "map", "off"] = "overlap"
    floor: float = 0.05
    min_overlap: float | None = None
    n_rivals: int = 5

    def __post_init__(self) -> None:
        _require_positive("search.floor", self.floor)
        if self.min_overlap is not None:
            _require_share("search.min_overlap", self.min_overlap)
        if self.n_rivals < 0:
            raise InputError(f"search.n_rivals must not be negative; {self.n_rivals} came")


@dataclass(frozen=True)
class RefineConfig:
    """The 6-DoF refinement on the overlap. mode "off" keeps the pose of the search."""

    mode: Literal["points", "off"] = "points"


@dataclass(frozen=True)
class DecideConfig:
    """When a pose is believed. mode "off" accepts the best pose whatever it is worth."""

    mode: Literal["strict", "off"] = "strict"


@dataclass(frozen=True)
class AreasConfig:
    """The draft by areas, each matched by itself. size: metres, edge of an area; None leaves this
    out. Where the areas support a correction of the draft's drift, it is merged corrected."""

    size: float | None = None

    def __post_init__(self) -> None:
        _require_positive("areas.size", self.size)


@dataclass(frozen=True)
class MergeConfig:
    """The common map and what is drawn from it.

    resolution: edge of a voxel of the common octree; None takes the target's where it is an
        octree, else the one of the match.
    mode: how two opinions on one voxel are joined: "add" adds their log-odds, "keep-target" lets
        what the target knows stand, "occupied-wins" takes the larger.
    step_height: what rises less than this above the local ground is no obstacle, metres.
    robot_height: what hangs higher than this above the local ground is no obstacle, metres.
    """

    resolution: float | None = None
    mode: Literal["add", "keep-target", "occupied-wins"] = "add"
    step_height: float = 0.15
    robot_height: float = 1.8

    def __post_init__(self) -> None:
        _require_positive("merge.resolution", self.resolution)
        _require_positive("merge.step_height", self.step_height)
        _require_positive("merge.robot_height", self.robot_height)
        if self.robot_height <= self.step_height:
            raise InputError(
                f"merge.robot_height must be above merge.step_height ({self.step_height:g} m); "
                f"{self.robot_height:g} m came"
            )


@dataclass(frozen=True)
class ComputeConfig:
    """Where the search runs and what it may hold. The answer does not depend on it.

    scheduler: address of a Dask scheduler, tcp://host:port; None: the threads of this machine.
    memory_gb: what the exhaustive part of the search may hold at a time beside the maps, 1e9
        bytes; on a cluster, in each thread of a worker.
    arrays: "numpy", or "cupy" on a GPU.
    """

    scheduler: str | None = None
    memory_gb: float = 0.5
    arrays: Literal["numpy", "cupy"] = "numpy"

    def __post_init__(self) -> None:
        if self.scheduler is not None and "://" not in self.scheduler:
            raise InputError(
                f"compute.scheduler is an address like tcp://host:8786; {self.scheduler} came"
            )
        if not (math.isfinite(self.memory_gb) and self.memory_gb > 0):
            raise InputError(f"compute.memory_gb must be positive; {self.memory_gb:g} came")


@dataclass(frozen=True)
class Config:
    """The whole tree, in the order of the pipeline. seed: enters wherever chance does."""

    grid: GridConfig = field(default_factory=GridConfig)
    level: LevelConfig = field(default_factory=LevelConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    decide: DecideConfig = field(default_factory=DecideConfig)
    areas: AreasConfig = field(default_factory=AreasConfig)
    merge: MergeConfig = field(default_factory=MergeConfig)
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    seed: int = 0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"seed must not be negative; {self.seed} came")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Config:
        """Return the configuration of a nested mapping; what it leaves out keeps its default.

        A key that no section knows, or a value of another type, raises `InputError`. The key
        `version`, which `to_dict` writes, is read over.
        """
        return _build(cls, {k: v for k, v in values.items() if k != "version"}, "")

    def to_dict(self) -> dict[str, Any]:
        """Return the tree as plain values, with the version of the software: ready for JSON."""
        return {"version": __version__, **asdict(self)}

    def with_values(self, **sections: Mapping[str, Any]) -> Config:
        """Return a copy with some values of some sections replaced: `grid={"resolution": 0.2}`.

        Values that are None are left as they are.
        """
        new: dict[str, Any] = {}
        for name, values in sections.items():
            given = {k: v for k, v in values.items() if v is not None}
            new[name] = _replace(getattr(self, name), given, f"{name}.")
        return replace(self, **new)


def read_config(path: Path) -> Config:
    """Return the configuration of a .json or .toml file."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the configuration {path}: {error}") from None
    try:
        if path.suffix.lower() == ".toml":
            values = tomllib.loads(text)
        elif path.suffix.lower() == ".json":
            values = json.loads(text)
        else:
            raise InputError(f"a configuration is a .json or .toml file; {path} came")
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        raise InputError(f"the configuration {path} cannot be read: {error}") from None
    if not isinstance(values, dict):
        raise InputError(f"the configuration {path} must hold sections with values")
    return Config.from_dict(values)


def _build(cls: type[Section], values: Any, prefix: str) -> Section:
    return _replace(cls(), values, prefix)


def _replace(section: Section, values: Any, prefix: str) -> Section:
    assert is_dataclass(section) and not isinstance(section, type)
    if not isinstance(values, Mapping):
        raise InputError(
            f"{prefix.rstrip('.') or 'config'} must hold named values; {values!r} came"
        )
    hints = typing.get_type_hints(type(section))
    known = [item.name for item in fields(section)]
    new: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            raise InputError(f"no option {prefix}{name}; known here: {', '.join(known)}")
        current = getattr(section, name)
        if is_dataclass(current):
            new[name] = _replace(current, value, f"{prefix}{name}.")
        else:
            new[name] = _checked(value, hints[name], f"{prefix}{name}")
    return replace(section, **new)


def _checked(value: Any, hint: Any, name: str) -> Any:
    """Return `value` as the type `hint` says, or raise; a bool is no number, an int is a float."""
    choices = typing.get_args(hint)
    if typing.get_origin(hint) is Literal:
        if value in choices and isinstance(value, str):
            return value
        raise InputError(f"{name} is one of {', '.join(map(str, choices))}; {value!r} came")
    if isinstance(hint, types.UnionType):
        if value is None and type(None) in choices:
            return None
        return _checked(value, next(c for c in choices if c is not type(None)), name)
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        if math.isfinite(value):
            return float(value)
        raise InputError(f"{name} must be a finite number; {value} came")
    if isinstance(value, hint) and not (hint is int and isinstance(value, bool)):
        return value
    raise InputError(f"{name} must be of type {hint.__name__}; {value!r} came")


def _require_positive(name: str, value: float | None) -> None:
    if value is not None and not (math.isfinite(value) and value > 0):
        raise InputError(f"{name} must be a positive number of metres; {value:g} came")


def _require_share(name: str, value: float) -> None:
    if not 0.0 < value <= 1.0:
        raise InputError(f"{name} must be a share above 0 and up to 1; {value:g} came")

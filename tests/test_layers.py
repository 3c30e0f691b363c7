"""Imports point up the list of layers only; the imports of every module are read, not run."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent / "src" / "commonmap"

LAYERS = (
    ("errors", "types", "frames", "config", "version"),
    ("io",),
    ("odometry",),
    ("mapping",),
    ("metrics",),
    ("matching",),
    ("merging",),
    ("sim",),
    ("pipeline", "pipeline_logs", "demo"),
    (
        "study", "report", "cli", "cli_beside", "cli_logs", "cli_mapping", "cli_matching",
        "cli_octree", "cli_options", "cli_progress", "cli_results", "cli_simulating", "cli_study",
        "cli_words", "__init__", "__main__",
    ),
)  # fmt: skip
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
MODULES = sorted(ROOT.rglob("*.py"))


def layer_of(path: Path, root: Path = ROOT) -> str:
    """Return the first part of a module's name below the package."""
    return path.relative_to(root).parts[0].removesuffix(".py")


def imported(text: str) -> set[str]:
    """Return the layers of commonmap that a module's text imports, at any depth of its code."""
    layers = set()
    for node in ast.walk(ast.parse(text)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            module = node.module or ""
            names = [f"{module}.{alias.name}" for alias in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "commonmap" and len(parts) > 1 and not parts[1].startswith("__"):
                layers.add(parts[1])
    return layers


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_point_up_only(path: Path) -> None:
    own = layer_of(path)
    assert own in RANK, f"{own} is in no layer: give it one here and in the design"
    for other in imported(path.read_text(encoding="utf-8")):
        assert other in RANK, f"{path} imports commonmap.{other}, which is in no layer"
        assert RANK[other] <= RANK[own], f"{own} must not import {other}: it is a layer below"


def test_the_reader_of_imports_sees_every_kind() -> None:
    text = (
        "import commonmap.sim.pairs\nfrom commonmap import pipeline\n"
        "def f():\n    from commonmap.io.las import read_las\nimport numpy\n"
    )
    assert imported(text) == {"sim", "pipeline", "io"}


def test_first_layers_need_numpy_and_scipy_alone() -> None:
    allowed = {"numpy", "scipy", "commonmap", "__future__"}
    standard = {
        "json", "math", "tomllib", "types", "typing", "collections", "dataclasses", "pathlib",
    }  # fmt: skip
    for name in LAYERS[0]:
        tree = ast.parse((ROOT / f"{name}.py").read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            roots = []
            if isinstance(node, ast.Import):
                roots = [alias.name.split(".")[0] for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                roots = [(node.module or "").split(".")[0]]
            assert set(roots) <= allowed | standard, f"{name} imports {roots}"


def test_no_room_for_odds_and_ends() -> None:
    names = {path.stem for path in MODULES}
    assert not names & {"utils", "util", "helpers", "helper", "common", "misc"}

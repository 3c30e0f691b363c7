"""The configuration tree: unknown keys, types, ranges, files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from commonmap.config import Config, read_config
from commonmap.errors import InputError


def test_round_trip_keeps_every_value() -> None:
    config = Config().with_values(
        grid={"resolution": 0.2, "max_height": 1}, merge={"mode": "keep-target"}
    )
    again = Config.from_dict(config.to_dict())
    assert again == config
    assert again.grid.max_height == 1.0
    assert isinstance(again.grid.max_height, float)


def test_none_leaves_a_value_as_it_is() -> None:
    config = Config.from_dict({"search": {"metric": "k"}})
    assert config.with_values(search={"metric": None}).search.metric == "k"


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"grids": {}}, "no option grids; known here: grid, level"),
        ({"grid": {"resolutoin": 1}}, "no option grid.resolutoin; known here: resolution"),
        ({"grid": {"resolution": "fine"}}, "grid.resolution must be of type float; 'fine' came"),
        ({"grid": {"resolution": True}}, "grid.resolution must be of type float; True came"),
        ({"grid": {"resolution": -1}}, "grid.resolution must be a positive number"),
        ({"grid": {"resolution": float("inf")}}, "finite"),
        ({"grid": 3}, "grid must hold named values; 3 came"),
        ({"level": {"mode": "on"}}, "level.mode is one of auto, off; 'on' came"),
        ({"search": {"min_overlap": 0}}, "share above 0"),
        ({"search": {"n_rivals": 2.5}}, "search.n_rivals must be of type int; 2.5 came"),
        ({"merge": {"robot_height": 0.1}}, "merge.robot_height must be above"),
        ({"seed": -1}, "seed must not be negative"),
        ({"seed": None}, "seed must be of type int"),
    ],
)
def test_wrong_values_are_named(values: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError) as caught:
        Config.from_dict(values)
    assert words in str(caught.value)


def test_files(tmp_path: Path) -> None:
    toml = tmp_path / "a.toml"
    toml.write_text("seed = 7\n[grid]\nresolution = 1\n")
    assert read_config(toml).grid.resolution == 1.0
    assert read_config(toml).seed == 7
    (tmp_path / "a.json").write_text('{"search": {"metric": "kl"}}')
    assert read_config(tmp_path / "a.json").search.metric == "kl"


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.toml", "seed = "), ("a.json", "{"), ("a.json", "[1]"), ("a.yaml", "seed: 1"), ("b", None)],
)
def test_bad_files_are_told_in_a_sentence(tmp_path: Path, name: str, text: str | None) -> None:
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=name):
        read_config(path)

"""Files appear whole or not at all, whatever goes wrong on the way."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from commonmap.errors import OutputError
from commonmap.io import writing, writing_all, writing_folder


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_the_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "map.laz"
    with writing(target) as part:
        assert part.parent == tmp_path and part.suffix == ".laz"
        part.write_bytes(b"new")
        assert not target.exists()
    assert target.read_bytes() == b"new"
    assert names(tmp_path) == ["map.laz"]
    assert target.stat().st_mode & 0o777 == 0o666 & ~current_umask()


def current_umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@pytest.mark.parametrize("fault", [RuntimeError("x"), KeyboardInterrupt(), SystemExit(1)])
def test_a_fault_leaves_the_old_file_and_nothing_else(tmp_path: Path, fault: BaseException) -> None:
    target = tmp_path / "map.ply"
    target.write_bytes(b"old")
    with pytest.raises(type(fault)), writing(target) as part:
        part.write_bytes(b"half")
        raise fault
    assert target.read_bytes() == b"old"
    assert names(tmp_path) == ["map.ply"]


def test_a_full_disk_is_one_sentence(tmp_path: Path) -> None:
    target = tmp_path / "map.ply"
    with pytest.raises(OutputError) as caught, writing(target) as part:
        part.write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert str(caught.value) == f"cannot write {target}: no space left on device"
    assert names(tmp_path) == []
    with pytest.raises(OutputError, match="no space left on device"), writing(target):
        raise OSError("7892 requested and 6080 written")  # NumPy's tofile


def test_places_where_no_file_can_be(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="there is no folder"), writing(tmp_path / "a" / "b.ply"):
        pass
    with pytest.raises(OutputError, match="it is a folder"), writing(tmp_path):
        pass
    with pytest.raises(OutputError, match="not a regular file"), writing("/dev/null"):
        pass
    with pytest.raises(OutputError, match="nothing was written"), writing(tmp_path / "b.ply"):
        pass
    assert names(tmp_path) == []


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link.txt").symlink_to(tmp_path / "real" / "file.txt")
    with writing(tmp_path / "link.txt") as part:
        part.write_text("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real" / "file.txt").read_text() == "new"


def test_a_name_of_the_greatest_length(tmp_path: Path) -> None:
    target = tmp_path / ("n" * 250 + ".ply")
    with writing(target) as part:
        part.write_text("new")
    assert target.read_text() == "new"


def test_two_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    pgm, yaml = tmp_path / "map.pgm", tmp_path / "map.yaml"
    pgm.write_text("old")
    with pytest.raises(OutputError), writing_all(pgm, yaml) as (first, _second):
        first.write_text("new")
    assert (pgm.read_text(), names(tmp_path)) == ("old", ["map.pgm"])
    with writing_all(pgm, yaml) as (first, second):
        first.write_text("new")
        second.write_text("new")
    assert (pgm.read_text(), yaml.read_text(), len(names(tmp_path))) == ("new", "new", 2)


def test_a_rename_that_fails_puts_the_first_file_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pgm, yaml = tmp_path / "map.pgm", tmp_path / "map.yaml"
    pgm.write_text("old")
    replace = os.replace

    def fail_for_yaml(source: Path, target: Path) -> None:
        if Path(target).suffix == ".yaml":
            raise PermissionError(errno.EACCES, "Permission denied")
        replace(source, target)

    monkeypatch.setattr(os, "replace", fail_for_yaml)
    with (
        pytest.raises(OutputError, match="permission denied"),
        writing_all(pgm, yaml) as (first, second),
    ):
        first.write_text("new")
        second.write_text("new")
    assert (pgm.read_text(), names(tmp_path)) == ("old", ["map.pgm"])


def test_folders(tmp_path: Path) -> None:
    target = tmp_path / "log"
    with pytest.raises(KeyboardInterrupt), writing_folder(target) as part:
        (part / "times.txt").write_text("1")
        raise KeyboardInterrupt
    assert names(tmp_path) == []
    for text in ("1", "2"):
        with writing_folder(target, replaces=("times.txt",)) as part:
            (part / "times.txt").write_text(text)
    assert (target / "times.txt").read_text() == "2"
    assert names(tmp_path) == ["log"]
    (target / "thesis.tex").write_text("years of work")
    with (
        pytest.raises(OutputError, match=r"already holds other files \(thesis.tex\)"),
        writing_folder(target, replaces=("times.txt",)),
    ):
        pass
    assert names(target) == ["thesis.tex", "times.txt"]

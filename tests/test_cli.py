"""The command line: exit codes, one sentence for each fault, and nothing half-written."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from commonmap import cli, cli_results, pipeline
from commonmap.errors import InputError
from commonmap.frames import apply, difference, from_xyz_yaw, invert
from commonmap.io import read_cloud, read_geotiff, read_map, write_cloud
from commonmap.io.logs import iter_scans
from commonmap.io.trajectory import read_trajectory
from commonmap.sim.logs import write_kitti
from commonmap.types import Candidate, Cloud, Float64s, Leaves, Match

T_TRUE = from_xyz_yaw(7.0, -4.0, 1.5, 2.2)
KEYS = {
    "accepted", "reason", "T_target_source", "confidence", "covariance", "covariance_order",
    "overlap", "score", "decoy_score", "rivals", "metric", "timings", "version",
}  # fmt: skip


class Done(NamedTuple):
    code: int
    out: str
    err: str


Run = Callable[..., Done]


def yard(seed: int, *, n_boxes: int = 25) -> Float64s:
    """Return (N, 3) points of level ground, boxes and poles on 24 x 24 m."""
    rng = np.random.default_rng(seed)
    parts = [np.column_stack([rng.uniform(-12, 12, (12_000, 2)), rng.normal(0, 0.02, 12_000)])]
    for _ in range(n_boxes):
        a, b, h = rng.uniform(0.5, 3, 3)
        x, y = rng.uniform(-10, 10, 2)
        yaw = rng.uniform(0, np.pi)
        side = rng.uniform(-1, 1, (400, 2))
        side[np.arange(400), rng.integers(0, 2, 400)] = rng.choice([-1, 1], 400)
        xyz = np.column_stack([side * [a / 2, b / 2], rng.uniform(0, h, 400)])
        parts.append(apply(from_xyz_yaw(x, y, 0, yaw), xyz))
    return np.concatenate(parts)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with base.ply, draft.ply (the same yard, moved) and other.ply."""
    folder = tmp_path_factory.mktemp("maps")
    rng = np.random.default_rng(3)
    xyz = yard(1)
    source = xyz[(np.abs(xyz[:, :2]) < 9).all(axis=1)]
    source = source[rng.random(len(source)) < 0.7] + rng.normal(0, 0.01, 3)
    write_cloud(folder / "base.ply", Cloud(xyz))
    write_cloud(folder / "draft.ply", Cloud(apply(invert(T_TRUE), source)))
    write_cloud(folder / "other.ply", Cloud(yard(2)))
    return folder


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    def call(*words: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["commonmap", *map(str, words)])
        before = signal.getsignal(signal.SIGTERM)
        try:
            with pytest.raises(SystemExit) as caught:
                cli.main()
        finally:
            signal.signal(signal.SIGTERM, before)
        out, err = capsys.readouterr()
        return Done(int(caught.value.code or 0), out, err)

    return call


@pytest.fixture
def answer(monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], Match]:
    """Return a way to put a ready answer in the place of the matching engine."""

    def put(accepted: bool) -> Match:
        best = Candidate(T_TRUE, 10.0, 0.9)
        match = Match(
            accepted=accepted,
            reason="accepted: it fits" if accepted else "refused: two places are alike",
            T_target_source=T_TRUE if accepted else None,
            confidence=0.99 if accepted else 0.2,
            covariance=np.eye(6) * 1e-4 if accepted else None,
            covariance_centre=np.zeros(3) if accepted else None,
            overlap=0.9,
            score=10.0,
            decoy_score=float("nan"),
            rivals=() if accepted else (best,),
            metric="evidence",
        )
        monkeypatch.setattr(pipeline, "match", lambda *a, **k: match)
        return match

    return put


def told(done: Done, *words: str) -> None:
    """Assert that a command ended with one line on stderr that holds the words, and code 2."""
    assert done.code == 2
    assert done.out == ""
    lines = done.err.strip().splitlines()
    assert len([line for line in lines if line.startswith("commonmap: ")]) == 1, done.err
    assert lines[-1].startswith("commonmap: ")
    for word in words:
        assert word in lines[-1], done.err
    assert "Traceback" not in done.err


# The whole way


def test_run_finds_the_pose_and_leaves_every_product(
    folder: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "out"
    done = run("run", folder / "base.ply", folder / "draft.ply", "-o", out)
    assert done.code == 0, done.err
    assert "accepted" in done.out
    assert {path.name for path in out.iterdir()} == set(cli_results.ENTRIES) - {
        "base.laz", "draft.laz", "truth.json", "odometry.json",
        "base_trajectory.tum", "draft_trajectory.tum",
    }  # fmt: skip
    values = json.loads((out / "match.json").read_text(), parse_constant=pytest.fail)
    assert set(values) >= KEYS
    T = np.array(values["T_target_source"])
    centre = apply(invert(T_TRUE), np.zeros((1, 3)))[0]
    metres, radians = difference(T, T_TRUE, centre)
    assert metres < 0.1 and radians < np.radians(0.5)
    assert np.array(values["covariance"]).shape == (6, 6)
    assert values["covariance_order"][0] == "x" and len(values["covariance_order"]) == 6
    assert values["source"]["size"] == len(read_cloud(folder / "draft.ply").xyz)

    leaves = read_map(out / "common.ot")
    assert isinstance(leaves, Leaves) and leaves.occupied.sum() > 1000
    cloud = read_cloud(out / "common.laz")
    assert cloud.seen_by is not None and set(np.unique(cloud.seen_by)) <= {1, 2, 3}
    assert (cloud.seen_by == 3).sum() > 1000
    heights, _ = read_geotiff(out / "height_map.tif")
    assert tuple(heights.layers) == cli_results.HEIGHT_LAYERS
    assert (out / "map.pgm").read_bytes().startswith(b"P5\n")
    assert "image: map.pgm" in (out / "map.yaml").read_text()
    assert "--frame-id base --child-frame-id draft" in (out / "transform.txt").read_text()
    assert json.loads((out / "config.json").read_text())["seed"] == 0


def test_match_then_merge(folder: Path, tmp_path: Path, run: Run, answer: Any) -> None:
    answer(True)
    path = tmp_path / "match.json"
    done = run("match", folder / "base.ply", folder / "draft.ply", "-o", path)
    assert done.code == 0 and path.exists()
    for name in ("common.ot", "common.bt", "common.ply", "common.pcd", "common.las", "common.laz"):
        out = tmp_path / name
        words = ("merge", folder / "base.ply", folder / "draft.ply", "--match", path, "-o", out)
        assert run(*words, "--quiet") == (0, "", "")
        assert read_map(out) is not None
    merged = read_cloud(tmp_path / "common.ply")
    n = sum(len(read_cloud(folder / name).xyz) for name in ("base.ply", "draft.ply"))
    assert len(merged.xyz) == n


def test_match_without_a_file_prints_strict_json(folder: Path, run: Run, answer: Any) -> None:
    answer(True)
    done = run("match", folder / "base.ply", folder / "draft.ply", "-q")
    assert done.code == 0 and done.err == ""
    values = json.loads(done.out, parse_constant=pytest.fail)
    assert values["decoy_score"] is None  # it was not a number
    assert values["T_target_source"] == T_TRUE.tolist()


def test_refused_is_code_3_with_a_report_and_no_map(
    folder: Path, tmp_path: Path, run: Run, answer: Any
) -> None:
    out = tmp_path / "out"
    answer(True)
    assert run("run", folder / "base.ply", folder / "draft.ply", "-o", out).code == 0
    answer(False)
    done = run("run", folder / "base.ply", folder / "draft.ply", "-o", out)
    assert done.code == 3
    assert "refused: two places are alike" in done.out
    # What an earlier run had left is gone: no two runs mix
    assert {p.name for p in out.iterdir()} == {"match.json", "config.json", "report.html"}
    values = json.loads((out / "match.json").read_text())
    assert values["accepted"] is False and values["T_target_source"] is None
    assert values["rivals"][0]["T"] == T_TRUE.tolist()
    match_json = tmp_path / "match.json"
    done = run("match", folder / "base.ply", folder / "draft.ply", "-o", match_json)
    assert done.code == 3 and match_json.exists()
    merged = tmp_path / "c.ot"
    told(
        run(
            "merge", folder / "base.ply", folder / "draft.ply", "--match", match_json, "-o", merged
        ),
        "is a refused match, which gives no common map (two places are alike)",
    )
    assert not merged.exists()


def test_other_files_in_the_folder_stay(
    folder: Path, tmp_path: Path, run: Run, answer: Any
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    (out / "common.laz").write_text("of an earlier run")
    answer(False)
    assert run("run", folder / "base.ply", folder / "draft.ply", "-o", out, "-q").code == 3
    names = {path.name for path in out.iterdir()}
    assert names == {"notes.txt", "match.json", "config.json", "report.html"}


def test_the_same_file_twice_is_fine(folder: Path, tmp_path: Path, run: Run) -> None:
    path = tmp_path / "match.json"
    done = run("match", folder / "base.ply", folder / "base.ply", "-o", path, "-q")
    assert done.code == 0, done.err
    T = np.array(json.loads(path.read_text())["T_target_source"])
    np.testing.assert_allclose(T, np.eye(4), atol=0.02)


def test_another_place_is_refused(folder: Path, tmp_path: Path, run: Run) -> None:
    done = run("match", folder / "base.ply", folder / "other.ply", "-o", tmp_path / "m.json", "-q")
    assert done.code == 3


# Bad input


def bad_files(folder: Path) -> dict[str, tuple[bytes | None, str]]:
    """Return name -> (bytes, a word of the sentence) for files that are no maps."""
    whole = (folder / "base.ply").read_bytes()
    return {
        "missing.ply": (None, "missing.ply"),
        "empty.ply": (b"", "empty.ply"),
        "cut.ply": (whole[: len(whole) // 2], "cut.ply"),
        "wrong.laz": (whole, "wrong.laz"),
        "map.docx": (whole, "map.docx"),
        "one.xyz": (b"1 2 3\n", "point"),
        "nan.xyz": (b"nan nan nan\n" * 500, "nan.xyz"),
        "words.csv": (b"hello,world\nthis is,no map\n", "words.csv"),
    }


@pytest.mark.parametrize(
    "name",
    ["missing.ply", "empty.ply", "cut.ply", "wrong.laz", "map.docx", "one.xyz", "nan.xyz",
     "words.csv"],
)  # fmt: skip
@pytest.mark.parametrize("command", ["run", "match"])
def test_bad_maps_on_either_side(
    folder: Path, tmp_path: Path, run: Run, name: str, command: str
) -> None:
    content, word = bad_files(folder)[name]
    bad, out = tmp_path / name, tmp_path / "result"
    if content is not None:
        bad.write_bytes(content)
    before = sorted(tmp_path.iterdir())
    told(run(command, folder / "base.ply", bad, "-o", out, "-q"), word)
    told(run(command, bad, folder / "draft.ply", "-o", out, "-q"), word)
    assert sorted(tmp_path.iterdir()) == before


def test_a_folder_is_no_map(folder: Path, tmp_path: Path, run: Run) -> None:
    told(run("match", folder / "base.ply", tmp_path, "-q"), str(tmp_path))


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (("--resolution", "-1"), ("resolution must be a positive number of metres; -1 came",)),
        (("--resolution", "nan"), ("resolution",)),
        (("--resolution", "abc"), ("--resolution",)),
        (("--max-height", "0"), ("max_height must be a positive number",)),
        (("--metric", "klm"), ("'klm' came", "evidence", "kl, jeffreys, k,")),
        (("--level", "maybe"), ("auto, off", "'maybe' came")),
        (("--seed", "-3"), ("seed must not be negative",)),
        (("--config", "none.toml"), ("none.toml",)),
        (("--colour",), ("--colour", "--help")),
    ],
)
def test_bad_options(
    folder: Path, run: Run, words: tuple[str, ...], parts: tuple[str, ...]
) -> None:
    told(run("match", folder / "base.ply", folder / "draft.ply", "-q", *words), *parts)


def test_metric_of_a_configuration_is_checked(folder: Path, tmp_path: Path, run: Run) -> None:
    path = tmp_path / "c.json"
    path.write_text('{"search": {"metric": "klm"}}')
    told(run("match", folder / "base.ply", folder / "draft.ply", "--config", path), "'klm' came")


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ((), ""),
        (("match", "a.ply"), "DRAFT"),
        (("matsch",), "matsch"),
        (("merge", "a", "b"), "--match"),
    ],
)
def test_bad_command_lines(run: Run, words: tuple[str, ...], part: str) -> None:
    done = run(*words)
    if not words:
        assert done.code == 0 and "Usage" in done.out
    else:
        told(done, part)


def test_outputs_that_cannot_be_written_are_told_before_any_work(
    folder: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pipeline, "match", lambda *a, **k: pytest.fail("too late"))
    maps = (folder / "base.ply", folder / "draft.ply")
    file = tmp_path / "file"
    file.write_text("x")
    told(run("run", *maps, "-o", file), "a file of that name is there")
    told(run("run", *maps, "-o", tmp_path / "no" / "such"), "there is no folder")
    told(run("match", *maps, "-o", tmp_path), "it is a folder")
    told(run("match", *maps, "-o", tmp_path / "no" / "m.json"), "there is no folder")
    told(run("merge", *maps, "--match", file, "-o", tmp_path / "c.doc"), "c.doc", ".ot")
    assert file.read_text() == "x"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_no_permission_is_told(folder: Path, tmp_path: Path, run: Run) -> None:
    tmp_path.chmod(0o500)
    try:
        told(
            run("run", folder / "base.ply", folder / "draft.ply", "-o", tmp_path / "o"),
            "permission denied",
        )
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{", '{"accepted": true}', '{"accepted": true, "T_target_source": [[1, 2], [3, 4]]}',
     '{"accepted": true, "T_target_source": "abc"}', '{"accepted": true, "T_target_source": null}',
     '{"accepted": 1, "T_target_source": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}',
     '{"accepted": true, "T_target_source": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}',
     '{"accepted": true, "T_target_source": [[NaN,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}',
     "[" * 100_000],
)  # fmt: skip
def test_bad_match_files(folder: Path, tmp_path: Path, run: Run, text: str) -> None:
    path = tmp_path / "m.json"
    path.write_text(text)
    words = ("merge", folder / "base.ply", folder / "draft.ply", "--match", path)
    told(run(*words, "-o", tmp_path / "c.ot"), "m.json")
    assert not (tmp_path / "c.ot").exists()


def test_match_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        cli_results.read_pose(tmp_path / "m.json")


# Interrupted, disk full


def test_disk_full_is_one_sentence_and_leaves_nothing(
    folder: Path, tmp_path: Path, run: Run, answer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer(True)

    def full(fd: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    out = tmp_path / "out"
    told(run("run", folder / "base.ply", folder / "draft.ply", "-o", out, "-q"), "no space left")
    told(run("match", folder / "base.ply", folder / "draft.ply", "-o", out, "-q"), "no space left")
    assert list(tmp_path.iterdir()) == []
    # the sentence names the file as it would be called, not the unfinished one
    assert (
        f"cannot write {out}/"
        in run("run", folder / "base.ply", folder / "draft.ply", "-o", out).err
    )
    (out := tmp_path / "used").mkdir()
    (out / "mine.txt").write_text("kept")
    assert (
        f"cannot write {out}/"
        in run("run", folder / "base.ply", folder / "draft.ply", "-o", out).err
    )
    assert [path.name for path in out.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize("foreign", [False, True])
def test_interrupt_while_writing_leaves_what_was_there(
    folder: Path, tmp_path: Path, run: Run, answer: Any, monkeypatch: pytest.MonkeyPatch,
    foreign: bool,
) -> None:  # fmt: skip
    answer(True)
    out = tmp_path / "out"
    out.mkdir()
    (out / "match.json").write_text("older")
    if foreign:
        (out / "mine.txt").write_text("mine")
    before = sorted(path.name for path in out.iterdir())

    def stop(*args: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli_results, "write_report", stop)
    done = run("run", folder / "base.ply", folder / "draft.ply", "-o", out, "-q")
    assert done.code == 130
    assert done.err.strip() == "commonmap: interrupted; nothing was written"
    assert sorted(path.name for path in out.iterdir()) == before
    assert (out / "match.json").read_text() == "older"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_real_run_cleanly(
    folder: Path, tmp_path: Path, number: signal.Signals
) -> None:
    # A shell that starts us in the background makes us ignore SIGINT: undo that in the child
    listening = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from commonmap.cli import main; main()"
    )
    command = [
        sys.executable, "-c", listening, "run", str(folder / "base.ply"),
        str(folder / "draft.ply"), "-o", str(tmp_path / "out"),
    ]  # fmt: skip
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        if "height maps" in line or "search" in line:
            break
    time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert err.strip().splitlines()[-1] == "commonmap: interrupted; nothing was written"
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_within_compiled_code_is_an_interrupt(
    folder: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: Any, **options: Any) -> Match:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise SystemError("returned a result with an exception set") from error

    monkeypatch.setattr(pipeline, "match", interrupted)
    done = run("match", folder / "base.ply", folder / "draft.ply", "-q")
    assert done.code == 130 and done.err == "commonmap: interrupted; nothing was written\n"


def test_a_fault_of_ours_keeps_its_traceback(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "match", lambda *a, **k: 1 / 0)
    words = ["commonmap", "match", str(folder / "base.ply"), str(folder / "draft.ply"), "-q"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(ZeroDivisionError):
        cli.main()


def test_a_closed_pipe_is_no_error(folder: Path) -> None:
    command = f"{sys.executable} -m commonmap.cli metrics | head -n 1"
    done = subprocess.run(
        ["bash", "-c", command], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.startswith("evidence")
    assert done.stderr == ""


# The smaller commands


def test_info(folder: Path, run: Run) -> None:
    done = run("info", folder / "base.ply")
    assert done.code == 0
    assert "cloud" in done.out and "22 000" in done.out
    values = json.loads(run("info", "--json", folder / "base.ply").out)
    assert values["points"] == 22_000
    told(run("info", folder / "none.ply"), "none.ply")


def test_metrics_lists_the_whole_table(run: Run) -> None:
    from commonmap.metrics.table import METRICS

    done = run("metrics")
    assert done.code == 0
    assert {line.split()[0] for line in done.out.splitlines()} == set(METRICS)
    assert done.out.startswith("evidence") and "the default" in done.out.splitlines()[0]


def test_version_and_help(run: Run) -> None:
    from commonmap.version import __version__

    assert run("--version") == (0, f"commonmap {__version__}\n", "")
    for command in ("run", "match", "merge", "odometry", "demo", "simulate", "info", "metrics"):
        assert command in run("--help").out
        assert run(command, "--help").code == 0


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from commonmap import cli; sys.argv = ['commonmap', '--help']\n"
        "try: cli.main()\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'scipy', 'numba', 'rasterio', 'laspy', 'matplotlib', 'rich'}\n"
        "print(sorted(heavy & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert "Usage" in done.stdout
    assert done.stderr.strip() == "[]"


def test_frame_ids_are_names_that_ros_takes() -> None:
    assert cli_results.frame_ids(("uas.laz", "mls.laz")) == ("uas", "mls")
    assert cli_results.frame_ids(("my map (1).laz", "b-2.ply")) == ("my_map_1", "b_2")
    assert cli_results.frame_ids(("a.laz", "a.ply")) == ("base_map", "draft_map")
    assert cli_results.frame_ids(("1.laz", "ü.ply")) == ("base_map", "draft_map")


def test_simulate_checks_its_options(tmp_path: Path, run: Run) -> None:
    told(run("simulate", "-o", tmp_path / "s", "--scene", "moon", "-q"), "moon", "paper")
    told(run("demo", "-o", tmp_path / "d", "--scene", "moon", "-q"), "moon", "paper")
    assert list(tmp_path.iterdir()) == []


# Raw logs


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with uav/log.pcap, ugv/log.mcap and the true poses, 1.5 s of each."""
    from commonmap.sim.simulate import write_simulation

    folder = tmp_path_factory.mktemp("logs") / "sim"
    write_simulation(
        folder, "paper", np.random.default_rng(3), size=40.0, scans_every=0, margin=0.15,
        logs=("pcap", "mcap"), seconds=1.5,
    )  # fmt: skip
    return folder


@pytest.fixture
def placed(monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], Float64s]:
    """Return a way to have every pair of maps matched (or refused) at one pose."""
    T = from_xyz_yaw(7.0, -4.0, 1.5, 2.2)

    def put(accepted: bool) -> Float64s:
        def matched(target: Any, source: Any, **options: Any) -> Match:
            best = Candidate(T, 10.0, 0.9)
            return Match(
                accepted, "accepted: it fits" if accepted else "refused: alike",
                T if accepted else None, 0.9, None, None, 0.9, 10.0, 1.0, (best,), "evidence",
            )  # fmt: skip

        monkeypatch.setattr(pipeline, "match", matched)
        return T

    return put


def test_run_from_two_raw_logs(
    logs: Path, tmp_path: Path, run: Run, placed: Callable[[bool], Float64s]
) -> None:
    T = placed(True)
    out = tmp_path / "out"
    done = run("run", logs / "uav" / "log.pcap", logs / "ugv" / "log.mcap", "-o", out)
    assert done.code == 0, done.err
    assert {path.name for path in out.iterdir()} == set(cli_results.ENTRIES) - {"truth.json"}
    told_of = json.loads((out / "odometry.json").read_text(), parse_constant=pytest.fail)
    assert told_of["base"]["turns"] == told_of["draft"]["turns"] == 15
    assert told_of["draft"]["trajectory_frame"] == "base"
    assert told_of["base"]["name"] == "log.pcap"
    # the draft's way in the common frame begins where the pose puts the draft's origin
    base = read_trajectory(out / "base_trajectory.tum")
    draft = read_trajectory(out / "draft_trajectory.tum")
    assert base.T_map_sensor[0, :3, 3] == pytest.approx(np.zeros(3), abs=1e-9)
    assert draft.T_map_sensor[0, :3, 3] == pytest.approx(T[:3, 3], abs=1e-6)
    assert read_cloud(out / "base.laz").origin is not None
    report = (out / "report.html").read_text()
    assert "<h2>Odometry</h2>" in report and "log.mcap" in report

    placed(False)
    done = run("run", logs / "uav" / "log.pcap", logs / "ugv" / "log.mcap", "-o", out, "-q")
    assert done.code == 3 and done.err == ""
    assert not (out / "common.laz").exists() and (out / "draft.laz").exists()
    told_of = json.loads((out / "odometry.json").read_text())
    assert told_of["draft"]["trajectory_frame"] == "the draft's own map"
    draft = read_trajectory(out / "draft_trajectory.tum")
    assert draft.T_map_sensor[0, :3, 3] == pytest.approx(np.zeros(3), abs=1e-9)


def test_match_takes_a_log_and_a_map(
    logs: Path, folder: Path, tmp_path: Path, run: Run, placed: Callable[[bool], Float64s]
) -> None:
    placed(True)
    words = ("match", folder / "base.ply", logs / "ugv" / "log.mcap", "-o", tmp_path / "m.json")
    done = run(*words, "--odometry", "poses", "-q")
    assert done.code == 0 and done.err == ""
    assert json.loads((tmp_path / "m.json").read_text())["source"]["size"] > 10_000


def test_odometry_writes_the_way_and_the_map(logs: Path, tmp_path: Path, run: Run) -> None:
    way, cloud = tmp_path / "way.tum", tmp_path / "map.laz"
    done = run(
        "odometry", logs / "ugv" / "log.pcap", "-o", way, "--cloud", cloud, "--truth",
        logs / "ugv" / "truth.tum",
    )  # fmt: skip
    assert done.code == 0, done.err
    assert "15 turns" in done.out and "absolute error 0.0" in done.out
    assert len(read_trajectory(way).time) == 15
    written = read_cloud(cloud)
    assert len(written.xyz) > 10_000 and written.time is not None
    # the robot stands on the ground, its lidar 0.8 m up
    assert np.quantile(written.xyz[:, 2], 0.02) == pytest.approx(-0.8, abs=0.5)


def test_faults_of_logs_are_one_sentence(logs: Path, tmp_path: Path, run: Run) -> None:
    pcap, mcap = logs / "uav" / "log.pcap", logs / "ugv" / "log.mcap"
    out = tmp_path / "way.tum"
    told(run("odometry", pcap, "-o", out, "--odometry", "icp"), "loam, poses, kiss-icp", "'icp'")
    told(run("odometry", pcap, "-o", out, "--odometry", "poses"), "holds no poses", "--poses FILE")
    told(run("odometry", pcap, "-o", out, "--topic", "/x", "-q"), "no topic /x")
    told(run("odometry", tmp_path / "none.pcap", "-o", out), "none.pcap")
    told(run("odometry", pcap, "-o", out, "--cloud", tmp_path / "c.ot"), "file of points")
    told(run("run", pcap, mcap, "--poses", out, "-o", tmp_path / "o"), "2 expected, 1 came")
    broken = tmp_path / "broken.pcap"
    broken.write_bytes(pcap.read_bytes()[:200_000])
    told(run("odometry", broken, "-o", out, "-q"), "broken.pcap")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["broken.pcap"]


def test_odometry_of_maps_is_told(folder: Path, tmp_path: Path, run: Run) -> None:
    words = ("run", folder / "base.ply", folder / "draft.ply", "-o", tmp_path / "o")
    told(run(*words, "--odometry", "loam"), "raw logs")


def test_a_way_without_its_map_is_not_left(
    logs: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    from commonmap.io import las

    def full(*args: Any) -> Any:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(las, "_record", full)
    way, cloud = tmp_path / "way.tum", tmp_path / "map.laz"
    done = run("odometry", logs / "ugv" / "log.mcap", "-o", way, "--cloud", cloud, "-q")
    told(done, f"cannot write {cloud}: no space left on device")
    assert list(tmp_path.iterdir()) == []


def test_what_is_left_of_a_bag_is_read_where_it_is_asked_for(
    logs: Path, tmp_path: Path, run: Run
) -> None:
    data = (logs / "ugv" / "log.mcap").read_bytes()
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(data[: len(data) * 4 // 5])
    way = tmp_path / "way.tum"
    told(run("odometry", broken, "-o", way, "-q"), "broken.mcap", "--keep-partial")
    assert not way.exists()
    for more in ([], ["--odometry", "poses"]):
        done = run("odometry", broken, "-o", way, "--keep-partial", *more)
        assert done.code == 0, done.err
        assert "damaged" in done.err and 8 < len(read_trajectory(way).time) < 15
    assert "bag" in run("info", broken).out


def test_poses_of_a_topic_and_of_a_folder(logs: Path, tmp_path: Path, run: Run) -> None:
    way = tmp_path / "way.tum"
    done = run("odometry", logs / "ugv" / "log.mcap", "-o", way, "--poses", "/odom", "-q")
    assert done.code == 0, done.err
    true = read_trajectory(logs / "ugv" / "truth.tum")
    # the poses are taken as they are
    assert read_trajectory(way).T_map_sensor[0] == pytest.approx(true.T_map_sensor[0], abs=0.05)
    told(run("odometry", logs / "ugv" / "log.mcap", "-o", way, "--poses", "/odo"), "/odo")

    scans = list(iter_scans(logs / "ugv" / "log.pcap"))
    write_kitti(tmp_path / "kitti", scans)
    words = ("odometry", tmp_path / "kitti", "-o", way, "-q", "--odometry", "poses")
    told(run(*words), "holds no poses")
    shutil.copy(logs / "ugv" / "truth.tum", tmp_path / "kitti" / "truth.tum")
    assert run(*words).code == 0
    assert "truth.tum" in run("info", tmp_path / "kitti").out
    # KITTI keeps all poses in one folder: times and calibration are those of the scans
    rows = [" ".join(f"{x:.9g}" for x in T[:3].ravel()) for T in true.T_map_sensor[::5]]
    (tmp_path / "kitti" / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / "00.txt").write_text("\n".join(rows[: len(scans)]) + "\n")
    done = run(*words[:-2], "--poses", tmp_path / "00.txt")
    assert done.code == 0, done.err


def test_a_scan_that_is_cut_short_is_left_out_where_it_is_asked_for(
    logs: Path, tmp_path: Path, run: Run
) -> None:
    folder, way = tmp_path / "kitti", tmp_path / "way.tum"
    write_kitti(folder, list(iter_scans(logs / "ugv" / "log.pcap")))
    cut = folder / "velodyne" / "000007.bin"
    cut.write_bytes(cut.read_bytes()[:-7])
    (folder / "ring" / "000009.npy").unlink()
    told(run("odometry", folder, "-o", way, "-q"), "000009.npy is missing")
    done = run("odometry", folder, "-o", way, "--keep-partial")
    assert done.code == 0, done.err
    assert "000007.bin is truncated" in done.err and len(read_trajectory(way).time) == 13


def test_model_and_deskewing_are_options(logs: Path, tmp_path: Path, run: Run) -> None:
    way, pcap = tmp_path / "way.tum", logs / "ugv" / "log.pcap"
    told(run("odometry", pcap, "-o", way, "--model", "vlp-17"), "vlp-16", "'vlp-17'")
    assert run("odometry", pcap, "-o", way, "-q", "--model", "VLP-16").code == 0
    folder = tmp_path / "bin" / "velodyne"
    folder.mkdir(parents=True)
    for i, scan in enumerate(iter_scans(pcap)):
        np.column_stack([scan.xyz, scan.intensity]).tofile(folder / f"{i:06d}.bin")
    done = run("odometry", tmp_path / "bin", "-o", way, "--not-deskewed")
    assert done.code == 0 and "told from their azimuth" in done.err
    done = run("odometry", tmp_path / "bin", "-o", way, "--deskewed")
    assert done.code == 0 and "told from their azimuth" not in done.err

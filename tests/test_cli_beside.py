"""Two logs side by side: the same maps as one after the other; whatever ends one ends both."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest

from commonmap import cli_beside
from commonmap.cli_beside import take_both
from commonmap.cli_logs import LogOptions, take
from commonmap.cli_progress import telling
from commonmap.errors import InputError
from commonmap.sim.simulate import write_simulation

OPTIONS = [LogOptions(), LogOptions()]


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("beside") / "sim"
    write_simulation(
        folder, "paper", np.random.default_rng(3), size=40.0, scans_every=0, margin=0.15,
        logs=("pcap", "mcap"), seconds=1.5,
    )  # fmt: skip
    return [folder / "uav" / "log.pcap", folder / "ugv" / "log.mcap"]


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli_beside, "SMALL", 0)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})


def ignore(step: str, share: float = 0.0) -> None:
    pass


def test_maps_are_those_of_one_after_the_other(
    logs: list[Path], caplog: pytest.LogCaptureFixture
) -> None:
    told: dict[str, int] = {}

    def progress(step: str, share: float = 0.0) -> None:
        told[step] = threading.get_ident()

    with caplog.at_level(logging.INFO, "commonmap"):
        both = take_both(logs, OPTIONS, progress)
    notes = {record.getMessage() for record in caplog.records}
    # the second log was read elsewhere, and what it told was told here
    here = threading.get_ident()
    assert told["odometry of log.pcap"] == here != told["odometry of log.mcap"]
    caplog.clear()
    with caplog.at_level(logging.INFO, "commonmap"):
        alone = [take(path, options, ignore) for path, options in zip(logs, OPTIONS, strict=True)]
    assert notes == {record.getMessage() for record in caplog.records}
    assert any(note.startswith("log.mcap") for note in notes)
    for one, other in zip(both, alone, strict=True):
        assert one.robot is not None and other.robot is not None
        np.testing.assert_array_equal(one.robot.cloud.xyz, other.robot.cloud.xyz)
        np.testing.assert_array_equal(
            one.robot.trajectory.T_map_sensor, other.robot.trajectory.T_map_sensor
        )
    assert not multiprocessing.active_children()


def test_one_core_and_small_logs_need_no_process(
    logs: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli_beside, "_Beside", None)
    monkeypatch.setattr(cli_beside, "take", lambda path, options, progress: path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    assert [str(path) for path in take_both(logs, OPTIONS, ignore)] == [str(p) for p in logs]
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    monkeypatch.setattr(cli_beside, "SMALL", 10_000_000_000)
    assert [str(path) for path in take_both(logs, OPTIONS, ignore)] == [str(p) for p in logs]


def test_an_error_of_the_other_log_is_the_users(logs: list[Path], tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(logs[1].read_bytes()[:200_000])
    with pytest.raises(InputError, match=r"broken.mcap cannot be opened"):
        take_both([logs[0], broken], OPTIONS, ignore)
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("error", [InputError("here"), KeyboardInterrupt()])
def test_an_end_here_ends_the_other(
    logs: list[Path], error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(path: Path, options: LogOptions, progress: object) -> None:
        raise error

    monkeypatch.setattr(cli_beside, "take", fail)
    with pytest.raises(type(error)):
        take_both(logs, OPTIONS, ignore)
    assert not multiprocessing.active_children()


def test_a_process_that_is_killed_is_told(
    logs: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(path: Path, options: LogOptions, progress: object) -> None:
        (child,) = multiprocessing.active_children()
        assert child.pid is not None
        os.kill(child.pid, signal.SIGKILL)

    monkeypatch.setattr(cli_beside, "take", kill)
    with pytest.raises(InputError, match=r"log.mcap was not read to its end.*code -9"):
        take_both(logs, OPTIONS, ignore)


def test_steps_of_two_jobs_are_told_once_each(capsys: pytest.CaptureFixture[str]) -> None:
    with telling(quiet=False) as progress:
        for share in (0.0, 0.5, 1.0):
            for step in ("odometry of a", "odometry of b"):
                progress(step, share)
    assert [line.split("s  ")[1] for line in capsys.readouterr().err.splitlines()] == [
        "odometry of a", "odometry of b",
    ]  # fmt: skip

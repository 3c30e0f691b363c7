"""Raw logs of simulated robots: what was written comes back, and the truth fits it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commonmap.errors import InputError
from commonmap.frames import from_xyz_yaw, invert
from commonmap.io.logs import iter_scans, read_poses
from commonmap.io.trajectory import read_trajectory
from commonmap.odometry import georeference
from commonmap.sim.recording import fit_truth
from commonmap.sim.simulate import write_simulation
from commonmap.types import Cloud, Scan, Trajectory

TURNS = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a simulation of a small place with 0.6 s of each kind of raw log."""
    folder = tmp_path_factory.mktemp("logs") / "sim"
    write_simulation(
        folder, "paper", np.random.default_rng(3), size=40.0, scans_every=0, margin=0.15,
        logs=("pcap", "mcap", "kitti"), seconds=0.1 * TURNS,
    )  # fmt: skip
    return folder


@pytest.mark.parametrize("robot", ["uav", "ugv"])
def test_readers_give_back_the_same_robot(folder: Path, robot: str) -> None:
    kitti = list(iter_scans(folder / robot / "kitti"))
    mcap = list(iter_scans(folder / robot / "log.mcap"))
    pcap = list(iter_scans(folder / robot / "log.pcap"))
    assert len(kitti) == len(mcap) == len(pcap) == TURNS
    for a, b, c in zip(kitti, mcap, pcap, strict=True):
        assert np.array_equal(a.xyz, b.xyz)
        assert np.array_equal(a.ring, b.ring)
        assert np.abs(a.time - b.time).max() < 1e-7
        a, c = in_order(a), in_order(c)
        assert np.array_equal(a.ring, c.ring)
        assert np.abs(a.time - c.time).max() < 2e-6
        length_a, length_c = (np.linalg.norm(s.xyz, axis=1) for s in (a, c))
        assert np.abs(length_a - length_c).max() < 1.5e-3
        across = np.linalg.norm(a.xyz / length_a[:, None] - c.xyz / length_c[:, None], axis=1)
        assert np.degrees(across.max()) < 0.015


def in_order(scan: Scan) -> Scan:
    """Return the points of a scan in the order of channel and time."""
    order = np.lexsort((np.round(scan.time * 1e5), scan.ring))
    return replace(
        scan, xyz=scan.xyz[order], time=scan.time[order], ring=scan.ring[order],
        intensity=scan.intensity[order],
    )  # fmt: skip


def test_the_bag_holds_the_true_poses(folder: Path) -> None:
    true = read_trajectory(folder / "ugv" / "truth.tum")
    known = read_poses(folder / "ugv" / "log.mcap")
    # to the end of the last turn, as the log goes
    kept = true.time[::5] <= 0.1 * TURNS + 0.1
    assert 10 * (known.time[-1] - known.time[0]) >= TURNS
    assert known.time == pytest.approx(true.time[::5][kept], abs=1e-6)
    assert known.T_map_sensor == pytest.approx(true.T_map_sensor[::5][kept], abs=2e-6)


def test_unknown_kinds_are_told_before_any_work(tmp_path: Path) -> None:
    options: dict[str, Any] = {"logs": ("pcap", "bag")}
    with pytest.raises(InputError, match="'bag' came"):
        write_simulation(tmp_path / "s", "paper", np.random.default_rng(1), **options)
    assert list(tmp_path.iterdir()) == []


def test_the_truth_of_a_map_is_its_best_motion(folder: Path) -> None:
    true = read_trajectory(folder / "ugv" / "truth.tum")
    scans = list(iter_scans(folder / "ugv" / "kitti"))
    T_map_world = from_xyz_yaw(4.0, -30.0, 2.0, 1.1)
    T_map_world[:3, :3] = T_map_world[:3, :3] @ from_tilt(0.4)
    known = Trajectory(true.time, T_map_world @ true.T_map_sensor)
    cloud = joined(list(georeference(scans, known)))
    T_world_map, off = fit_truth(cloud, known, true)
    assert T_world_map == pytest.approx(invert(T_map_world), abs=1e-3)
    assert off < 2e-3
    # poses that run away by 0.3 m over the log bend the map: no motion is exact
    shift = np.tile(np.eye(4), (len(true.time), 1, 1))
    shift[:, 0, 3] = 0.5 * (true.time - true.time[0])
    bent = Trajectory(true.time, shift @ known.T_map_sensor)
    _, off = fit_truth(joined(list(georeference(scans, bent))), bent, true)
    assert off == pytest.approx(np.std(0.5 * np.linspace(0, 0.6, 100)), rel=0.3)


def from_tilt(angle: float) -> Any:
    """Return a rotation about x."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def joined(clouds: list[Cloud]) -> Cloud:
    """Return one cloud of several."""
    return Cloud(
        np.concatenate([c.xyz for c in clouds]),
        time=np.concatenate([c.time for c in clouds if c.time is not None]),
    )

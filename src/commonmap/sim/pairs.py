"""Two robots in one simulated place: their maps, each in its own frame, and the exact truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from commonmap.errors import InputError
from commonmap.frames import fit_motion, from_rotation, from_xyz_yaw, invert
from commonmap.sim.drift import add_drift
from commonmap.sim.missions import Area, Mission, drive, fly
from commonmap.sim.scanning import (
    RayCaster,
    Returns,
    place_points,
    scan_world,
    sensor_positions,
)
from commonmap.sim.vlp16 import LidarModel, find_lidar
from commonmap.sim.world import World
from commonmap.sim.world import change as change_world
from commonmap.sim.worlds import build_world
from commonmap.types import Bools, Cloud, Float64s, Trajectory

OVERLAP_CELL = 0.5
"""Edge of the cells in which overlap is counted, metres."""


@dataclass(frozen=True, eq=False)
class Pair:
    """What two robots recorded of one place, and the truth.

    target, source: clouds, each in its own frame, with time, intensity and ray origins.
    T_target_source: (4, 4) truth. With drift no rigid motion is exact: it is the best one over
        all points of the source (least squares), so it holds at the middle of the draft.
    target_trajectory, source_trajectory: poses of the lidar as each robot knows them, own frame.
    target_mission, source_mission: true poses of the lidar, in the world's frame.
    T_world_target, T_world_source: truth of each map's frame in the world.
    overlap: share of the cells (0.5 m, seen from above) that the source saw which the target saw.
    drift, tilt, change: as asked for.
    border: (3,) of a line a x + b y = c of the world, beyond which (> c) the target ends; None
        where it was not cut. reach: metres, of the source's returns.
    world, source_world: the place as the target, and as the source met it.
    seed_world: the seed that the place was built from.
    """

    kind: str
    target: Cloud
    source: Cloud
    T_target_source: Float64s
    target_trajectory: Trajectory
    source_trajectory: Trajectory
    target_mission: Mission
    source_mission: Mission
    T_world_target: Float64s
    T_world_source: Float64s
    overlap: float
    drift: float
    tilt: float
    change: float
    border: Float64s | None
    reach: float
    world: World
    source_world: World
    seed_world: int


@dataclass(frozen=True, eq=False)
class Plan:
    """A place and the true ways of two robots through it.

    world, source_world: the place as the drone, and as the ground robot met it. flight, ground:
    their missions. base_area, draft_area: where they went. seed_world: what the place is made of.
    """

    world: World
    source_world: World
    flight: Mission
    ground: Mission
    base_area: Area
    draft_area: Area
    seed_world: int


def plan_missions(
    kind: str | World, *, rng: np.random.Generator, seed_world: int | None = None,
    change: float = 0.0, size: float | None = None, relief: float | None = None,
    draft_size: float | None = None,
    height: float | None = None, pitch: float | None = None, margin: float = 0.0,
    seconds: float | None = None,
) -> Plan:  # fmt: skip
    """Return a place, a flight over all of it, and a drive in a part of it; see `simulate_pair`.

    kind: a name of `WORLDS`, or a world that is there already (`world_file.read_world`).
    seconds: a robot that would be back sooner goes slower, so that it is under way for so long.
    """
    if seed_world is None:
        seed_world = int(rng.integers(2**31))
    if isinstance(kind, World):
        if size is not None or relief is not None:
            raise InputError("a world that is there already has its size and its relief")
        world = kind
    else:
        world = build_world(kind, np.random.default_rng(seed_world), size=size, relief=relief)
    visited = change_world(world, change, rng) if change > 0 else world
    edge = draft_size if draft_size is not None else 0.45 * world.size
    room = max(0.0, (world.size - edge) / 2 - 2.0)
    x, y = rng.uniform(-room, room, 2)
    draft_area = Area(x, y, edge, edge, rng.uniform(0.0, 2 * np.pi) if room > 0.2 * edge else 0.0)
    base_area = Area(0.0, 0.0, world.size, world.size, float(rng.integers(4)) * np.pi / 2)
    ground = _lasting(lambda speed: drive(visited, draft_area, rng, speed=speed), 1.2, seconds, rng)
    span = (1.0 - 2.0 * margin) * world.size
    flown = Area(0.0, 0.0, span, span, base_area.yaw)
    height = float(rng.uniform(18.0, 30.0)) if height is None else height
    pitch = float(np.radians(rng.uniform(60.0, 90.0))) if pitch is None else pitch
    flight = _lasting(
        lambda speed: fly(world, flown, rng, height=height, pitch=pitch, speed=speed), 4.0,
        seconds, rng,
    )  # fmt: skip
    return Plan(world, visited, flight, ground, base_area, draft_area, seed_world)


def _lasting(
    go: Callable[[float], Mission], speed: float, seconds: float | None, rng: np.random.Generator
) -> Mission:
    """Return the mission at a speed, or at the slower one at which it lasts for some seconds."""
    state = rng.bit_generator.state
    mission = go(speed)
    while seconds is not None and np.ptp(mission.sensor.time) < seconds:
        speed *= 0.98 * float(np.ptp(mission.sensor.time)) / seconds
        rng.bit_generator.state = state
        mission = go(speed)
    return mission


def simulate_pair(
    kind: str | World,
    *,
    rng: np.random.Generator,
    seed_world: int | None = None,
    overlap: float = 1.0,
    drift: float = 0.0,
    target_drift: float = 0.0,
    tilt: float = 0.0,
    change: float = 0.0,
    lidar_target: str | LidarModel = "vlp16",
    lidar_source: str | LidarModel = "vlp16",
    size: float | None = None,
    relief: float | None = None,
    draft_size: float | None = None,
    height: float | None = None,
    pitch: float | None = None,
    margin: float = 0.0,
    max_range: float = 40.0,
    max_points: int = 1_500_000,
    azimuth_decimation: int = 4,
) -> Pair:
    """Return the maps of a drone (target) and a ground robot (source) of one place.

    kind: a name of `WORLDS`, or a world. seed_world: seed of the place, drawn from `rng` unless
        given.
    overlap: share of the source's cells that the target saw too; less than reachable is had by
        cutting the target along a line, as the border of a flight does. 1 leaves all there is.
    drift, target_drift: error of the poses, as share of the distance travelled.
    tilt: radians by which the source's frame is off level, about a random horizontal axis.
    change: share of the movable things that changed between the two visits.
    draft_size: metres, edge of the square that the ground robot drives in; 0.45 of the place
        unless given. size, relief: metres, of the place. height: metres, of the flight.
    pitch: radians that the drone's lidar looks down, drawn from 60 to 90 deg unless given.
    margin: share of the place along each border that the drone does not fly over. Beyond the border
        there is nothing, which no odometry survives that sees little else.
    max_range: metres that the ground robot's returns are kept to.
    max_points: of each cloud; more are thinned at random.
    azimuth_decimation: fire only every so many firing sequences; the drone, of which half looks
        at the sky, twice as many.
    """
    if not 0.0 < overlap <= 1.0:
        raise InputError(f"overlap must lie above 0 and up to 1; {overlap} came")
    # 1. where each robot goes
    plan = plan_missions(
        kind, rng=rng, seed_world=seed_world, change=change, size=size, relief=relief,
        draft_size=draft_size, height=height, pitch=pitch, margin=margin,
    )  # fmt: skip
    world, visited, ground, flight = plan.world, plan.source_world, plan.ground, plan.flight
    base_area, draft_area = plan.base_area, plan.draft_area

    # 2. what each lidar measures, in the world's frame
    caster = RayCaster(world)
    base = _survey(
        caster, flight, find_lidar(lidar_target), 2.0, rng, max(1, azimuth_decimation // 2)
    )
    if visited is not world:
        caster = RayCaster(visited)
    draft = _survey(caster, ground, find_lidar(lidar_source), 0.8, rng, azimuth_decimation)
    draft = _keep(draft, _within(draft, max_range))
    base_true, draft_true = _placed(base, flight), _placed(draft, ground)

    # 3. the border of the flight, so that the overlap is as asked
    kept = base_area.holds(base_true[:, :2])
    border = _border(base_true[kept], draft_true, overlap, draft_area)
    kept &= before_border(base_true, border)
    base, base_true = _keep(base, kept), base_true[kept]
    base, base_true = _thin(base, base_true, max_points, rng)
    draft, draft_true = _thin(draft, draft_true, max_points, rng)

    # 4. each robot's own frame and what it believes about its poses
    T_world_target = random_frame(rng, 0.0)
    T_world_source = random_frame(rng, tilt)
    target_known = _known(flight, T_world_target, target_drift, rng)
    source_known = _known(ground, T_world_source, drift, rng)
    target, source = _cloud(base, target_known), _cloud(draft, source_known)

    # 5. the truth: exact without drift, the best rigid motion with it
    T_world_target_fit, T_world_source_fit = T_world_target, T_world_source
    if target_drift > 0:
        T_world_target_fit = fit_motion(base_true, target.xyz)
    if drift > 0:
        T_world_source_fit = fit_motion(draft_true, source.xyz)
    return Pair(
        world.name, target, source, invert(T_world_target_fit) @ T_world_source_fit,
        target_known, source_known, flight, ground, T_world_target_fit, T_world_source_fit,
        measure_overlap(base_true, draft_true), drift, tilt, change,
        border, max_range, world, visited, plan.seed_world,
    )  # fmt: skip


def random_frame(rng: np.random.Generator, tilt: float) -> Float64s:
    """Return T_world_map of a map that starts anywhere, turned anyhow about z, off level by `tilt`.

    The offset is up to 100 m level and 20 m up; tilt in radians about a random horizontal axis.
    """
    x, y = rng.uniform(-100.0, 100.0, 2)
    T = from_xyz_yaw(x, y, rng.uniform(-20.0, 20.0), rng.uniform(-np.pi, np.pi))
    about = rng.uniform(0.0, 2 * np.pi)
    lean = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0]))
    return T @ from_rotation(lean.as_matrix())


def measure_overlap(target: Float64s, source: Float64s, *, cell: float = OVERLAP_CELL) -> float:
    """Return the share of the cells seen by the source (N, 3) that the target saw, same frame."""
    seen, shared = _seen_cells(target, source, cell)
    return len(shared) / len(seen)


def _seen_cells(target: Float64s, source: Float64s, cell: float) -> tuple[Float64s, Float64s]:
    """Return the middles of the cells that the source saw (N, 2), and of those that both saw."""
    at_target, at_source = (np.floor(p[:, :2] / cell).astype(np.int64) for p in (target, source))
    low, high = at_source.min(axis=0), at_source.max(axis=0) + 1
    by_source, by_target = np.zeros((2, *(high - low)), dtype=bool)
    by_source[tuple((at_source - low).T)] = True
    inside = ((at_target >= low) & (at_target < high)).all(axis=1)
    by_target[tuple((at_target[inside] - low).T)] = True
    return (
        (np.argwhere(by_source) + low + 0.5) * cell,
        (np.argwhere(by_source & by_target) + low + 0.5) * cell,
    )


def _survey(
    caster: RayCaster, mission: Mission, lidar: LidarModel, spacing: float,
    rng: np.random.Generator, azimuth_decimation: int,
) -> Returns:  # fmt: skip
    """Return the returns of one turn every `spacing` metres of a mission."""
    last = mission.sensor.time[-1] - 1.0 / lidar.rate
    stops = np.arange(0.0, mission.distance[-1], spacing)
    at = mission.sensor.time[np.searchsorted(mission.distance, stops)]
    stamps = np.unique(at[at <= last])
    return scan_world(
        caster, mission.sensor, lidar, stamps, rng=rng, azimuth_decimation=azimuth_decimation
    )


def _placed(returns: Returns, mission: Mission) -> Float64s:
    """Return the points where they truly are, world frame, (N, 3)."""
    return place_points(mission.sensor, returns.time, returns.xyz)


def _within(returns: Returns, max_range: float) -> Bools:
    """Return which returns are nearer than `max_range` metres."""
    return np.asarray(np.einsum("ij,ij->i", returns.xyz, returns.xyz) < max_range**2)


def _keep(returns: Returns, kept: Bools) -> Returns:
    """Return the returns where `kept`."""
    return Returns(
        returns.xyz[kept], returns.time[kept], returns.ring[kept], returns.intensity[kept],
        returns.turn[kept], returns.face[kept],
    )  # fmt: skip


def _thin(
    returns: Returns, true: Float64s, max_points: int, rng: np.random.Generator
) -> tuple[Returns, Float64s]:
    """Return at most `max_points` of the returns and of their true places, drawn at random."""
    if len(true) <= max_points:
        return returns, true
    kept = np.zeros(len(true), dtype=bool)
    kept[rng.choice(len(true), max_points, replace=False)] = True
    return _keep(returns, kept), true[kept]


def before_border(points: Float64s, border: Float64s | None) -> Bools:
    """Return which of (N, 3) points of the world lie on the target's side of its border."""
    if border is None:
        return np.ones(len(points), dtype=bool)
    return np.asarray(points[:, :2] @ border[:2] <= border[2])


def _border(base: Float64s, draft: Float64s, overlap: float, area: Area) -> Float64s | None:
    """Return the line at which to end the base so that `overlap` of the draft's cells is shared.

    It runs across the way from the middle of the place to the draft's area, so that the base keeps
    the larger part. None where the base shares no more than asked anyway.
    """
    seen, shared = _seen_cells(base, draft, OVERLAP_CELL)
    n_asked = round(overlap * len(seen))
    if len(shared) <= n_asked:
        return None
    away = np.array([area.x, area.y]) + 1e-9
    away /= np.linalg.norm(away)
    return np.array([*away, np.sort(shared @ away)[n_asked]])


def _known(
    mission: Mission, T_world_map: Float64s, drift: float, rng: np.random.Generator
) -> Trajectory:
    """Return the poses as the robot knows them, in its own frame."""
    drifted = add_drift(mission.sensor, mission.distance, drift, rng)
    return Trajectory(drifted.time, invert(T_world_map) @ drifted.T_map_sensor)


def _cloud(returns: Returns, known: Trajectory) -> Cloud:
    """Return the map that a robot makes of its returns with the poses that it knows."""
    return Cloud(
        xyz=place_points(known, returns.time, returns.xyz),
        intensity=returns.intensity,
        time=returns.time,
        origin=sensor_positions(known, returns.time).astype(np.float32),
    )

"""What the commands say on the terminal when they are done."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from commonmap.odometry import TrajectoryErrors
    from commonmap.types import Match


REFUSED = 3
"""Exit code of a match that was refused."""


def say_errors(name: str, errors: TrajectoryErrors) -> None:
    """Print how far a trajectory is from the truth."""
    print(
        f"{name}: {errors.way:.0f} m, absolute error {errors.ape:.3f} m (most "
        f"{errors.ape_max:.3f}), relative {100 * errors.relative:.2f} % and "
        f"{math.degrees(errors.turn):.4f} deg/m over {errors.stretch:.0f} m"
    )


def say_match(match: Match) -> None:
    """Print the verdict of a match, and its pose where there is one."""
    from commonmap.frames import apply, invert
    from commonmap.report.pose import pose_figures, sigma_figures

    print(match.reason)
    if match.areas is not None:
        n_areas = sum(area.T_target_source is not None for area in match.areas.items)
        print(f"{n_areas} areas by themselves: {100 * match.areas.agreeing:.0f} % find that pose")
        print(f"drift: {match.areas.reason}")
    if match.T_target_source is None:
        return
    pose = pose_figures(match.T_target_source)
    print(f"draft's origin in base: x {pose.x:.3f} m, y {pose.y:.3f} m, z {pose.z:.3f} m")
    if match.covariance_centre is not None:
        # Far from its origin a small turn moves a map by much: say where the map itself lies
        here = match.covariance_centre
        there = apply(invert(match.T_target_source), here[None])[0]
        print(
            "  the draft's point {:.2f}, {:.2f}, {:.2f} lies at {:.2f}, {:.2f}, {:.2f}".format(
                *there, *here
            )
        )
    print(
        f"  yaw {pose.yaw_deg:.3f}, pitch {pose.pitch_deg:.3f}, roll {pose.roll_deg:.3f} degrees; "
        f"confidence {math.floor(1000 * match.confidence) / 10:.1f} %, "
        f"overlap {100 * match.overlap:.0f} %"
    )
    if match.covariance is not None:
        s = sigma_figures(match.covariance)
        print(
            f"  one sigma: {s.x:.3f}, {s.y:.3f}, {s.z:.3f} m; "
            f"yaw {s.yaw_deg:.3f}, pitch {s.pitch_deg:.3f}, roll {s.roll_deg:.3f} degrees"
        )


def in_words(value: Any) -> str:
    """Return a value as a person would write it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", " ")
    if isinstance(value, float):
        return f"{value:.6g}" if abs(value) < 1e5 else f"{value:.3f}"
    if isinstance(value, list):
        return ", ".join(in_words(item) for item in value) or "none"
    return str(value)

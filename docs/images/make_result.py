"""Draw docs/images/result.png: the real drone and ground lidar of one forest plot, matched.

    python docs/images/make_result.py ../shared/data/air-ground/uas.laz ../shared/data/air-ground/mls.laz

The ground cloud is first moved by 63 m and turned by 140 degrees, and the software is not told.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np

import commonmap
from commonmap.frames import apply, from_xyz_yaw
from commonmap.types import Cloud

matplotlib.use("Agg")
import matplotlib.pyplot as plt

AIR, GROUND = "#2a78d6", "#d9541e"


def main() -> None:
    """Match, and draw plan and section before and after."""
    base = commonmap.read_map(sys.argv[1])
    draft = commonmap.read_map(sys.argv[2])
    origin = base.xyz.mean(axis=0)
    displaced = from_xyz_yaw(52.0, -36.0, 4.0, np.radians(140.0))
    target = base.xyz - origin
    source = apply(displaced, draft.xyz - origin)
    match = commonmap.match(Cloud(xyz=target), Cloud(xyz=source))
    print(match.reason)
    assert match.T_target_source is not None
    placed = apply(match.T_target_source, source)

    figure, axes = plt.subplots(
        1, 3, figsize=(12, 5.0), dpi=95, gridspec_kw={"width_ratios": [1.35, 1, 1.15]}
    )
    rng = np.random.default_rng(0)

    def dots(axis: plt.Axes, x: np.ndarray, y: np.ndarray, colour: str, n: int) -> None:
        pick = rng.permutation(len(x))[:n]
        axis.plot(x[pick], y[pick], ".", ms=0.5, color=colour, alpha=0.35, rasterized=True)

    dots(axes[0], target[:, 0], target[:, 1], AIR, 25_000)
    dots(axes[0], source[:, 0], source[:, 1], GROUND, 25_000)
    axes[0].set_title("handed in: no GPS, no guess (plan)")
    low_t, low_p = target[:, 2] < np.quantile(target[:, 2], 0.45), placed[:, 2] < 12
    dots(axes[1], target[low_t, 0], target[low_t, 1], AIR, 25_000)
    dots(axes[1], placed[low_p, 0], placed[low_p, 1], GROUND, 25_000)
    axes[1].set_title("handed back: one map (plan)")
    for xyz, colour in ((target, AIR), (placed, GROUND)):
        strip = np.abs(xyz[:, 1] - 2.0) < 1.5
        dots(axes[2], xyz[strip, 0], xyz[strip, 2], colour, 40_000)
    axes[2].set_title("a section 3 m thick")
    for axis in axes:
        axis.set_aspect("equal", anchor="S")
        axis.tick_params(labelsize=7)
        axis.set_xlabel("m", fontsize=7)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    figure.text(0.01, 0.01, "drone", color=AIR, weight="bold")
    figure.text(0.06, 0.01, "ground robot", color=GROUND, weight="bold")
    figure.text(0.16, 0.01, match.reason, fontsize=8)
    figure.tight_layout(rect=(0, 0.04, 1, 0.97))
    figure.savefig(Path(__file__).parent / "result.png")


if __name__ == "__main__":
    main()

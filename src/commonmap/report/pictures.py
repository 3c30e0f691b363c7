"""Pictures of the page: grids as PNG inside SVG, curves as SVG. They follow the page's colours."""

from __future__ import annotations

import base64
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from commonmap.types import Float64s

Rgba = NDArray[np.uint8]

VIRIDIS = np.array(
    [
        [68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142],
        [31, 158, 137], [53, 183, 121], [109, 205, 89], [180, 222, 44], [253, 231, 37],
    ],
    dtype=np.float64,
)  # fmt: skip
"""Ten colours of matplotlib's viridis, evenly spaced."""


@dataclass(frozen=True)
class Mark:
    """A labelled ring on a picture. x, y: data coordinates."""

    x: float
    y: float
    label: str
    strong: bool = False


@dataclass(frozen=True)
class Arrow:
    """An arrow on a picture from x, y by dx, dy; data coordinates."""

    x: float
    y: float
    dx: float
    dy: float


def to_png(rgba: Rgba) -> bytes:
    """Return a PNG of (rows, columns, 4) bytes, top row first."""
    rows, columns = rgba.shape[:2]
    raw = np.zeros((rows, 1 + 4 * columns), np.uint8)
    raw[:, 1:] = rgba.reshape(rows, -1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        checksum = zlib.crc32(kind + data)
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", checksum)

    header = struct.pack(">IIBBBBB", columns, rows, 8, 6, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(raw.tobytes(), 9))
        + chunk(b"IEND", b"")
    )


def to_rows(layer: NDArray[Any]) -> NDArray[Any]:
    """Return a grid layer (nx, ny, ...) as rows of a picture: greatest y on top."""
    return np.swapaxes(layer, 0, 1)[::-1]


def shade(values: NDArray[Any], low: float, high: float) -> Rgba:
    """Return (nx, ny, 4) viridis colours of values between `low` and `high`; NaN is clear."""
    known = np.isfinite(values)
    t = np.clip((np.where(known, values, low) - low) / max(high - low, 1e-12), 0.0, 1.0)
    at = t * (len(VIRIDIS) - 1)
    left = np.minimum(at.astype(np.int64), len(VIRIDIS) - 2)
    part = (at - left)[..., None]
    rgba = np.zeros((*values.shape, 4), np.uint8)
    rgba[..., :3] = np.round(VIRIDIS[left] * (1.0 - part) + VIRIDIS[left + 1] * part)
    rgba[..., 3] = np.where(known, 255, 0)
    return rgba


def paint(classes: NDArray[Any], colours: dict[int, tuple[int, int, int, int]]) -> Rgba:
    """Return (nx, ny, 4) colours of classes; a class without colour is clear."""
    rgba = np.zeros((*classes.shape, 4), np.uint8)
    for value, colour in colours.items():
        rgba[classes == value] = colour
    return rgba


def density(xy: Float64s, origin: Float64s, cell: float, shape: tuple[int, int]) -> Float64s:
    """Return (nx, ny) how full each cell is, 0 to 1: the logarithm of its points."""
    ij = np.floor((xy - origin) / cell).astype(np.int64)
    inside = ((ij >= 0) & (ij < np.array(shape))).all(axis=1)
    flat = ij[inside, 0] * shape[1] + ij[inside, 1]
    count = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape).astype(np.float64)
    full = np.quantile(count[count > 0], 0.9) if (count > 0).any() else 1.0
    return np.asarray(np.clip(np.log1p(count) / np.log1p(full), 0.0, 1.0))


def overlay(
    base: Float64s, draft: Float64s, colours: tuple[Sequence[int], Sequence[int], Sequence[int]]
) -> Rgba:
    """Return (nx, ny, 4): base, draft and where they meet, by their densities (nx, ny) 0 to 1."""
    meet = np.minimum(base, draft)
    weight = np.stack([base - meet, draft - meet, 2.0 * meet])
    total = np.maximum(weight.sum(axis=0), 1e-9)
    rgba = np.zeros((*base.shape, 4), np.uint8)
    mixed = np.tensordot(weight / total, np.array(colours, dtype=np.float64), axes=(0, 0))
    rgba[..., :3] = np.round(mixed)
    strongest = np.maximum(base, draft)
    rgba[..., 3] = np.round(255.0 * np.where(strongest > 0, 0.35 + 0.65 * strongest, 0.0))
    return rgba


def map_figure(
    rgba: Rgba,
    *,
    origin: Float64s,
    cell: tuple[float, float],
    alt: str,
    marks: Sequence[Mark] = (),
    x_name: str = "x",
    y_name: str = "y",
    scale: tuple[float, float, str] | None = None,
    arrows: Sequence[Arrow] = (),
) -> str:
    """Return an SVG of a grid picture (nx, ny, 4) with axes in metres, marks and arrows.

    origin: (2,) data coordinates of the lower left corner. scale: (low, high, name) draws a bar of
    the viridis colours.
    """
    n_x, n_y = rgba.shape[:2]
    width_m, height_m = n_x * cell[0], n_y * cell[1]
    room = 500.0
    per_metre = min(room / width_m, 460.0 / height_m)
    w, h = width_m * per_metre, height_m * per_metre
    left, top = 52.0 + 0.5 * (room - w), 12.0
    total_w, total_h = 52.0 + room + (62.0 if scale else 14.0), top + h + 44.0
    offset = _offset(origin, width_m, height_m)
    # A picture drawn small is sharper, one drawn large shows its cells
    data = base64.b64encode(to_png(np.ascontiguousarray(to_rows(rgba)))).decode("ascii")
    parts = [
        f'<svg class="plot" role="img" viewBox="0 0 {total_w:.0f} {total_h:.0f}" '
        f'xmlns="http://www.w3.org/2000/svg"><title>{escape(alt)}</title>'
    ]
    parts += _axes(
        left, top, w, h, (origin[0] - offset[0], origin[1] - offset[1]), per_metre,
        (_axis_name(x_name, offset[0]), _axis_name(y_name, offset[1])),
    )  # fmt: skip
    parts.append(
        f'<image x="{left:.1f}" y="{top:.1f}" width="{w:.1f}" height="{h:.1f}" '
        f'preserveAspectRatio="none" href="data:image/png;base64,{data}"/>'
    )
    for arrow in arrows:
        u = left + (arrow.x - origin[0]) * per_metre
        v = top + h - (arrow.y - origin[1]) * per_metre
        parts.append(_arrow(u, v, arrow.dx * per_metre, -arrow.dy * per_metre))
    for mark in marks:
        u = left + (mark.x - origin[0]) * per_metre
        v = top + h - (mark.y - origin[1]) * per_metre
        if left <= u <= left + w and top <= v <= top + h:
            parts.append(_ring(u, v, mark))
    if scale:
        parts.append(_colour_bar(left + w + 14.0, top, min(h, 220.0), scale))
    return "".join([*parts, "</svg>"])


def curve_figure(
    x: Float64s,
    y: Float64s,
    *,
    alt: str,
    level: tuple[float, str] | None = None,
    marks: Sequence[Mark] = (),
    x_name: str = "yaw, degrees",
    y_name: str = "best score",
    ticks: Sequence[float] = (-180, -90, 0, 90, 180),
) -> str:
    """Return an SVG of a curve; level: a dashed horizontal line (value, name)."""
    finite = np.isfinite(y)
    values = [*y[finite].tolist(), *([level[0]] if level else [])]
    low, high = min([0.0, *values]), max([1e-9, *values])
    high += 0.1 * (high - low)
    left, top, w, h = 66.0, 14.0, 500.0, 300.0

    def at(px: float, py: float) -> tuple[float, float]:
        return (
            left + (px - ticks[0]) / (ticks[-1] - ticks[0]) * w,
            top + h - (py - low) / (high - low) * h,
        )

    parts = [
        f'<svg class="plot" role="img" viewBox="0 0 {left + w + 20:.0f} {top + h + 44:.0f}" '
        f'xmlns="http://www.w3.org/2000/svg"><title>{escape(alt)}</title>'
    ]
    for tick in nice_ticks(low, high, 5):
        v = at(0, tick)[1]
        parts.append(f'<line class="grid" x1="{left}" x2="{left + w}" y1="{v:.1f}" y2="{v:.1f}"/>')
        parts.append(f'<text x="{left - 8}" y="{v + 4:.1f}" text-anchor="end">{_tick(tick)}</text>')
    for tick in ticks:
        u = at(tick, low)[0]
        parts.append(
            f'<text x="{u:.1f}" y="{top + h + 18:.1f}" text-anchor="middle">{_tick(tick)}</text>'
        )
    parts.append(f'<line class="axis" x1="{left}" x2="{left + w}" y1="{top + h}" y2="{top + h}"/>')
    path = " ".join(
        f"{'L' if i else 'M'}{u:.1f} {v:.1f}"
        for i, (u, v) in enumerate(at(a, b) for a, b in zip(x[finite], y[finite], strict=True))
    )
    parts.append(f'<path class="curve" d="{path}"/>')
    if level:
        v = at(0, level[0])[1]
        parts.append(f'<line class="decoy" x1="{left}" x2="{left + w}" y1="{v:.1f}" y2="{v:.1f}"/>')
        parts.append(
            f'<text class="strong" x="{left + w - 4}" y="{v - 6:.1f}" text-anchor="end">'
            f"{escape(level[1])}</text>"
        )
    for mark in marks:
        u, v = at(mark.x, mark.y)
        parts.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="4" fill="var(--accent)"/>')
        parts.append(
            f'<text class="strong" x="{u:.1f}" y="{v - 9:.1f}" text-anchor="middle">'
            f"{escape(mark.label)}</text>"
        )
    parts.append(
        f'<text x="{left + w / 2}" y="{top + h + 38}" text-anchor="middle">{escape(x_name)}</text>'
        f'<text x="14" y="{top + h / 2}" text-anchor="middle" '
        f'transform="rotate(-90 14 {top + h / 2})">{escape(y_name)}</text></svg>'
    )
    return "".join(parts)


def nice_ticks(low: float, high: float, wish: int) -> list[float]:
    """Return about `wish` round numbers between low and high."""
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return [low]
    step = 10.0 ** math.floor(math.log10(span / wish))
    step *= min((1.0, 2.0, 5.0, 10.0), key=lambda factor: abs(span / (step * factor) - wish))
    first = math.ceil(low / step - 1e-9)
    return [step * n for n in range(first, math.floor(high / step + 1e-9) + 1)]


def _offset(origin: Float64s, width: float, height: float) -> tuple[float, float]:
    """Return round numbers to take from large coordinates, so that ticks can be read."""
    step = 10.0 ** max(2, math.ceil(math.log10(max(width, height))))
    x, y = (
        math.floor(value / step) * step if abs(value) >= 100.0 * step else 0.0
        for value in (float(origin[0]), float(origin[1]))
    )
    return x, y


def _axis_name(name: str, offset: float) -> str:
    return f"{name} − {offset:.0f} m" if offset else f"{name}, m"


def _axes(
    left: float, top: float, w: float, h: float, low: tuple[float, float], per_metre: float,
    names: tuple[str, str],
) -> list[str]:  # fmt: skip
    parts = []
    for tick in nice_ticks(low[0], low[0] + w / per_metre, 6):
        u = left + (tick - low[0]) * per_metre
        parts.append(
            f'<line class="grid" x1="{u:.1f}" x2="{u:.1f}" y1="{top}" y2="{top + h:.1f}"/>'
            f'<text x="{u:.1f}" y="{top + h + 17:.1f}" text-anchor="middle">{_tick(tick)}</text>'
        )
    for tick in nice_ticks(low[1], low[1] + h / per_metre, 6):
        v = top + h - (tick - low[1]) * per_metre
        parts.append(
            f'<line class="grid" x1="{left:.1f}" x2="{left + w:.1f}" y1="{v:.1f}" y2="{v:.1f}"/>'
            f'<text x="{left - 7:.1f}" y="{v + 4:.1f}" text-anchor="end">{_tick(tick)}</text>'
        )
    parts.append(
        f'<rect class="axis" x="{left:.1f}" y="{top}" width="{w:.1f}" height="{h:.1f}"/>'
        f'<text x="{left + w / 2:.1f}" y="{top + h + 36:.1f}" text-anchor="middle">'
        f"{escape(names[0])}</text>"
        f'<text x="{left - 42:.1f}" y="{top + h / 2:.1f}" text-anchor="middle" '
        f'transform="rotate(-90 {left - 42:.1f} {top + h / 2:.1f})">{escape(names[1])}</text>'
    )
    return parts


def _arrow(u: float, v: float, du: float, dv: float) -> str:
    length = math.hypot(du, dv)
    if length < 0.5:  # a dot
        return f'<circle class="mark" cx="{u:.1f}" cy="{v:.1f}" r="0.8"/>'
    head = min(5.0, 0.5 * length) / length
    tip_u, tip_v = u + du, v + dv
    barbs = " ".join(
        f"L{tip_u - head * (du + side * 0.6 * dv):.1f} {tip_v - head * (dv - side * 0.6 * du):.1f} "
        f"L{tip_u:.1f} {tip_v:.1f}"
        for side in (1.0, -1.0)
    )
    path = f"M{u:.1f} {v:.1f} L{tip_u:.1f} {tip_v:.1f} {barbs}"
    return "".join(f'<path class="{kind}" d="{path}"/>' for kind in ("mark-under", "mark"))


def _ring(u: float, v: float, mark: Mark) -> str:
    r = 9 if mark.strong else 7
    rings = "".join(
        f'<circle class="{kind}" cx="{u:.1f}" cy="{v:.1f}" r="{r}"/>'
        for kind in ("mark-under", "mark")
    )
    return (
        f"{rings}"
        f'<text class="mark-text" x="{u + r + 4:.1f}" y="{v + 4:.1f}">{escape(mark.label)}</text>'
    )


def _colour_bar(x: float, top: float, h: float, scale: tuple[float, float, str]) -> str:
    low, high, name = scale
    ramp = shade(np.linspace(0.0, 1.0, 64)[None, :], 0.0, 1.0)
    data = base64.b64encode(to_png(np.ascontiguousarray(to_rows(ramp)))).decode("ascii")
    labels = "".join(
        f'<text x="{x + 15:.1f}" y="{top + h - (tick - low) / max(high - low, 1e-12) * h + 4:.1f}">'
        f"{_tick(tick)}</text>"
        for tick in nice_ticks(low, high, 4)
    )
    return (
        f'<image x="{x:.1f}" y="{top}" width="11" height="{h:.1f}" preserveAspectRatio="none" '
        f'href="data:image/png;base64,{data}"/>{labels}'
        f'<text x="{x:.1f}" y="{top + h + 18:.1f}">{escape(name)}</text>'
    )


def _tick(value: float) -> str:
    if abs(value) >= 1e5 or (value != 0 and abs(value) < 1e-3):
        return f"{value:.3g}".replace("-", "−")
    return f"{value:.10g}".replace("-", "−")

"""The report: complete in itself, safe with any text, true to its numbers."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
import subprocess
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commonmap import pipeline
from commonmap.config import Config
from commonmap.frames import apply, from_quaternion, from_xyz_yaw, invert
from commonmap.report import pictures, write_report
from commonmap.report.points import RECORD, Box, encode, take_evenly, thin
from commonmap.report.pose import (
    pose_figures,
    sigma_figures,
    static_transform_command,
    to_json,
)
from commonmap.report.tables import fixed, number
from commonmap.types import Candidate, Cloud, Match, SearchPicture

T = from_xyz_yaw(3.0, -2.0, 0.5, np.radians(30.0))


def make_match(*, accepted: bool = True) -> Match:
    """Return a match with every field filled."""
    x, y = np.linspace(-5, 15, 41), np.linspace(-10, 10, 31)
    score = np.exp(-((x[:, None] - 3) ** 2) - (y[None, :] + 2) ** 2) * 100
    score[:5] = np.nan
    yaw = np.linspace(-np.pi, np.pi, 60)
    rivals = (Candidate(from_xyz_yaw(8, 1, 0, -1.0), 40.0, 0.5),)
    best = Candidate(T, 100.0, 0.8)
    return Match(
        accepted=accepted,
        reason="accepted: it fits" if accepted else "refused: <b>two</b> places are alike",
        T_target_source=T if accepted else None,
        confidence=0.99999 if accepted else 0.3,
        covariance=np.diag([0.01, 0.04, 0.09, 1e-6, 4e-6, 9e-6]) if accepted else None,
        covariance_centre=np.array([3.0, -2.0, 0.5]) if accepted else None,
        overlap=0.8,
        score=100.0,
        decoy_score=20.0,
        rivals=rivals if accepted else (best, *rivals),
        metric="evidence",
        evidence={"decoy_ratio": 5.0, "new <figure>": float("nan")},
        timings={"search": 1.5, "refine": 0.5},
        picture=SearchPicture(score, x, y, np.zeros(3), yaw, 100 * np.cos(yaw / 2) ** 8, 20.0),
    )


def make_maps(n: int = 4000) -> tuple[Cloud, Cloud]:
    """Return a yard with a few boxes, and the same from the source's frame."""
    rng = np.random.default_rng(5)
    ground = np.column_stack([rng.uniform(-10, 10, (n, 2)), np.zeros(n)])
    corners = rng.uniform(-8, 8, (6, 1, 2))
    boxes = np.concatenate(
        [corners + rng.uniform(0, 1.5, (6, 150, 2)), rng.uniform(0, 2, (6, 150, 1))], 2
    )
    xyz = np.concatenate([ground, boxes.reshape(-1, 3)])
    return Cloud(xyz), Cloud(apply(invert(T), xyz[::2]))


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., str]:
    def written(match: Match, **options: Any) -> str:
        target, source = make_maps()
        path = tmp_path / "report.html"
        write_report(path, target=target, source=source, match=match, config=Config(), **options)
        return path.read_text(encoding="utf-8")

    return written


@pytest.fixture
def accepted(write: Callable[..., str]) -> str:
    common = pipeline.merge_maps(*make_maps(), T)
    return write(make_match(), common=common, names=("uas.laz", "mls.laz"), error=(0.021, 0.001))


def test_page_loads_nothing_from_elsewhere(accepted: str) -> None:
    addresses = set(re.findall(r"(?:https?:)?//[a-z][\w.-]+\.[a-z]+", accepted))
    assert addresses <= {"http://www.w3.org"}  # the name of SVG, which nobody fetches
    assert not re.search(r"<link|<iframe|<img|@import|url\(|src=", accepted)
    for href in re.findall(r'href="([^"]*)"', accepted):
        assert href.startswith("data:image/png;base64,")
    assert len(accepted) < 6_000_000


def test_page_says_what_the_match_says(accepted: str) -> None:
    text = html.unescape(re.sub(r"<[^>]+>", " ", accepted))
    for words in (
        "Accepted", "It fits.", "3.00 m", "−2.00 m", "30.00 °", "± 0.100 m", "± 0.200 m", "99.9 %",
        "The truth is known here: the answer is 0.021 m and 0.057°", "decoy ratio", "common octree",
        "Who saw what", "--frame-id base_map --child-frame-id draft_map", '"metric": "evidence"',
    ):  # fmt: skip
        assert words in text, words
    assert "100.0 %" not in text  # a confidence is never rounded up to certainty
    assert "NaN" not in accepted.split("<script>")[0]


def test_refused_page_shows_no_pose_as_an_answer(write: Callable[..., str]) -> None:
    page = write(make_match(accepted=False))
    assert "Refused" in page
    assert "No common map was made" in page
    assert "static_transform_publisher" not in page
    assert "&lt;b&gt;two&lt;/b&gt; places are alike." in page
    assert 'data-set="common"' not in page


def test_nothing_found_at_all(write: Callable[..., str]) -> None:
    match = replace(make_match(accepted=False), rivals=(), picture=None, evidence={})
    page = write(match)
    assert "The search found no other pose" in page
    assert 'data-set="draft"' not in page


def test_every_text_from_outside_is_escaped(write: Callable[..., str]) -> None:
    evil = "</script><script>alert(1)</script>.laz"
    page = write(make_match(), names=(evil, 'a"b<i>'), notes=["<img onerror=x>"])
    assert "alert(1)</script>" not in page
    assert "<i>" not in page and "<img" not in page and "new <figure>" not in page
    assert page.count("<script") == page.count("</script>") == 2


def test_headings_and_pictures_are_accessible(accepted: str) -> None:
    assert accepted.count("<h1") == 1
    svgs = re.findall(r"<svg.*?</svg>", accepted, flags=re.S)
    assert len(svgs) == 6
    assert all('role="img"' in svg and "<title>" in svg for svg in svgs)
    assert 'lang="en"' in accepted
    assert 'aria-label="Points of both maps' in accepted


def test_viewer_data_is_where_the_points_are(accepted: str) -> None:
    found = re.search(r'id="viewer-data">(.*?)</script>', accepted, flags=re.S)
    assert found is not None
    data = json.loads(found[1])
    assert [s["name"] for s in data["sets"]] == ["base", "draft", "common"]
    base, draft = (np.frombuffer(base64.b64decode(s["points"]), RECORD) for s in data["sets"][:2])
    half = np.array(data["half"])
    assert half[0] == pytest.approx(10.4, abs=0.4)
    np.testing.assert_allclose(
        (base["xyz"] / 32767.0 * half).mean(axis=0), (draft["xyz"] / 32767.0 * half).mean(axis=0),
        atol=0.3,
    )  # fmt: skip
    assert set(base["seen_by"]) == {1}
    assert set(draft["seen_by"]) == {2}


@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_viewer_paints_in_a_browser(accepted: str, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    page.write_text(accepted, encoding="utf-8")
    command = [
        "chromium", "--headless", "--no-sandbox", "--disable-gpu", "--use-gl=swiftshader",
        "--enable-unsafe-swiftshader", f"--user-data-dir={tmp_path / 'profile'}",
        "--virtual-time-budget=3000", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=90, check=False)
    canvas = re.search(r"<canvas[^>]*>", done.stdout)
    if canvas is None:
        pytest.skip("chromium does not start here")
    if "shows no 3D" in done.stdout.split("<script", 2)[1]:
        pytest.skip("this chromium has no WebGL")
    assert 'data-painted="0"' in canvas[0]


# Parts


def test_quantised_points_are_within_half_a_step() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-100, 100, (500, 3)) * [1, 1, 0.1] + [4.7e5, 3.8e6, 0]
    box = Box(np.array([4.7e5, 3.8e6, 0.0]), np.array([100.0, 100.0, 10.0]))
    text = encode(xyz, np.linspace(0, 4, 500), np.full(500, 2, np.uint8), box, top=2.0)
    record = np.frombuffer(base64.b64decode(text), RECORD)
    assert record.dtype.itemsize == 8
    back = box.centre + record["xyz"] / 32767.0 * box.half
    assert (np.abs(back - xyz) <= box.half / 32767.0 / 2 * 1.001 + 1e-9).all()
    assert record["height"][0] == 0 and record["height"][-1] == 255
    outside = encode(
        xyz + np.array([500.0, 0, 0]), np.zeros(500), np.zeros(500, np.uint8), box, top=1.0
    )
    assert outside == ""


def test_thinning_keeps_the_whole_extent() -> None:
    rng = np.random.default_rng(1)
    dense = rng.normal(0, 0.2, (50_000, 3))
    sparse = rng.uniform(-20, 20, (2_000, 3))
    xyz = np.concatenate([dense, sparse])
    index = thin(xyz, 3_000)
    assert 2_000 < len(index) <= 3_000
    assert (np.diff(index) > 0).all()
    assert (
        index >= 50_000
    ).sum() > 400  # of about 115 by chance: the thinly seen part is not crowded out
    np.testing.assert_array_equal(thin(xyz, 60_000), np.arange(52_000))


def test_take_evenly_has_no_period() -> None:
    index = take_evenly(16 * 1000, 1000)
    assert len(index) == pytest.approx(1000, abs=2)
    assert np.bincount(index % 16, minlength=16).min() > 50  # each ring of a lidar is kept


def test_png_rows_run_from_the_greatest_y() -> None:
    layer = np.zeros((2, 3, 4), np.uint8)  # nx = 2, ny = 3
    layer[0, 2] = [10, 20, 30, 255]  # x low, y high: upper left
    layer[1, 0] = [40, 50, 60, 255]  # x high, y low: lower right
    png = pictures.to_png(np.ascontiguousarray(pictures.to_rows(layer)))
    assert png[16:24] == (2).to_bytes(4, "big") + (3).to_bytes(4, "big")
    start = png.index(b"IDAT") + 4
    raw = np.frombuffer(zlib.decompress(png[start:]), np.uint8).reshape(3, 9)
    assert raw[0, 1:5].tolist() == [10, 20, 30, 255]
    assert raw[2, 5:9].tolist() == [40, 50, 60, 255]


def test_mark_stands_where_its_coordinates_say() -> None:
    svg = pictures.map_figure(
        np.zeros((10, 10, 4), np.uint8), origin=np.array([100.0, 50.0]), cell=(1.0, 1.0), alt="a",
        marks=[pictures.Mark(110.0, 60.0, "corner"), pictures.Mark(500.0, 0.0, "outside")],
    )  # fmt: skip
    image = re.search(r'<image x="([\d.]+)" y="([\d.]+)" width="([\d.]+)"', svg)
    circle = re.search(r'<circle class="mark" cx="([\d.]+)" cy="([\d.]+)"', svg)
    assert image is not None and circle is not None
    x, y, width = (float(v) for v in image.groups())
    assert (float(circle[1]), float(circle[2])) == (x + width, y)  # upper right
    assert "outside" not in svg


def test_viridis_ends_and_unknown() -> None:
    rgba = pictures.shade(np.array([[0.0, 5.0, np.nan, 99.0]]), 0.0, 5.0)[0]
    assert rgba[0].tolist() == [68, 1, 84, 255]
    assert rgba[1].tolist() == rgba[3].tolist() == [253, 231, 37, 255]
    assert rgba[2, 3] == 0


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 10, [0, 2, 4, 6, 8, 10]), (-1, 1, [-1, -0.5, 0, 0.5, 1]), (3, 3, [3])],
)
def test_nice_ticks(low: float, high: float, expected: list[float]) -> None:
    assert pictures.nice_ticks(low, high, 5) == pytest.approx(expected)


def test_pose_figures_by_hand() -> None:
    half = np.sqrt(0.5)
    pose = pose_figures(from_quaternion([1, 2, 3], [0, 0, half, half]))
    assert (pose.x, pose.y, pose.z) == (1, 2, 3)
    assert (pose.yaw_deg, pose.pitch_deg, pose.roll_deg) == pytest.approx((90, 0, 0))
    pose = pose_figures(from_quaternion([0, 0, 0], [half, 0, 0, half]))
    assert (pose.yaw_deg, pose.pitch_deg, pose.roll_deg) == pytest.approx((0, 0, 90))
    pose_figures(from_quaternion([0, 0, 0], [0, half, 0, half]))  # straight up: no warning
    sigma = sigma_figures(np.diag([1.0, 4.0, 9.0, 0.0, 0.0, np.radians(2.0) ** 2]))
    assert (sigma.x, sigma.y, sigma.z, sigma.yaw_deg) == pytest.approx((1, 2, 3, 2))


def test_static_transform_command_is_one_line_for_ros() -> None:
    command = static_transform_command(from_xyz_yaw(1.5, -2.0, 0.0, np.pi), "base", "draft")
    assert command.startswith(
        "ros2 run tf2_ros static_transform_publisher --x 1.5 --y -2 --z 0 --qx 0 --qy 0 --qz "
    )
    assert command.endswith("--frame-id base --child-frame-id draft")
    assert not re.search(r"\de-", command) and "\n" not in command
    words = command.split()
    assert float(words[words.index("--qz") + 1]) == pytest.approx(1.0)
    far = static_transform_command(from_xyz_yaw(470641.0123, 0, 0, 0), "a", "b")
    assert "--x 470641.0123 " in far


def test_json_is_strict_and_exact() -> None:
    value = {"a": np.array([[0.1, np.nan], [np.inf, 1e-17]]), "b": np.float32(0.5), "c": "[\n 1 ]"}
    text = to_json(value)
    assert json.loads(text) == {"a": [[0.1, None], [None, 1e-17]], "b": 0.5, "c": "[\n 1 ]"}
    assert "[0.1, null]" in text


def test_numbers_for_people() -> None:
    assert number(13720.4) == "13 720"
    assert number(-0.12345) == "−0.123"
    assert number(3.0) == "3"
    assert number(float("nan")) == "–"
    assert fixed(-0.001, 2) == "0.00"
    assert fixed(-1.239, 2) == "−1.24"

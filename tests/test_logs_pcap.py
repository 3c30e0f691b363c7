"""Captures of a VLP-16: bytes against the manual, velodyne-decoder as a judge, and what is lost."""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import numpy as np
import pytest
import velodyne_decoder as vd

from commonmap.errors import InputError
from commonmap.io.logs import iter_scans, open_log
from commonmap.io.logs.pcap import iter_datagrams
from commonmap.io.velodyne import PACKET, PACKET_BYTES, pack_packets
from commonmap.sim.logs import velodyne_packets, write_pcap
from commonmap.sim.vlp16 import VLP16
from commonmap.types import Scan
from lidar_scans import vlp16_scans
from log_files import SENDER, block, frames, write_classic, write_ng

HEIGHT = np.sort(VLP16.height_offset)[::-1]
"""Metres by ring: +11.2 mm for the lowest, -11.2 mm for the highest."""


def in_time(scan: Scan) -> Scan:
    """Return the scan with its points in the order of measuring."""
    order = np.argsort(scan.time, kind="stable")
    return Scan(
        scan.xyz[order], scan.time[order], scan.ring[order], scan.intensity[order], scan.stamp
    )


def assert_same(got: Scan, wanted: Scan) -> None:
    """Assert equality up to the quantisation of a packet: 1 us, 2 mm, 0.01 deg."""
    got, wanted = in_time(got), in_time(wanted)
    assert len(got.xyz) == len(wanted.xyz)
    np.testing.assert_array_equal(got.ring, wanted.ring)
    np.testing.assert_array_equal(got.intensity, wanted.intensity)
    np.testing.assert_allclose(got.time, wanted.time, rtol=0, atol=1.5e-6)
    ranges = []
    azimuths = []
    for scan in (got, wanted):
        local = scan.xyz.astype(np.float64)
        local[:, 2] -= HEIGHT[scan.ring]
        ranges.append(np.linalg.norm(local, axis=1))
        azimuths.append(np.arctan2(local[:, 1], local[:, 0]))
    # ranges of the fixture are whole 2 mm, so they come back exactly (float32)
    np.testing.assert_allclose(ranges[0], ranges[1], rtol=0, atol=3e-5)
    off = np.abs(np.angle(np.exp(1j * (azimuths[0] - azimuths[1]))))
    assert np.degrees(off.max()) < 0.012
    assert got.stamp == got.time.min()


def test_bytes_of_a_packet_are_those_of_the_manual() -> None:
    azimuth = np.arange(12)[None] * 40 + 12345
    distance = np.zeros((1, 12, 32), dtype=np.uint16)
    reflectivity = np.zeros((1, 12, 32), dtype=np.uint8)
    distance[0, 0, 1], reflectivity[0, 0, 1] = 5000, 77
    packet = pack_packets(azimuth, distance, reflectivity, np.array([0x12345678])).tobytes()
    assert len(packet) == 1206
    assert packet[:4] == bytes.fromhex("ffee3930")  # flag 0xEEFF, azimuth 123.45 deg
    assert packet[4:7] == bytes.fromhex("000000")  # channel 0: no return
    assert packet[7:10] == bytes.fromhex("88134d")  # channel 1: 10.000 m, reflectivity 77
    assert packet[100:104] == bytes.fromhex("ffee6130")  # 123.85 deg
    assert packet[1200:] == bytes.fromhex("785634123722")  # time, strongest return, VLP-16


def test_frame_of_a_packet_is_that_of_the_sensor(tmp_path: Path) -> None:
    write_pcap(tmp_path / "a.pcap", vlp16_scans(1))
    data = (tmp_path / "a.pcap").read_bytes()
    assert data[:24] == struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, 1)
    assert struct.unpack("<II", data[32:40]) == (1248, 1248)  # as the manual says: 42 + 1206
    frame = data[40 : 40 + 1248]
    assert frame[:6] == b"\xff" * 6 and frame[12:14] == b"\x08\x00"
    assert frame[14:16] == b"\x45\x00" and frame[23] == 17
    words = struct.unpack(">10H", frame[14:34])
    total = sum(words)
    assert (total & 0xFFFF) + (total >> 16) == 0xFFFF  # the checksum of IPv4 is right
    assert frame[26:34] == bytes([192, 168, 1, 201, 255, 255, 255, 255])
    assert struct.unpack(">HHH", frame[34:40]) == (2368, 2368, 1214)
    assert frame[42:44] == b"\xff\xee"


@pytest.mark.parametrize("returns", ["strongest", "last", "dual"])
def test_round_trip(tmp_path: Path, returns: str) -> None:
    scans = vlp16_scans(3)
    write_pcap(tmp_path / "a.pcap", scans, returns=returns)
    back = list(iter_scans(tmp_path / "a.pcap"))
    assert len(back) == 3
    for got, wanted in zip(back, scans, strict=True):
        assert_same(got, wanted)


@pytest.mark.parametrize("start", [0.0, 12.345678, 1_700_002_799.93, 1_700_000_000.123456])
def test_round_trip_over_the_full_hour_and_from_zero(tmp_path: Path, start: float) -> None:
    # 1_700_002_800 is a full hour: the stamp of a packet starts again at 0
    scans = vlp16_scans(3, start=start, every=5)
    write_pcap(tmp_path / "a.pcap", scans)
    for got, wanted in zip(iter_scans(tmp_path / "a.pcap"), scans, strict=True):
        assert_same(got, wanted)


def test_azimuth_decimation_leaves_firings_without_return(tmp_path: Path) -> None:
    scans = vlp16_scans(2, every=8, drop_out=0.0)
    write_pcap(tmp_path / "a.pcap", scans)
    for got, wanted in zip(iter_scans(tmp_path / "a.pcap"), scans, strict=True):
        assert_same(got, wanted)


def test_velodyne_decoder_sees_what_was_written() -> None:
    scan = in_time(vlp16_scans(1)[0])
    decoder = vd.ScanDecoder(vd.Config(model=vd.Model.VLP16, timestamp_first_packet=True))
    packets = [vd.VelodynePacket(t * 1e-9, data) for t, data in velodyne_packets(scan)]
    points = np.asarray(decoder.decode(packets)[1])
    points = points[np.argsort(points[:, 4], kind="stable")]
    np.testing.assert_array_equal(points[:, 6], scan.ring)
    np.testing.assert_array_equal(points[:, 3], scan.intensity)
    np.testing.assert_allclose(points[:, :3], scan.xyz, atol=60 * np.radians(0.011))
    np.testing.assert_allclose(points[:, 4], scan.time - scan.stamp, atol=1.5e-6)


def test_a_point_by_hand(tmp_path: Path) -> None:
    # laser 0 of the VLP-16 looks 15 deg down and starts 11.2 mm up; head at 90 deg: y = -r cos
    out = []
    for i in range(160):
        azimuth = (np.arange(12)[None] * 40 + 480 * i) % 36000
        distance = np.zeros((1, 12, 32), dtype=np.uint16)
        distance[0, azimuth[0] == 8960, 0] = 5000
        reflectivity = np.full((1, 12, 32), 9, dtype=np.uint8)
        stamp = np.array([1_000_000 + 1327 * i])
        packet = pack_packets(azimuth, distance, reflectivity, stamp)[0].tobytes()
        out.append((1_699_999_201 * 10**9 + 1_327_000 * (i + 1), packet))
    from commonmap.sim.logs import _ethernet

    write_classic(tmp_path / "a.pcap", [(t, _ethernet(p, SENDER)) for t, p in out])
    first, second = iter_scans(tmp_path / "a.pcap")
    assert len(first.xyz) == len(second.xyz) == 1
    r, down, turned = 10.0, np.radians(15.0), np.radians(89.6)
    wanted = [
        r * np.cos(down) * np.cos(turned),
        -r * np.cos(down) * np.sin(turned),
        -r * np.sin(down) + 0.0112,
    ]
    np.testing.assert_allclose(first.xyz[0], wanted, atol=1e-4)
    assert first.ring.tolist() == [0] and first.intensity.tolist() == [9.0]
    # 8960 / 40 = block 224 = packet 18, block 8: 18 * 1327 us + 8 * 110.592 us after the start
    assert first.time[0] == pytest.approx(
        1_699_999_201.0 + 18 * 1.327e-3 + 8 * 110.592e-6, abs=1e-6
    )


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("nano", [False, True])
def test_classic_captures_of_both_byte_orders(tmp_path: Path, order: str, nano: bool) -> None:
    scans = vlp16_scans(1, every=5)
    write_classic(tmp_path / "a.pcap", frames(scans), order=order, nano=nano)
    (got,) = iter_scans(tmp_path / "a.pcap")
    assert_same(got, scans[0])
    times = [d.time for d in iter_datagrams(tmp_path / "a.pcap")]
    wanted = [t * 1e-9 for t, _ in frames(scans)]
    np.testing.assert_allclose(times, wanted, atol=3e-7 if nano else 1.2e-6, rtol=0)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("resolution", "offset"), [(9, 0), (6, 0), (6, 1_600_000_000)])
def test_pcapng(tmp_path: Path, order: str, resolution: int, offset: int) -> None:
    scans = vlp16_scans(1, every=5)
    write_ng(tmp_path / "a.pcapng", scans, order=order, resolution=resolution, offset=offset)
    (got,) = iter_scans(tmp_path / "a.pcapng")
    assert_same(got, scans[0])
    first = next(iter_datagrams(tmp_path / "a.pcapng"))
    assert first.time == pytest.approx(frames(scans)[0][0] * 1e-9, abs=1.2e-6)


def test_pcapng_of_two_interfaces_and_an_old_section(tmp_path: Path) -> None:
    time, frame = frames(vlp16_scans(1, every=100))[0]
    ticks = time // 1000
    body = struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)
    data = block("<", 0x0A0D0D0A, body)
    data += block("<", 1, struct.pack("<HHI", 113, 0, 0)) + block(
        "<", 1, struct.pack("<HHI", 1, 0, 0)
    )
    head = struct.pack("<IIIII", 1, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame))
    data += block("<", 6, head + frame)
    head = struct.pack("<HHIIII", 1, 0, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame))
    data += block("<", 2, head + frame)
    (tmp_path / "a.pcapng").write_bytes(data)
    found = list(iter_datagrams(tmp_path / "a.pcapng"))
    assert [len(d.payload) for d in found] == [PACKET_BYTES] * 2
    assert found[0].time == pytest.approx(time * 1e-9, abs=1e-5)


@pytest.mark.parametrize(
    ("link", "front"),
    [
        (1, b"\xff" * 12 + b"\x81\x00\x00\x05\x08\x00"),
        (1, b"\xff" * 12 + b"\x88\xa8\x00\x05\x81\x00\x00\x06\x08\x00"),
        (101, b""),
        (113, b"\0" * 14 + b"\x08\x00"),
        (276, b"\x08\x00" + b"\0" * 18),
        (0, b"\x02\0\0\0"),
    ],
    ids=["vlan", "two vlans", "raw", "cooked", "cooked 2", "loopback"],
)
def test_what_lies_around_a_packet(tmp_path: Path, link: int, front: bytes) -> None:
    packets = [(time, front + frame[14:]) for time, frame in frames(vlp16_scans(1, every=100))]
    write_classic(tmp_path / "a.pcap", packets, link=link)
    assert len(list(iter_datagrams(tmp_path / "a.pcap"))) == 76
    assert next(iter_datagrams(tmp_path / "a.pcap")).stream == "192.168.1.201:2368"


def test_fragments_and_tcp_are_passed_over(tmp_path: Path) -> None:
    (time, frame), *_ = frames(vlp16_scans(1, every=100))
    fragment = frame[:20] + b"\x20\x00" + frame[22:]
    tcp = frame[:23] + b"\x06" + frame[24:]
    write_classic(tmp_path / "a.pcap", [(time, fragment), (time, tcp), (time, frame)])
    assert len(list(iter_datagrams(tmp_path / "a.pcap"))) == 1


def test_two_sensors_are_told_apart(tmp_path: Path) -> None:
    one, two = vlp16_scans(2, seed=1, every=4), vlp16_scans(2, seed=2, every=4)
    both = sorted(frames(one) + frames(two, (192, 168, 1, 202)))
    path = tmp_path / "a.pcap"
    write_classic(path, both)
    assert open_log(path).topic is None
    with pytest.raises(InputError, match=r"\(--topic\): .*192.168.1.201:2368.*192.168.1.202:2368"):
        iter_scans(path)
    for name, scans in (("192.168.1.201:2368", one), ("192.168.1.202:2368", two)):
        for got, wanted in zip(iter_scans(path, topic=name), scans, strict=True):
            assert_same(got, wanted)
    with pytest.raises(InputError, match=r"has no topic 10.0.0.1:1; it has 192"):
        iter_scans(path, topic="10.0.0.1:1")


def test_lost_packets_leave_a_gap_and_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scans = vlp16_scans(4, drop_out=0.0, every=2)
    packets = frames(scans)
    # a fifth of the second turn, and almost a whole turn over the end of the third
    lost = [*range(90, 105), *range(200, 270)]
    write_classic(tmp_path / "a.pcap", [p for i, p in enumerate(packets) if i not in lost])
    with caplog.at_level(logging.WARNING, logger="commonmap"):
        back = list(iter_scans(tmp_path / "a.pcap"))
    assert "about 8" in caplog.text and "packets" in caplog.text and "missing" in caplog.text
    assert [scan.stamp - scans[0].stamp for scan in back] == pytest.approx(
        [0.0, 0.1, 0.2, 0.3 + 42 * 24 * 55.296e-6], abs=3e-3
    )
    assert_same(back[0], scans[0])
    assert 0.75 < len(back[1].xyz) / len(scans[1].xyz) < 0.85
    for got in back:
        # no turn mixes points of two
        assert np.ptp(got.time) < 0.1
    kept = sum(len(scan.xyz) for scan in back)
    assert kept == pytest.approx(sum(len(s.xyz) for s in scans) * (1 - 85 / 304), rel=0.02)


def test_packets_out_of_order_are_put_in_order(tmp_path: Path) -> None:
    scans = vlp16_scans(2, every=4)
    packets = frames(scans)
    packets[40], packets[41] = packets[41], packets[40]
    write_classic(tmp_path / "a.pcap", packets)
    for got, wanted in zip(iter_scans(tmp_path / "a.pcap"), scans, strict=True):
        assert_same(got, wanted)


def test_a_log_that_starts_within_a_turn_starts_with_the_next(tmp_path: Path) -> None:
    scans = vlp16_scans(3, every=4)
    write_classic(tmp_path / "a.pcap", frames(scans)[30 : 76 * 2 + 40])
    (got,) = iter_scans(tmp_path / "a.pcap")
    assert_same(got, scans[1])


def test_a_sensor_without_gps_is_set_to_the_clock_of_the_host(tmp_path: Path) -> None:
    scans = vlp16_scans(2, start=1_700_000_000.0, every=4)
    late = [(time + 1_234_567_000_000, frame) for time, frame in frames(scans)]
    write_classic(tmp_path / "a.pcap", late, nano=True)
    back = list(iter_scans(tmp_path / "a.pcap"))
    # the first packet leaves 1.327 ms after its first firing
    for got, wanted in zip(back, scans, strict=True):
        np.testing.assert_allclose(
            in_time(got).time - in_time(wanted).time, 1234.567 + 1.327e-3, atol=3e-6
        )


def test_damaged_packets_are_left_out_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    packets = frames(vlp16_scans(1, every=2, drop_out=0.0))
    bad = bytearray(packets[20][1])
    bad[42 + 300] ^= 0xFF
    packets[20] = (packets[20][0], bytes(bad))
    write_classic(tmp_path / "a.pcap", packets)
    (got,) = iter_scans(tmp_path / "a.pcap")
    assert "1 of 76 packets are damaged" in caplog.text
    assert len(got.xyz) == pytest.approx(904 * 16 * (1 - 24 / 1808), rel=0.01)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is empty"),
        (b"LASF" + b"\0" * 60, "is no log|first bytes look like LAS|should be a capture"),
        (struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1), "no UDP packets at all"),
    ],
)
def test_files_that_are_no_capture(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "a.pcap").write_bytes(data)
    with pytest.raises(InputError, match=message):
        iter_scans(tmp_path / "a.pcap")


def test_other_packets_are_named(tmp_path: Path) -> None:
    frame = frames(vlp16_scans(1, every=100))[0][1]
    # an Ouster sends to port 7502
    packets = [
        (10**18 + i, frame[:36] + struct.pack(">HH", 7502, 508) + frame[40:542]) for i in range(5)
    ]
    write_classic(tmp_path / "a.pcap", packets)
    with pytest.raises(InputError, match=r"5 UDP packets of 500 bytes to port 7502.*Ouster"):
        iter_scans(tmp_path / "a.pcap")


def test_a_truncated_capture_keeps_what_was_read_only_if_asked(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.pcap"
    scans = vlp16_scans(3, every=4)
    write_pcap(path, scans)
    path.write_bytes(path.read_bytes()[:-1000])
    read = []
    with pytest.raises(InputError, match=r"a.pcap is truncated: it ends at byte .*keep_partial"):
        for scan in iter_scans(path):
            read.append(scan)
    assert len(read) == 2
    back = list(iter_scans(path, keep_partial=True))
    assert len(back) == 3 and "what comes before is kept" in caplog.text
    assert_same(back[1], scans[1])


def test_models_are_checked(tmp_path: Path) -> None:
    write_pcap(tmp_path / "a.pcap", vlp16_scans(1, every=10))
    with pytest.raises(InputError, match=r"model must be one of vlp-16, .*; 'vlp-17' came"):
        iter_scans(tmp_path / "a.pcap", model="vlp-17")
    assert len(list(iter_scans(tmp_path / "a.pcap", model="VLP16"))) == 1
    with pytest.raises(InputError, match="a packet cannot be read"):
        list(iter_scans(tmp_path / "a.pcap", model="hdl-32e"))


@pytest.mark.parametrize(("byte", "rings"), [(0x21, 32), (0x24, 16), (0x28, 32), (0xA1, 32)])
def test_other_models_are_read(tmp_path: Path, byte: int, rings: int) -> None:
    # the same blocks, sent by another model: what they mean is velodyne-decoder's
    packets = [(t, f[:-1] + bytes([byte])) for t, f in frames(vlp16_scans(2, drop_out=0.0))]
    write_classic(tmp_path / "a.pcap", packets)
    scans = list(iter_scans(tmp_path / "a.pcap"))
    assert len(scans) == 2
    assert len(np.unique(scans[0].ring)) == rings
    assert np.ptp(scans[0].time) < 0.11


def test_scans_that_are_not_of_a_vlp16_are_not_written(tmp_path: Path) -> None:
    (scan,) = vlp16_scans(1, every=10)
    turned = Scan(scan.xyz[:, [1, 0, 2]].copy(), scan.time, scan.ring, scan.intensity, scan.stamp)
    with pytest.raises(InputError, match="deg from where a VLP-16"):
        write_pcap(tmp_path / "a.pcap", [turned])
    assert not (tmp_path / "a.pcap").exists()
    with pytest.raises(InputError, match="there are no scans"):
        write_pcap(tmp_path / "a.pcap", [])
    assert PACKET.itemsize == 1206


def test_the_same_scans_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.pcap", "b.pcap"):
        write_pcap(tmp_path / name, vlp16_scans(1))
    assert (tmp_path / "a.pcap").read_bytes() == (tmp_path / "b.pcap").read_bytes()

"""Captures of Velodyne and Ouster sensors, made by the manuals' formulas, give back what was measured."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pcap_builders import (
    START_NS,
    OusterSpec,
    Shot,
    arrays,
    ouster,
    ouster_imu,
    square_room,
    velodyne,
    write_ouster,
    write_pcap,
)

sys.path.insert(0, str(Path(__file__).parents[2] / "cli"))
from calling import lslam, strict_json

from lslam.core.errors import InputError, UsageError
from lslam.core.types.sequence import Sequence
from lslam.io.formats.pcap_files import read_datagrams
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence

# A block's azimuth has 0.01 deg, and two blocks' are told apart by the rounding of both; at 9.5 m.
ATOL_M = 9.5 * np.radians(0.015) + 1e-4


def assert_measured(sequence: Sequence, shots: list[Shot], atol_m: float) -> int:
    """Every point of every scan is a shot, in order, and no shot between the first and the last is missing; how many."""
    at, rings, points, shades = arrays(shots)
    got_at, got_rings, got_points, got_shades = [], [], [], []
    for k in range(len(sequence)):
        scan = sequence.scan(k)
        assert scan.times is not None
        assert scan.intensity is not None
        assert scan.stamp_ns == sequence.stamps_ns[k]
        assert scan.times[0] >= 0
        got_at.append(scan.stamp_ns + np.round(scan.times.astype(np.float64) * 1e9).astype(np.int64))
        got_rings.append(scan.rings)
        got_points.append(scan.points)
        got_shades.append(scan.intensity)
    n = sum(map(len, got_at))
    # float32 seconds over a sweep of 0.1 s hold 10 ns.
    np.testing.assert_allclose(np.concatenate(got_at) - START_NS, at[:n] - START_NS, atol=1500, rtol=0)
    np.testing.assert_array_equal(np.concatenate(got_rings), rings[:n])
    np.testing.assert_array_equal(np.concatenate(got_shades), shades[:n])
    np.testing.assert_allclose(np.concatenate(got_points), points[:n], atol=atol_m, rtol=0)
    return n


@pytest.mark.parametrize(("model", "rings"), [("VLP-16", 16), ("HDL-32E", 32)])
@pytest.mark.parametrize("mode", ["strongest", "last", "dual"])
def test_velodyne_gives_back_what_was_measured(tmp_path: Path, model: str, rings: int, mode: str) -> None:
    frames, shots = velodyne(model, 3.2, mode=mode)
    sequence = open_sequence(write_pcap(tmp_path / "drive.pcap", frames))
    assert (sequence.kind, len(sequence), sequence.rate_hz) == ("pcap", 3, 10.0)
    assert (sequence.sensor, sequence.rings) == (model, rings)  # type: ignore[attr-defined]
    assert sequence.problems == []
    n = assert_measured(sequence, shots, ATOL_M)
    assert 0.9 * 3 / 3.2 <= n / len(shots) <= 1.1 * 3 / 3.2
    # Scans begin where the sensor began to be heard, a turn apart to a block.
    np.testing.assert_allclose(np.diff(sequence.stamps_ns), 1e8, atol=120_000)
    bearing = np.degrees(np.arctan2(sequence.scan(1).points[0, 1], sequence.scan(1).points[0, 0]))
    assert abs((bearing + 123.45 + 180) % 360 - 180) < 0.5


def test_ranges_are_right_to_their_unit(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 1.3, lambda *_: 12.3456)
    scan = open_sequence(write_pcap(tmp_path / "a.pcap", frames)).scan(0)
    up = np.linspace(-15, 15, 16)[np.asarray(scan.rings)]
    origin = np.array([11.2, 9.7, 8.1, 6.6, 5.1, 3.7, 2.2, 0.7, -0.7, -2.2, -3.7, -5.1, -6.6, -8.1, -9.7, -11.2]) * 1e-3
    r = np.hypot(np.hypot(scan.points[:, 0], scan.points[:, 1]), scan.points[:, 2] - origin[np.asarray(scan.rings)])
    np.testing.assert_allclose(r, 12.346, atol=2e-5)
    elevation = np.degrees(np.arcsin((scan.points[:, 2] - origin[np.asarray(scan.rings)]) / r))
    np.testing.assert_allclose(elevation, up, atol=1e-3)


def test_pcapng_and_fragments_and_other_traffic_change_nothing(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 2.2)
    noise = [(at + 5, bytes(554)) for at, _ in frames[::9]] + [(at + 9, b"x") for at, _ in frames[::5]]
    plain = open_sequence(write_pcap(tmp_path / "a.pcap", frames))
    for other in (
        write_pcap(tmp_path / "b.pcapng", frames + noise),
        write_pcap(tmp_path / "c.pcap", frames + noise, mtu=500),
    ):
        again = open_sequence(other)
        assert len(again) == len(plain) == 2
        np.testing.assert_array_equal(again.stamps_ns, plain.stamps_ns)
        np.testing.assert_array_equal(again.scan(1).points, plain.scan(1).points)
        assert again.problems == []


def test_hour_comes_from_the_capture_also_across_its_end(tmp_path: Path) -> None:
    top = 1_700_002_800_000_000_000
    assert top % 3_600_000_000_000 == 0
    frames, _ = velodyne("VLP-16", 4.2, start_ns=top - 150_000_000)
    sequence = open_sequence(write_pcap(tmp_path / "a.pcap", frames))
    np.testing.assert_allclose(sequence.stamps_ns - top, [-150e6, -50e6, 50e6, 150e6], atol=130_000)
    assert not any("clock" in note for note in sequence.notes)
    apart, _ = velodyne("VLP-16", 2.2, clock_ns=-700 * 10**9)
    sequence = open_sequence(write_pcap(tmp_path / "b.pcap", apart))
    assert abs(int(sequence.stamps_ns[0]) - START_NS + 700 * 10**9) < 10_000
    assert any("-700" in note or "-701" in note for note in sequence.notes)


def test_lost_packets_leave_a_gap_and_nothing_moves(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 6.2)
    whole = open_sequence(write_pcap(tmp_path / "a.pcap", frames))
    kept = [frame for k, frame in enumerate(frames) if not 85 <= k < 250]
    gap = open_sequence(write_pcap(tmp_path / "b.pcap", kept))
    assert len(gap) < len(whole)
    np.testing.assert_array_equal(gap.scan(0).points, whole.scan(0).points)
    np.testing.assert_array_equal(gap.scan(len(gap) - 1).points, whole.scan(len(whole) - 1).points)
    assert gap.stamps_ns[-1] == whole.stamps_ns[-1]
    assert (np.diff(gap.stamps_ns) > 0).all()


def test_packets_out_of_order_and_twice_are_sorted_and_said(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 2.2)
    swapped = [(at, frames[k ^ 1][1] if k < 100 else payload) for k, (at, payload) in enumerate(frames)]
    swapped.append((frames[60][0] + 1000, frames[60][1]))
    plain = open_sequence(write_pcap(tmp_path / "a.pcap", frames))
    sequence = open_sequence(write_pcap(tmp_path / "b.pcap", swapped))
    np.testing.assert_array_equal(sequence.scan(1).points, plain.scan(1).points)
    assert any("out of order" in problem for problem in sequence.problems)
    assert any("repeat a time 1 times" in problem for problem in sequence.problems)


@pytest.mark.parametrize(
    "profile", ["LEGACY", "RNG19_RFL8_SIG16_NIR16", "RNG19_RFL8_SIG16_NIR16_DUAL", "RNG15_RFL8_NIR8"]
)
def test_ouster_gives_back_what_was_measured(tmp_path: Path, profile: str) -> None:
    spec = OusterSpec(profile)
    frames, shots = ouster(spec, 3)
    path = write_ouster(tmp_path, spec, frames + ouster_imu(30), is_nested=profile != "LEGACY", mtu=600)
    sequence = open_sequence(tmp_path if profile == "LEGACY" else path)
    assert (len(sequence), sequence.rate_hz, sequence.problems) == (3, 10.0, [])
    assert assert_measured(sequence, shots, 2e-6) == len(shots)
    assert sequence.imu is not None
    np.testing.assert_array_equal(sequence.imu.stamps_ns, START_NS + 10_000_000 * np.arange(30))
    np.testing.assert_allclose(sequence.imu.accel[3], np.array([0.01, 0.02, 1.0]) * 9.80665, rtol=1e-6)
    np.testing.assert_allclose(sequence.imu.gyro[3], np.radians([1.0, 2.0, 10.0]), rtol=1e-6)
    T = sequence.calibration.T_lidar_imu
    assert T is not None
    np.testing.assert_allclose(T[:3, 3], [6.253e-3, -11.775e-3, 7.645e-3])


def test_walls_of_the_room_stand_where_they_are(tmp_path: Path) -> None:
    """The front is x: independent of the formulas that encoder and decoder share."""
    spec = OusterSpec(offset_mm=0.0, width=256)
    frames, _ = ouster(
        spec, 2, lambda t, bearing, up: 9.0 if abs((bearing + np.pi) % (2 * np.pi) - np.pi) < 0.2 else 30.0
    )
    points = open_sequence(write_ouster(tmp_path, spec, frames)).scan(0).points
    near = points[np.linalg.norm(points, axis=1) < 15]
    assert len(near) > 50
    assert (near[:, 0] > 7).all()


def test_a_clock_that_was_never_told_the_time_gets_that_of_the_capture(tmp_path: Path) -> None:
    spec = OusterSpec()
    frames, _ = ouster(spec, 3, clock_ns=-spec.start_ns + 5_000_000_000)
    imu = ouster_imu(10, 5_000_000_000)
    imu = [(at - 5_000_000_000 + START_NS + 40_000_000, payload) for at, payload in imu]
    sequence = open_sequence(write_ouster(tmp_path, spec, frames + imu))
    # A packet is sent when its sixteen columns are done.
    late = 16 * (10**8 // spec.width)
    np.testing.assert_allclose(sequence.stamps_ns - START_NS - late, [0, 1e8, 2e8], atol=1500)
    assert sequence.imu is not None
    assert abs(int(sequence.imu.stamps_ns[0] - sequence.stamps_ns[0])) < 1000
    assert any("never told the time" in note for note in sequence.notes)


def test_revolutions_that_are_not_whole_are_no_scans(tmp_path: Path) -> None:
    spec = OusterSpec()
    frames, _ = ouster(spec, 4)
    sequence = open_sequence(write_ouster(tmp_path, spec, frames[2:-1]))
    assert len(sequence) == 2
    assert any("2 revolutions at the ends" in note for note in sequence.notes)


def test_whole_revolutions_at_the_ends_are_scans_where_packets_between_are_lost(tmp_path: Path) -> None:
    """Four packets a revolution: of the second and the third two are there."""
    spec = OusterSpec()
    frames, _ = ouster(spec, 4)
    sequence = open_sequence(write_ouster(tmp_path, spec, [*frames[:6], *frames[10:]]))
    assert [len(sequence.scan(k)) for k in range(len(sequence))] == [512, 256, 256, 512]
    assert ((sequence.stamps_ns - sequence.stamps_ns[0]) // 10**6).tolist() == [0, 100, 250, 300]


def test_what_cannot_be_read_is_one_sentence_with_the_file(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 1.2)
    spec = OusterSpec()
    lidar, _ = ouster(spec, 2)
    path = tmp_path / "a.pcap"

    def refused(match: str) -> None:
        with pytest.raises(InputError, match=match) as caught:
            open_sequence(path)
        assert "a.pcap" in str(caught.value) or "a.json" in str(caught.value)
        assert "\n" not in str(caught.value)

    path.write_bytes(b"")
    refused("it has 0 bytes")
    path.write_bytes(b"nothing of the kind, and long enough")
    refused("is no capture: it begins with")
    write_pcap(path, [])
    refused("no UDP datagrams")
    write_pcap(path, [(START_NS, bytes(100))])
    refused(r"put its metadata at a\.json there")
    write_pcap(path, [(at, payload[:-1] + b"\x99") for at, payload in frames])
    refused("no return mode and model that is known; VLP-16, Puck Hi-Res, HDL-32E, VLP-32C are")
    write_pcap(path, frames[:30])
    refused("of a revolution of the VLP-16: one is needed")
    write_pcap(path, frames[:1])
    refused("does not turn")
    write_pcap(path, lidar)
    refused(r"put its metadata at a\.json there")
    (tmp_path / "b.json").write_text("{}")
    (tmp_path / "c.json").write_text("{}")
    refused(r"2 \*\.json lie beside it")
    for text, match in (
        ("[]", "is no metadata of an Ouster sensor"),
        ("{", "is no metadata of an Ouster sensor"),
        (
            json.dumps(spec.metadata() | {"lidar_data_format": {"udp_profile_lidar": "FUSA"}}),
            "profile FUSA are not read",
        ),
        (json.dumps(replace(spec, beams=7).metadata()), "holds no LiDAR packets of"),
    ):
        (tmp_path / "a.json").write_text(text)
        refused(match)
    write_pcap(tmp_path / "d.pcap", frames)
    with pytest.raises(InputError, match="holds 2 captures"):
        open_sequence(tmp_path)
    with pytest.raises(UsageError, match="is for bags"):
        open_sequence(tmp_path / "d.pcap", imu_topic="/imu")


@pytest.mark.parametrize("suffix", [".pcap", ".pcapng"])
def test_a_capture_that_is_cut_off_is_read_as_far_as_it_goes(tmp_path: Path, suffix: str) -> None:
    frames, _ = velodyne("VLP-16", 3.2)
    path = write_pcap(tmp_path / f"a{suffix}", frames)
    path.write_bytes(path.read_bytes()[:-700])
    sequence = open_sequence(path)
    assert len(sequence) == 3
    assert any("is cut off" in problem for problem in sequence.problems)


def test_a_datagram_that_lacks_a_piece_is_left_out_and_counted(tmp_path: Path) -> None:
    import dpkt

    frames, _ = velodyne("VLP-16", 1.2)
    whole = write_pcap(tmp_path / "a.pcap", frames, mtu=500)
    with whole.open("rb") as stream:
        packets = list(dpkt.pcap.Reader(stream))
    del packets[100]
    with (tmp_path / "b.pcap").open("wb") as stream:
        writer = dpkt.pcap.Writer(stream)
        for at, data in packets:
            writer.writepkt(data, at)
    datagrams = read_datagrams(tmp_path / "b.pcap")
    assert len(datagrams) == len(frames) - 1
    assert "1 datagrams" in datagrams.loss
    kept = datagrams.payloads(np.arange(len(datagrams)))
    wanted = [payload for _, payload in frames if payload != frames[33][1]]
    assert [bytes(row) for row in kept] == wanted


def test_sidecars_say_what_the_capture_cannot(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 2.2)
    write_pcap(tmp_path / "a.pcap", frames)
    (tmp_path / "sequence.toml").write_text('name = "round"\nmotion_compensated = true\n')
    rows = [f"{(START_NS + k * 10_000_000) / 1e9:.9f},0,0,9.81,0,0,0.1" for k in range(30)]
    (tmp_path / "imu.csv").write_text("t,ax,ay,az,gx,gy,gz\n" + "\n".join(rows) + "\n")
    sequence = open_sequence(tmp_path)
    assert (sequence.name, sequence.motion_compensated) == ("round", True)
    assert sequence.scan(0).times is None
    assert sequence.imu is not None
    assert any("--extrinsics" in problem for problem in sequence.problems)


def test_the_room_is_what_it_says() -> None:
    assert square_room(0, 0.0, 0.0) == 8
    assert square_room(0, np.pi / 2, 0.0) == pytest.approx(5)


def test_a_capture_is_shown_and_run(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 4.2)
    path = write_pcap(tmp_path / "drive.pcap", frames)
    shown = lslam("info", path, "--quick", "--json")
    assert shown.returncode == 0, shown.stderr
    facts = strict_json(shown.stdout)
    assert (facts["format"], facts["sensor"], facts["scans"], facts["bag"]) == ("pcap", "VLP-16", 4, None)
    ran = lslam("run", path, "--out", tmp_path / "run")
    assert ran.returncode == 0, ran.stderr
    poses = read_trajectory(tmp_path / "run").positions
    assert len(poses) == 4
    # The sensor stands still.
    assert np.linalg.norm(poses, axis=1).max() < 0.02


def test_times_that_leap_by_days_are_refused(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 1.5)
    leap = [
        (at + (3 * 86_400 * 10**9 if k > len(frames) // 2 else 0), payload) for k, (at, payload) in enumerate(frames)
    ]
    with pytest.raises(InputError, match="leap by days"):
        open_sequence(write_pcap(tmp_path / "drive.pcap", leap))


def test_imu_samples_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    frames, samples = ouster(OusterSpec(), 2)[0], ouster_imu(8)
    at, good = samples[3]
    samples[3] = at, good[:24] + np.array([np.nan, 0, 1, 0, np.inf, 0], "<f4").tobytes()
    imu = open_sequence(write_ouster(tmp_path, OusterSpec(), frames + samples)).imu
    assert imu is not None
    assert len(imu.stamps_ns) == 7
    assert np.isfinite(imu.accel).all()
    assert np.isfinite(imu.gyro).all()


def saved_by_scan(revolutions: float, kept: range, before: int, cut: int = 0) -> list[tuple[int, bytes]]:
    """Packets of the revolutions `kept`, each with `before` packets of the one before and without its last `cut`."""
    frames, _ = velodyne("VLP-16", revolutions, first_deg=0.0)
    turn = [int((at - START_NS - 1_330_000) / 1e8) for at, _ in frames]
    chosen: list[tuple[int, bytes]] = []
    for k in kept:
        first, end = turn.index(k), turn.index(k + 1)
        chosen += frames[max(first - before, 0) : end - cut]
    return chosen


@pytest.mark.parametrize("before", [0, 1, 5])
def test_a_sliver_of_the_sweep_before_is_no_scan(before: int, tmp_path: Path) -> None:
    """Captures saved scan by scan: two of three revolutions are missing, packets of the one before are kept."""
    sequence = open_sequence(write_pcap(tmp_path / "a.pcap", saved_by_scan(10.2, range(0, 10, 3), before)))
    np.testing.assert_allclose((sequence.stamps_ns - START_NS) / 1e8, [0, 3, 6, 9], atol=0.02)
    assert [len(sequence.scan(k)) > 28_000 for k in range(4)] == [True] * 4
    assert sum("revolutions are missing: 3 of which" in problem for problem in sequence.problems) == (before > 0)


def test_a_capture_of_one_scan_is_one(tmp_path: Path) -> None:
    whole = open_sequence(write_pcap(tmp_path / "a.pcap", saved_by_scan(3.2, range(1, 2), 0)))
    assert (len(whole), whole.problems) == (1, [])
    most = open_sequence(write_pcap(tmp_path / "b.pcap", saved_by_scan(3.2, range(1, 2), 0, cut=4)))
    assert len(most) == 1
    assert any(re.search(r"0\.9\d of one revolution: it is the only scan", note) for note in most.notes)
    n = len(most.scan(0)) - 100  # the last block turns by the rate, which the next one would tell
    np.testing.assert_allclose(most.scan(0).points[:n], whole.scan(0).points[:n], atol=ATOL_M)
    with pytest.raises(InputError, match=r"0\.8\d of a revolution"):
        open_sequence(write_pcap(tmp_path / "c.pcap", saved_by_scan(3.2, range(1, 2), 0, cut=15)))


def test_a_packet_of_an_ouster_frame_that_is_missing_is_no_scan(tmp_path: Path) -> None:
    spec = OusterSpec("RNG15_RFL8_NIR8", width=256)
    frames, _ = ouster(spec, 5)
    per_frame = len(frames) // 5
    kept = [f for k, f in enumerate(frames) if k // per_frame != 2 or k % per_frame == per_frame - 1]
    sequence = open_sequence(write_ouster(tmp_path, spec, kept))
    assert len(sequence) == 4
    assert any("1 of which less than 10%" in problem for problem in sequence.problems)

"""Every fault that the doctor can find is found in a healthy recording with its size, and no other one."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import so3
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Calibration, Sequence, no_shared_time
from lslam.io.readers import open_sequence
from lslam.odometry.inertial.imu_cleaning import ImuFault, ImuRefusedError, clean
from lslam.pipeline.doctor import Facts, Finding, Findings
from lslam.pipeline.doctor.examine_imu import examine_imu
from lslam.pipeline.doctor.examine_positions import examine_gnss
from lslam.pipeline.doctor.examine_turns import compare, examine_turns
from lslam.pipeline.doctor.inspect import examine_points, examine_stamps, examine_times, inspect

SAMPLE = Path(__file__).parents[3] / "sample_data"
Spoil = Callable[[ImuStream], ImuStream]


@pytest.fixture(scope="module")
def healthy() -> Sequence:
    return open_sequence(SAMPLE)


def spoilt(sequence: Sequence, **changes: Any) -> Sequence:
    """The sequence with other streams, stamps or calibration."""
    other = copy(sequence)
    for name, value in changes.items():
        setattr(other, name, value)
    return other


def imu_of(sequence: Sequence) -> ImuStream:
    assert sequence.imu is not None
    return sequence.imu


def against_truth(
    sequence: Sequence, imu: ImuStream, T: NDArray[np.float64] | None = None
) -> tuple[list[Finding], Facts]:
    """What comparing turns finds when registration is perfect."""
    truth, known = sequence.ground_truth, sequence.calibration.T_lidar_imu
    assert truth is not None
    assert known is not None
    stamps = truth.stamps_ns[:60]
    findings = Findings()
    cleaned = clean(imu, int(stamps[0]), int(stamps[-1]))
    facts = compare(cleaned, known if T is None else T, stamps, truth.poses[:60], findings)
    return findings, facts


def codes(findings: list[Finding]) -> list[str]:
    return [f.code for f in findings]


def test_nothing_is_wrong_with_the_sample(healthy: Sequence) -> None:
    facts = inspect(healthy, samples=5, is_quick=True)
    assert facts["findings"] == []
    findings, turns = against_truth(healthy, imu_of(healthy))
    assert findings == []
    assert turns["correlation"] > 0.99
    assert abs(turns["time_offset_s"]) < 0.003


def test_recordings_give_true_findings_only(recordings: Callable[[str], Path]) -> None:
    """KITTI's sync drives are slow in the IMU; nothing else is wrong with this one, whose clocks differ by less than a step."""
    [drive] = recordings("kitti_raw_0048").rglob("*drive_0048_sync")
    facts = inspect(open_sequence(drive), samples=2)
    assert [f["code"] for f in facts["findings"]] == ["imu-rate"]
    assert facts["imu"]["tilt_deg"] < 10


@pytest.mark.parametrize("late_s", [0.02, -0.05, 0.1, 0.2, 1.5])
def test_clocks_that_differ(healthy: Sequence, late_s: float) -> None:
    imu = imu_of(healthy)
    findings, turns = against_truth(healthy, replace(imu, stamps_ns=imu.stamps_ns + round(late_s * 1e9)))
    assert codes(findings) == ["imu-time-offset"]
    assert abs(turns["time_offset_s"] + late_s) < 0.003
    assert ("late" if late_s > 0 else "early") in findings[0].what
    assert ("does not look so far" in findings[0].way_out) == (late_s > 0.25)


def test_degrees_per_second(healthy: Sequence) -> None:
    imu = imu_of(healthy)
    degrees = replace(imu, gyro=np.rad2deg(imu.gyro))
    findings, _ = against_truth(healthy, degrees)
    assert codes(findings) == ["imu-gyro-unit"]
    assert "57 times" in findings[0].what
    alone = Findings()
    examine_imu(spoilt(healthy, imu=degrees), alone)
    assert codes(alone) == ["imu-gyro-unit"]


@pytest.mark.parametrize(
    ("signs", "order", "said", "way"),
    [
        ((-1, 1, 1), (0, 1, 2), "(-x, y, z)", "mirrored"),
        ((1, 1, -1), (0, 1, 2), "(x, y, -z)", "mirrored"),
        ((1, 1, 1), (1, 2, 0), "(z, x, y)", "T_lidar_imu to [["),
        ((-1, -1, 1), (0, 1, 2), "(-x, -y, z)", "T_lidar_imu to [["),
    ],
)
def test_axes_swapped_and_flipped(
    healthy: Sequence, signs: tuple[int, ...], order: tuple[int, ...], said: str, way: str
) -> None:
    imu = imu_of(healthy)
    findings, _ = against_truth(healthy, replace(imu, gyro=(imu.gyro * signs)[:, order]))
    assert codes(findings) == ["imu-axes"]
    assert said in findings[0].what
    assert way in findings[0].way_out


def test_axes_and_clock_at_once(healthy: Sequence) -> None:
    """Clocks are told apart by turns whose axes were put right."""
    imu = imu_of(healthy)
    spoilt_imu = replace(imu, gyro=(imu.gyro * (-1, 1, 1))[:, [1, 0, 2]], stamps_ns=imu.stamps_ns + 40_000_000)
    findings, turns = against_truth(healthy, spoilt_imu)
    assert codes(findings) == ["imu-axes", "imu-time-offset"]
    assert abs(turns["time_offset_s"] + 0.04) < 0.003


def test_extrinsics_turned_by_an_angle(healthy: Sequence) -> None:
    """The rotation that is proposed is the one that was spoilt."""
    T = healthy.calibration.T_lidar_imu
    assert T is not None
    wrong = T.copy()
    wrong[:3, :3] = T[:3, :3] @ so3.exp(np.deg2rad([0.0, 25.0, 0.0]))
    findings, _ = against_truth(healthy, imu_of(healthy), wrong)
    assert codes(findings) == ["imu-rotation"]
    said = re.search(r"about (\d+) deg off", findings[0].what)
    assert said is not None
    assert abs(int(said.group(1)) - 25) <= 2
    proposed = np.array(json.loads(findings[0].way_out.split("about ")[1]))
    assert np.rad2deg(so3.angle(proposed.T @ T[:3, :3])) < 4


def at(imu: ImuStream, keep: NDArray[np.bool_]) -> ImuStream:
    return ImuStream(imu.stamps_ns[keep], imu.accel[keep], imu.gyro[keep])


def without_middle(imu: ImuStream) -> ImuStream:
    return at(imu, (np.arange(len(imu)) < 400) | (np.arange(len(imu)) >= 450))


def back(imu: ImuStream) -> ImuStream:
    stamps = imu.stamps_ns.copy()
    stamps[100:103] -= 50_000_000
    return replace(imu, stamps_ns=stamps)


@pytest.mark.parametrize(
    ("spoil", "code", "said"),
    [
        (without_middle, "imu-gaps", "1 gap, the longest 0.510 s"),
        (back, "imu-rewinds", "goes back 1 time"),
        (lambda imu: replace(imu, accel=imu.accel / 9.80665), "imu-accel-unit", "seems to be in g, multiply by 9.80665"),
        (lambda imu: replace(imu, accel=imu.accel * 3), "imu-accel-unit", "not usable"),
        (lambda imu: replace(imu, accel=-imu.accel), "imu-gravity", "along -z of the LiDAR"),
        (lambda imu: replace(imu, accel=imu.accel[:, [2, 0, 1]]), "imu-gravity", "along +x of the LiDAR"),
        (lambda imu: at(imu, np.arange(len(imu)) % 10 == 0), "imu-rate", "10.0 Hz"),
        (lambda imu: replace(imu, stamps_ns=imu.stamps_ns + 10**12), "imu-apart", "begins +1000.0"),
        (lambda imu: replace(imu, gyro=np.where(np.arange(len(imu))[:, None] == 7, np.nan, imu.gyro)), "imu-finite", "1 of"),
    ],
)  # fmt: skip
def test_faults_of_the_imu_itself(healthy: Sequence, spoil: Spoil, code: str, said: str) -> None:
    findings = Findings()
    examine_imu(spoilt(healthy, imu=spoil(imu_of(healthy))), findings)
    assert codes(findings) == [code]
    assert said in str(findings[0])
    assert findings[0].way_out


def test_an_imu_that_measures_nothing(healthy: Sequence) -> None:
    imu = imu_of(healthy)
    findings = Findings()
    assert examine_turns(spoilt(healthy, imu=replace(imu, gyro=0 * imu.gyro)), findings) is None
    assert codes(findings) == ["imu-refused"]
    assert "repeats one reading" in findings[0].what
    assert findings[0].way_out


def test_missing_extrinsics(healthy: Sequence) -> None:
    findings = Findings()
    examine_imu(spoilt(healthy, calibration=Calibration()), findings)
    assert codes(findings) == ["imu-extrinsics"]
    assert "--extrinsics" in findings[0].way_out


def test_gaps_of_the_scans_and_times_in_the_wrong_unit(healthy: Sequence) -> None:
    findings = Findings()
    stamps = np.delete(healthy.stamps_ns, [20, 21, 50])
    examine_stamps(spoilt(healthy, stamps_ns=stamps), findings)
    assert codes(findings) == ["scan-gaps"]
    assert "2 gaps in the scans, the longest 0.300 s after scan 19" in findings[0].what


# The stamp lies at the start, in the middle, at the end, just before the first point; in another sweep, in other units.
LIMITS = [
    *(([begin, begin + 0.0999], True) for begin in (0.0, -0.05, -0.0999, 0.005)),
    *(
        (limits, False)
        for limits in ([0.02, 0.12], [-0.12, -0.02], [0.1, 0.2], [-0.3, -0.2], [0.0, 99.9], [-0.001, 0.001])
    ),
]


@pytest.mark.parametrize(("limits", "is_sound"), LIMITS)
def test_point_times_fill_a_sweep_that_holds_the_stamp(healthy: Sequence, limits: list[float], is_sound: bool) -> None:
    findings = Findings()
    examine_times(healthy, {"per_point_times": limits}, findings)
    assert codes(findings) == ([] if is_sound else ["point-times"])
    assert is_sound or "from the scan's stamp" in findings[0].way_out


def test_a_scan_without_times_rings_and_intensity_does_not_speak_for_the_others(healthy: Sequence) -> None:
    def scan(index: int) -> Scan:
        read = healthy.scan(index)
        return read if index else replace(read, times=None, rings=None, intensity=None, fault="no times")

    whole, facts = (inspect(s, samples=4, is_quick=True) for s in (healthy, spoilt(healthy, scan=scan)))
    assert [f["code"] for f in facts["findings"]] == [*(f["code"] for f in whole["findings"]), "scan-faults"]
    assert facts["points"]["per_point_times"] == pytest.approx(whole["points"]["per_point_times"], abs=1e-3)
    assert facts["points"]["rings"] == whole["points"]["rings"]


def test_points_that_no_lidar_sees(healthy: Sequence) -> None:
    def scan(index: int) -> Scan:
        found = healthy.scan(index)
        return replace(found, points=found.points * np.float32(1e30 if index % 2 else 1.0))

    facts = inspect(spoilt(healthy, scan=scan), samples=4, is_quick=True)
    assert [f["code"] for f in facts["findings"]] == ["points-far"]
    assert "points of 2 of the 4 scans looked at lie beyond 10 km" in facts["problems"][0]


def test_clouds_in_the_frame_of_a_world(healthy: Sequence) -> None:
    assert healthy.ground_truth is not None
    poses, read = healthy.ground_truth.poses, healthy.scan

    def moved(i: int) -> Scan:
        scan = read(i)
        return replace(scan, points=(scan.points @ poses[i, :3, :3].T + poses[i, :3, 3]).astype(np.float32))

    for scan, expected in ((read, []), (moved, ["points-frame"])):
        findings = Findings()
        examine_points(spoilt(healthy, scan=scan), np.arange(0, 80, 8), findings)
        assert codes(findings) == expected


def test_satellite_fixes(healthy: Sequence) -> None:
    gnss = healthy.gnss
    assert gnss is not None

    def examined(spoilt_gnss: GnssStream) -> tuple[list[Finding], Facts | None]:
        findings = Findings()
        return findings, examine_gnss(spoilt(healthy, gnss=spoilt_gnss), findings)

    findings, facts = examined(gnss)
    assert facts is not None
    assert (codes(findings), facts["hemisphere"], round(facts["rate_hz"], 3)) == ([], "NE", 1.0)
    jumped = gnss.lat_lon_alt.copy()
    jumped[4, 0] += 1e-3  # 111 m
    findings, facts = examined(replace(gnss, lat_lon_alt=jumped))
    assert codes(findings) == ["gnss-jumps"]
    assert "the worst, number 4, by 11" in findings[0].what
    zeros = gnss.lat_lon_alt.copy()
    zeros[0] = 0
    findings, facts = examined(replace(gnss, lat_lon_alt=zeros))
    assert facts is not None
    assert (codes(findings), facts["fixes"]) == (["gnss-invalid"], len(gnss) - 1)
    findings, _ = examined(replace(gnss, stamps_ns=gnss.stamps_ns + 10**12))
    assert codes(findings) == ["gnss-apart"]


def test_no_finding_hangs_on_the_words_of_a_refusal(healthy: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*given: object) -> None:
        raise ImuRefusedError("turns: too quick: by far", "divide", ImuFault.GYRO_IN_DEGREES)

    monkeypatch.setattr("lslam.pipeline.doctor.examine_turns.check_agreement", refuse)
    findings, _ = against_truth(healthy, imu_of(healthy))
    assert findings == [Finding("imu-gyro-unit", "IMU: turns: too quick: by far", "divide")]


def test_what_the_reader_said_of_a_stream_is_not_said_twice(healthy: Sequence) -> None:
    imu, gnss = imu_of(healthy), healthy.gnss
    assert gnss is not None
    away = spoilt(healthy, imu=replace(imu, stamps_ns=imu.stamps_ns + 10**12))
    away.gnss = replace(gnss, stamps_ns=gnss.stamps_ns + 10**12)
    away.problems = [no_shared_time("IMU"), no_shared_time("GNSS")]
    assert [f["code"] for f in inspect(away, samples=2, is_quick=True)["findings"]] == ["recording", "recording"]

"""Trajectories as other tools write them: each file holds one known drive, which must come back stamp by stamp."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.sequence import Calibration
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers.ground_truth import Voice, load_poses, to_lidar

COUNT = 40
SECONDS = 0.1 * np.arange(COUNT) + 0.02 * np.sin(np.arange(COUNT))
NS = 1_700_000_000_123_456_789 + np.rint(SECONDS * 1e9).astype(np.int64)
YAW = 0.05 * np.arange(COUNT)
P = np.stack([10 * np.sin(YAW), 10 * (1 - np.cos(YAW)), 0.1 * YAW], axis=1)
Q = np.stack([0 * YAW, 0 * YAW, np.sin(YAW / 2), np.cos(YAW / 2)], axis=1)
R = so3.from_quaternion(Q)
Cells = Callable[[int], list[str]]


def seconds(i: int) -> str:
    return f"{NS[i] // 10**9}.{NS[i] % 10**9:09d}"


def parts(i: int) -> list[str]:
    return [str(NS[i] // 10**9), str(NS[i] % 10**9)]


def pose(i: int, order: str = "xyzw") -> list[str]:
    q = dict(zip("xyzw", Q[i], strict=True))
    return [f"{v:.9f}" for v in (*P[i], *(q[axis] for axis in order))]


def matrix(i: int, size: int = 12) -> list[str]:
    T = se3.make(R[i], P[i]).ravel()
    return [f"{v:.12f}" for v in T[:size]]


def lines(cells: Cells, separator: str = " ", header: str = "") -> str:
    rows = [separator.join(cells(i)) for i in range(COUNT)]
    return "\n".join([header, *rows] if header else rows) + "\n"


NAMES = "x,y,z,qx,qy,qz,qw"
VECTORS = (*(f"position/{a}" for a in "xyz"), *(f"orientation/{a}" for a in "xyzw"))
NAV = ",".join(
    f"field.pose.pose.{k}" for k in ("position.x", "position.y", "position.z", *(f"orientation.{a}" for a in "xyzw"))
)
FILES = {
    "sec and nanosec": lines(lambda i: parts(i) + pose(i), ",", f"sec,nanosec,{NAMES}"),
    "sec and nsec": lines(lambda i: parts(i) + pose(i), ",", f"sec,nsec,{NAMES}"),
    "sec and nsec in a comment": lines(lambda i: parts(i) + pose(i), ",", f"#sec,nsec,{NAMES}"),
    "secs and nsecs": lines(lambda i: parts(i) + pose(i), ",", f"secs,nsecs,{NAMES}"),
    "a stamp's seconds": lines(
        lambda i: [str(i), *parts(i), "map", *pose(i)], ",", f"header.seq,header.stamp.sec,header.stamp.nanosec,frame,{NAMES}"
    ),
    "seconds beside a column of another name": lines(lambda i: parts(i) + pose(i), ",", f"time,remainder,{NAMES}"),
    "time_s and time_ns": lines(lambda i: parts(i) + pose(i), ",", f"time_s,time_ns,{NAMES}"),
    "both complete": lines(lambda i: [seconds(i), str(NS[i]), *pose(i)], ",", f"sec,nsec,{NAMES}"),
    "an index called time": lines(lambda i: [str(i), seconds(i), *pose(i)], ",", f"time,timestamp,{NAMES}"),
    "nanoseconds before the pose": lines(lambda i: parts(i)[::-1] + pose(i), ",", f"nsec,sec,{NAMES}"),
    "quoted": lines(lambda i: [seconds(i), *pose(i)], ",", ",".join(f'"{n}"' for n in f"t,{NAMES}".split(","))),
    "rostopic": lines(
        lambda i: [str(NS[i] + 3_000_000), str(i), str(NS[i]), "odom", *pose(i), *["0.1"] * 36, *["0"] * 3], ",",
        f"%time,field.header.seq,field.header.stamp,field.header.frame_id,{NAV},"
        + ",".join(f"field.pose.covariance{k}" for k in range(36))
        + ",field.twist.twist.linear.x,field.twist.twist.linear.y,field.twist.twist.linear.z",
    ),
    "rostopic of transforms": lines(
        lambda i: [str(NS[i]), *pose(i)], ",",
        "%time," + ",".join(f"field.transform.{'translation' if k[0] == 'p' else 'rotation'}.{k[-1]}" for k in VECTORS),
    ),
    "bagpy": lines(
        lambda i: [f"{NS[i] / 1e9 + 0.004:.6f}", *parts(i), *pose(i)], ",",
        "Time,header.stamp.secs,header.stamp.nsecs," + NAV.replace("field.", ""),
    ),
    "PlotJuggler": lines(
        lambda i: [f"{NS[i] / 1e9 + 0.01:.6f}", seconds(i), *pose(i), "0.1", "0.2", "0.3", "1.5"], ",",
        "__time,/odom/header/stamp,"
        + ",".join(f"/odom/pose/pose/{k}" for k in (*VECTORS, *(f"orientation/{a}_deg" for a in ("roll", "pitch", "yaw"))))
        + ",/odom/twist/twist/linear/x",
    ),
    "pandas with a name for the index": lines(lambda i: [str(i), seconds(i), *pose(i)], ",", f"Unnamed: 0,timestamp,{NAMES}"),
    "pandas": lines(lambda i: [str(i), seconds(i), *pose(i)], ",", f",timestamp,{NAMES}"),
    "pandas with dates": lines(
        lambda i: [f"{np.datetime64(int(NS[i]), 'ns')}".replace("T", " "), *pose(i)], ",", f",{NAMES}"
    ),
    "pandas with a time zone": lines(
        lambda i: [f"{np.datetime64(int(NS[i]) + 7_200_000_000_000, 'ns')}+02:00", *pose(i)], ",", f"time,{NAMES}"
    ),
    "TUM": lines(lambda i: [seconds(i), *pose(i)]),
    "TUM in nanoseconds": lines(lambda i: [str(NS[i]), *pose(i)]),
    "TUM in nanoseconds between commas": lines(lambda i: [str(NS[i]), *pose(i)], ","),
    "TUM with a ninth column": lines(lambda i: [seconds(i), *pose(i), "0.97"]),
    "TUM behind an index": lines(lambda i: [str(i), seconds(i), *pose(i)]),
    "TUM in sec and nsec": lines(lambda i: parts(i) + pose(i)),
    "TUM behind an index in sec and nsec": lines(lambda i: [str(i), *parts(i), *pose(i)]),
    "TUM with w first in a comment": lines(lambda i: [seconds(i), *pose(i, "wxyz")], " ", "# timestamp tx ty tz qw qx qy qz"),
    "TUM with tabs": lines(lambda i: [seconds(i), *pose(i)], "\t"),
    "percent": lines(lambda i: [seconds(i), *pose(i)], " ", "% written by a matrix laboratory"),
    "semicolons": lines(lambda i: [v.replace(".", ",") for v in (seconds(i), *pose(i))], ";", "t;" + NAMES.replace(",", ";")),
    "EuRoC": lines(lambda i: [str(NS[i]), *pose(i, "wxyz"), "0", "0", "0"], ",", "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],"
    "p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1]"),
    "EuRoC without names": lines(lambda i: [str(NS[i]), *pose(i, "wxyz")], ","),
    "stamped matrices": lines(lambda i: [seconds(i), *matrix(i)]),
    "stamped 4x4": lines(lambda i: [seconds(i), *matrix(i, 16)]),
    "stamped matrices between commas": lines(lambda i: [str(NS[i]), *matrix(i)], ","),
    "EuRoC with biases, without names": lines(lambda i: [str(NS[i]), *pose(i, "wxyz"), *["0.1"] * 9], ","),
    "a comment of two slashes": lines(lambda i: [seconds(i), *pose(i)], " ", f"// t {NAMES}"),
}  # fmt: skip


@pytest.mark.parametrize("kind", FILES)
def test_the_drive_comes_back(kind: str, tmp_path: Path) -> None:
    (tmp_path / "gt.csv").write_text(FILES[kind])
    trajectory = read_trajectory(tmp_path / "gt.csv")
    assert trajectory.has_stamps
    assert trajectory.has_rotations
    assert trajectory.stamps_ns.tolist() == NS.tolist()
    np.testing.assert_allclose(trajectory.positions, P, atol=1e-8)
    np.testing.assert_allclose(trajectory.poses[:, :3, :3], R, atol=1e-8)


@pytest.mark.parametrize(
    ("kind", "note"),
    [
        ("rostopic", "the time is field.header.stamp; left out: time"),
        ("bagpy", "the time is header.stamp.secs and header.stamp.nsecs; left out: Time"),
        ("PlotJuggler", "the time is /odom/header/stamp; left out: __time"),
        ("an index called time", "the time is timestamp; left out: time"),
        ("TUM with a ninth column", "from column 9 on are left out"),
        ("TUM in nanoseconds between commas", "quaternions are read with w last"),
        ("stamped matrices", "the time, then 3x4 matrices"),
        ("EuRoC", "left out: v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]"),
        ("rostopic", "left out: field.header.frame_id, field.pose.covariance0, "),
    ],
)
def test_what_was_chosen_is_said(kind: str, note: str, tmp_path: Path) -> None:
    (tmp_path / "gt.csv").write_text(FILES[kind])
    assert note in "; ".join(read_trajectory(tmp_path / "gt.csv").notes)


def test_an_order_of_quaternions_that_the_motion_denies_is_said(tmp_path: Path) -> None:
    (tmp_path / "gt.tum").write_text(lines(lambda i: [seconds(i), *pose(i, "wxyz")]))
    trajectory = read_trajectory(tmp_path / "gt.tum")
    assert "w first fits the motion better: --format euroc" in "; ".join(trajectory.notes)
    (tmp_path / "gt.tum").write_text(FILES["pandas"])
    assert not read_trajectory(tmp_path / "gt.tum").notes


@pytest.mark.parametrize("step_ns", [1_000_000_000, 200_000_000, 2_500_000])
def test_any_rate_in_two_columns(step_ns: int, tmp_path: Path) -> None:
    """At 1 Hz the seconds alone increase too: 0.45 s off without the other column."""
    stamps = 1_700_000_000_450_000_000 + np.arange(30) * step_ns
    rows = [f"{t // 10**9},{t % 10**9},{k},{k * k},0,0,0,0,1" for k, t in enumerate(stamps.tolist())]
    (tmp_path / "gt.csv").write_text("\n".join(["sec,nanosec,x,y,z,qx,qy,qz,qw", *rows]))
    assert read_trajectory(tmp_path / "gt.csv").stamps_ns.tolist() == stamps.tolist()


@pytest.mark.parametrize(("unit", "name"), [(1, "t"), (1_000, "time"), (1_000_000, "stamp")])
@pytest.mark.parametrize("start", [0, 1_700_000_000_000_000_000])
def test_whole_numbers_are_in_the_unit_of_their_size_and_step(unit: int, name: str, start: int, tmp_path: Path) -> None:
    stamps = start + np.arange(20) * 100_000_000
    rows = [f"{t // unit},{k},0,0" for k, t in enumerate(stamps.tolist())]
    (tmp_path / "gt.csv").write_text("\n".join([f"{name},x,y,z", *rows]))
    assert read_trajectory(tmp_path / "gt.csv").stamps_ns.tolist() == stamps.tolist()


ALONE = {
    "a prism": lines(lambda i: [str(NS[i]), *pose(i)[:3]], ",", "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]"),
    "a point of ROS": lines(lambda i: [str(NS[i]), *pose(i)[:3]], ",", "%time,field.point.x,field.point.y,field.point.z"),
    "RTK": lines(lambda i: [*parts(i), *pose(i)[:3]], ",", "sec,nsec,easting,northing,up"),
    "ENU": lines(lambda i: [f"{np.datetime64(int(NS[i]), 'ns')}Z", *pose(i)[:3]], ",", "utc,E,N,U"),
    "heights, and velocities": lines(
        lambda i: [seconds(i), *pose(i)[:3], "1", "2", "3"], ",", "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up"
    ),
    "a count beside": lines(lambda i: [str(7 - i % 3), seconds(i), *pose(i)[:3], ""], ",", "n,t,x,y,z,"),
    "blanks": lines(lambda i: [seconds(i), *pose(i)[:3]]),
    "blanks and two columns of time": lines(lambda i: [*parts(i), *pose(i)[:3]]),
    "commas": lines(lambda i: [seconds(i), *pose(i)[:3]], ","),
    "angles": lines(lambda i: [seconds(i), *pose(i)[:3], "0", "0", f"{YAW[i]}"], ",", "t,x,y,z,roll,pitch,yaw"),
    "zero quaternions": lines(lambda i: [seconds(i), *pose(i)[:3], "0", "0", "0", "0"]),
    "identity": lines(lambda i: [seconds(i), *pose(i)[:3], "0", "0", "0", "1"]),
    "identity by names": lines(lambda i: [seconds(i), *pose(i)[:3], "0", "0", "0", "1"], ",", f"t,{NAMES}"),
    "identity of the other order": lines(lambda i: [seconds(i), *pose(i)[:3], "1.0", "0.0", "0.0", "0.0"]),
}  # fmt: skip


@pytest.mark.parametrize("kind", ALONE)
def test_positions_alone(kind: str, tmp_path: Path) -> None:
    (tmp_path / "gt.csv").write_text(ALONE[kind])
    trajectory = read_trajectory(tmp_path / "gt.csv")
    assert not trajectory.has_rotations
    assert trajectory.stamps_ns.tolist() == NS.tolist()
    np.testing.assert_allclose(trajectory.positions, P, atol=1e-8)
    left_out = {
        "angles": "roll, pitch, yaw",
        "a count beside": "n",
        "heights, and velocities": "vel_east, vel_north, vel_up",
    }
    assert bool(trajectory.notes) == (kind in (*left_out, "zero quaternions") or "identity" in kind)
    if kind in left_out:
        hint = "; rotations are read as quaternions (qx, qy, qz, qw)"
        assert trajectory.notes == (f"left out: {left_out[kind]}{hint}",)


def test_only_tables_of_euroc_are_of_the_imu(tmp_path: Path) -> None:
    """The first cell of others begins with nanoseconds too."""
    for kind, frame in (("rostopic", "unknown"), ("EuRoC", "imu"), ("EuRoC without names", "imu")):
        (tmp_path / "gt.csv").write_text(FILES[kind])
        assert read_trajectory(tmp_path / "gt.csv").frame == frame


def test_a_straight_drive_without_turns_has_rotations(tmp_path: Path) -> None:
    (tmp_path / "gt.tum").write_text("".join(f"{k}.5 {k} 0 0 0 0 0 1\n" for k in range(20)))
    assert read_trajectory(tmp_path / "gt.tum").has_rotations


@pytest.mark.parametrize("missing", ["nan", "NaN", ""])
def test_rows_of_nan_are_lost_poses(missing: str, tmp_path: Path) -> None:
    rows = [[seconds(i), *pose(i)] for i in range(COUNT)]
    for i in (0, 7, 8):
        rows[i][1:] = [missing] * 7
    (tmp_path / "gt.csv").write_text("\n".join([f"t,{NAMES}", *(",".join(row) for row in rows)]))
    trajectory = read_trajectory(tmp_path / "gt.csv")
    kept = [i for i in range(COUNT) if i not in (0, 7, 8)]
    assert trajectory.stamps_ns.tolist() == NS[kept].tolist()
    np.testing.assert_allclose(trajectory.positions, P[kept], atol=1e-8)
    assert trajectory.notes == ("3 of 40 rows hold NaN or no numbers: lost poses, left out",)


def test_a_header_stamp_that_stands_still_is_no_time(tmp_path: Path) -> None:
    rows = [f"{NS[i]},1700000000000000000," + ",".join(pose(i)) for i in range(COUNT)]
    (tmp_path / "gt.csv").write_text("\n".join([f"%time,field.header.stamp,{NAMES}", *rows]))
    assert read_trajectory(tmp_path / "gt.csv").stamps_ns.tolist() == NS.tolist()


def test_numbers_of_scans_before_matrices(tmp_path: Path) -> None:
    """KITTI-360 has poses of some scans only, and their numbers."""
    scans = [1, 2, 5, 8, 9]
    (tmp_path / "poses.txt").write_text("\n".join(" ".join([str(k), *matrix(k)]) for k in scans))
    (tmp_path / "times.txt").write_text("\n".join(f"{0.1 * k:.9f}" for k in range(12)))
    trajectory = read_trajectory(tmp_path / "poses.txt")
    assert trajectory.stamps_ns.tolist() == [k * 100_000_000 for k in scans]
    assert trajectory.has_stamps
    np.testing.assert_allclose(trajectory.positions, P[scans], atol=1e-8)
    files = [Path(f"{k:010d}.bin") for k in range(8)]
    voice = Voice([], [])
    truth = load_poses(tmp_path / "poses.txt", np.arange(8, dtype=np.int64) * 7, files, voice)
    assert truth is not None
    assert truth.stamps_ns.tolist() == [7, 14, 35]
    np.testing.assert_allclose(truth.positions, P[[1, 2, 5]], atol=1e-8)


def test_four_by_four_row_by_row_or_column_by_column(tmp_path: Path) -> None:
    (tmp_path / "rows.txt").write_text(lines(lambda i: matrix(i, 16)))
    columns = [" ".join(f"{v:.12f}" for v in se3.make(R[i], P[i]).T.ravel()) for i in range(COUNT)]
    (tmp_path / "columns.txt").write_text("\n".join(columns))
    for name in ("rows.txt", "columns.txt"):
        trajectory = read_trajectory(tmp_path / name)
        assert not trajectory.has_stamps
        np.testing.assert_allclose(trajectory.poses, se3.make(R, P), atol=1e-8)


REFUSED = {
    "two bodies": ("t," + ",".join(f"{b}/position/{a}" for b in "ab" for a in "xyz") + "\n1,1,2,3,4,5,6\n", "2 bodies"),
    "no time": ("x,y,z\n1,2,3\n2,2,3\n", "no column is a time"),
    "seven": ("1 2 3 4 5 6 7\n", "7 columns are no trajectory format .* name the columns"),
    "only NaN": ("1 nan 0 0 0 0 0 1\n", "every row holds NaN"),
    "a date without a month": ("time,x,y,z\n2023-13-01 00:00:00,1,2,3\n", "line 2: .* is no time"),
    "geographic": ("t,lat,lon,alt\n1,49,8,100\n", "no column for x, y, z"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_refusals_name_the_way_out(kind: str, tmp_path: Path) -> None:
    text, sentence = REFUSED[kind]
    (tmp_path / "gt.csv").write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_trajectory(tmp_path / "gt.csv")


def test_positions_of_another_place_are_taken_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "gt.csv").write_text(ALONE["RTK"])
    voice = Voice([], [])
    truth = load_poses(tmp_path / "gt.csv", NS, [], voice)
    assert truth is not None
    moved = to_lidar(truth, "imu", Calibration(), voice, se3.make(np.eye(3), np.array([0.3, 0, 0.4])))
    assert moved is not None
    np.testing.assert_array_equal(moved.positions, truth.positions)
    assert "lever arm of 0.50 m stays in them" in voice.notes[-1]

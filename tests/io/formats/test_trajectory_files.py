"""Trajectory files: exact round trips, detection, and one sentence for every way a file can be wrong."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lslam.core.errors import InputError, LslamError, OutputError, UsageError
from lslam.core.geometry import se3
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.text_tables import seconds_text, seconds_to_ns
from lslam.io.formats.time_columns import read_times
from lslam.io.formats.trajectory_csv import write_euroc
from lslam.io.formats.trajectory_files import FORMATS, read_trajectory
from lslam.io.formats.trajectory_lines import find_times, write_kitti, write_tum

START = 1_317_042_272_349_659_964


def sample(count: int = 20, seed: int = 1, frame: str = "lidar") -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = se3.exp(np.concatenate([rng.uniform(-500, 500, (count, 3)), rng.uniform(-1.7, 1.7, (count, 3))], axis=1))
    stamps = START + np.cumsum(rng.integers(1, 2 * 10**8, count))
    return Trajectory(stamps.astype(np.int64), poses, frame=frame)


@pytest.mark.parametrize(("write", "name"), [(write_tum, "a.tum"), (write_euroc, "a.csv")])
def test_round_trip_with_stamps(write: Callable[[Path, Trajectory], None], name: str, tmp_path: Path) -> None:
    trajectory = sample()
    write(tmp_path / name, trajectory)
    again = read_trajectory(tmp_path / name)
    assert again.stamps_ns.tolist() == trajectory.stamps_ns.tolist()
    np.testing.assert_allclose(again.poses, trajectory.poses, atol=1e-9, rtol=0)
    assert again.frame == "lidar"
    assert again.has_stamps
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_round_trip_of_kitti(tmp_path: Path) -> None:
    trajectory = sample()
    write_kitti(tmp_path / "07.txt", trajectory)
    again = read_trajectory(tmp_path / "07.txt")
    np.testing.assert_allclose(again.poses, trajectory.poses, atol=1e-9, rtol=0)
    assert (again.frame, again.has_stamps) == ("cam0", False)
    assert again.stamps_ns.tolist() == list(range(0, 2_000_000_000, 100_000_000))


def test_tum_lines_are_what_other_tools_expect(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", sample(2), comment="pose_time: scan_start")
    lines = (tmp_path / "a.tum").read_text().splitlines()
    assert "# frame: lidar" in lines
    assert "# pose_time: scan_start" in lines
    fields = lines[-1].split(" ")
    assert len(fields) == 8
    assert len(fields[0].split(".")[1]) == 9
    assert all(len(f.split(".")[1]) >= 9 for f in fields[4:])


@given(st.integers(-(2**60), 2**60))
def test_seconds_are_exact(stamp: int) -> None:
    assert seconds_to_ns(seconds_text(stamp), Path("x"), 1) == stamp


@given(arrays(np.float64, (3, 6), elements=st.floats(-1.7, 1.7)))
@settings(max_examples=30)
def test_any_rotation_survives(twists: np.ndarray) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        trajectory = Trajectory(np.array([0, 1, 2], np.int64), se3.exp(twists))
        write_tum(Path(folder) / "a.tum", trajectory)
        np.testing.assert_allclose(read_trajectory(Path(folder) / "a.tum").poses, trajectory.poses, atol=1e-9)


def test_kitti_matrices_are_kept_as_printed(tmp_path: Path) -> None:
    """Six digits are no exact rotation; repairing them here would change what other tools measure."""
    line = (
        "9.999978e-01 5.272628e-04 -2.066935e-03 -4.690294e-02 -5.296506e-04 9.999992e-01 -1.154865e-03 -2.839928e-02 "
    )
    line += "2.066324e-03 1.155958e-03 9.999971e-01 8.586941e-01"
    (tmp_path / "00.txt").write_text(line + "\n")
    assert read_trajectory(tmp_path / "00.txt").poses[0, 0, 1] == 5.272628e-04


def test_times_beside_a_kitti_file_are_used(tmp_path: Path) -> None:
    (tmp_path / "poses").mkdir()
    (tmp_path / "sequences/07").mkdir(parents=True)
    write_kitti(tmp_path / "poses/07.txt", sample(3))
    (tmp_path / "sequences/07/times.txt").write_text("0.000000e+00\n1.037359e-01\n2.073381e-01\n")
    assert find_times(tmp_path / "poses/07.txt") == tmp_path / "sequences/07/times.txt"
    again = read_trajectory(tmp_path / "poses/07.txt")
    assert again.stamps_ns.tolist() == [0, 103_735_900, 207_338_100]
    assert again.has_stamps


def test_times_of_another_length_are_ignored_with_a_warning_or_an_error(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_kitti(tmp_path / "est.txt", sample(3))
    (tmp_path / "times.txt").write_text("0.0\n0.1\n")
    with caplog.at_level(logging.WARNING, logger="lslam"):
        logging.getLogger("lslam").propagate = True
        assert not read_trajectory(tmp_path / "est.txt").has_stamps
    assert "2 stamps" in caplog.text
    with pytest.raises(InputError, match=r"2 stamps .* 3 poses"):
        read_trajectory(tmp_path / "est.txt", times=tmp_path / "times.txt")


CSV = {
    "mcd": "num,t,x,y,z,qx,qy,qz,qw\n11,1670403902.235281229,1,2,3,0,0,0,1\n12,1670403902.337636471,2,2,3,0,0,0,1\n",
    "euroc": "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v [m s^-1]\n"
    "1670403902235281229,1,2,3,1,0,0,0,9\n1670403902337636471,2,2,3,1,0,0,0,9\n",
    "bare euroc": "1670403902235281229,1,2,3,1,0,0,0\n1670403902337636471,2,2,3,1,0,0,0\n",
    "ns in the name": "time_ns;x;y;z;qw;qx;qy;qz\n1670403902235281229;1;2;3;1;0;0;0\n1670403902337636471;2;2;3;1;0;0;0\n",
    "ros": "timestamp [s],pose.position.x,pose.position.y,pose.position.z,orientation.x,orientation.y,orientation.z,orientation.w"
    "\n1670403902.235281229,1,2,3,0,0,0,1\n1670403902.337636471,2,2,3,0,0,0,1\n",
    "spaces": "t tx ty tz qx qy qz qw\n1670403902.235281229 1 2 3 0 0 0 1\n1670403902.337636471 2 2 3 0 0 0 1\n",
}


@pytest.mark.parametrize("kind", CSV)
def test_tables_with_names(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text(CSV[kind])
    trajectory = read_trajectory(path)
    assert trajectory.stamps_ns.tolist() == [1670403902235281229, 1670403902337636471]
    assert trajectory.positions.tolist() == [[1, 2, 3], [2, 2, 3]]
    np.testing.assert_array_equal(trajectory.poses[:, :3, :3], np.tile(np.eye(3), (2, 1, 1)))


def test_small_numbers_are_seconds_and_a_unit_decides(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,x,y,z,qx,qy,qz,qw\n0.5,0,0,0,0,0,0,1\n1.5,0,0,0,0,0,0,1\n")
    assert read_trajectory(tmp_path / "a.csv").stamps_ns.tolist() == [500_000_000, 1_500_000_000]
    (tmp_path / "a.csv").write_text("t [ms],x,y,z,qx,qy,qz,qw\n500,0,0,0,0,0,0,1\n1500,0,0,0,0,0,0,1\n")
    assert read_trajectory(tmp_path / "a.csv").stamps_ns.tolist() == [500_000_000, 1_500_000_000]


GOOD = "0.0 0 0 0 0 0 0 1\n"
WRONG = {
    "empty.tum": ("", "no poses"),
    "comments.tum": ("# frame: lidar\n\n", "no poses"),
    "short.tum": (GOOD + "0.1 0 0 0 0 0\n", "line 2: 6 columns"),
    "long.tum": (GOOD + "0.1 0 0 0 0 0 0 1 5\n", "line 2: 9 columns"),
    "text.tum": (GOOD + "# ok\n0.1 0 zero 0 0 0 0 1\n", "line 3: not a number"),
    "nan.tum": ("0.1 nan 0 0 0 0 0 1\n", "every row holds NaN"),
    "inf.tum": (GOOD + "0.1 inf 0 0 0 0 0 1\n", "line 2: NaN or infinity"),
    "back.tum": ("0.2 0 0 0 0 0 0 1\n" + GOOD, "line 2: .* goes back"),
    "twice.tum": (GOOD + GOOD, "line 2: .* repeats"),
    "quaternion.tum": (GOOD + "0.1 0 0 0 0 0 0 0\n", "line 2: quaternion of length 0"),
    "late.tum": (GOOD + "1e300 0 0 0 0 0 0 1\n", "line 2: .* out of range"),
    "digits.csv": ("t,x,y,z,qx,qy,qz,qw\n1E999999999999999999,0,0,0,0,0,0,1\n", "line 2: .* is no time"),
    "far.csv": ("t,x,y,z,qx,qy,qz,qw\n1e999999,0,0,0,0,0,0,1\n", "line 2: time 1e999999 is out of range"),
    "rotation.txt": ("1 0 0 0 0 1 0 0 0 0 2 0\n", "line 1: .* no rotation"),
    "mirror.txt": ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 1: .* no rotation"),
    "columns.txt": ("1 2 3\n", "line 1: 3 columns are no trajectory format"),
    "bare.csv": ("1,2,3,4,5,6,7,8\n", "without a header"),
    "missing.csv": ("t,x,y,z,qx,qy,qz\n1,2,3,4,0,0,0\n", "no column for qw"),
    "planar.csv": ("t,x,y,yaw\n1,2,3,4\n", "no column for z"),
    "header.csv": ("t,x,y,z,qx,qy,qz,qw\n", "header but no poses"),
    "short.csv": ("t,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n1,0,0\n", "line 3: 3 columns"),
    "inf.csv": ("t,x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n1,inf,0,0,0,0,0,1\n", "line 3: NaN or infinity"),
    "time.csv": ("t,x,y,z,qx,qy,qz,qw\nsoon,0,0,0,0,0,0,1\n", "line 2: 'soon' is no time"),
}


@pytest.mark.parametrize("name", WRONG)
def test_errors_name_file_and_line(name: str, tmp_path: Path) -> None:
    text, sentence = WRONG[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=sentence) as caught:
        read_trajectory(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_no_text_or_not_there(tmp_path: Path) -> None:
    (tmp_path / "scan.bin").write_bytes(bytes(range(128, 256)) * 20)
    with pytest.raises(InputError, match="not a text file"):
        read_trajectory(tmp_path / "scan.bin")
    with pytest.raises(InputError, match="does not exist"):
        read_trajectory(tmp_path / "nothing.tum")
    with pytest.raises(InputError, match=r"without trajectory\.tum"):
        read_trajectory(tmp_path)
    (tmp_path / "a.tum").write_text(GOOD)
    with pytest.raises(UsageError, match="did you mean 'tum'"):
        read_trajectory(tmp_path / "a.tum", format="tumm")


def test_a_forced_format_is_obeyed(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(GOOD)
    with pytest.raises(InputError, match="8 columns where KITTI poses has 12"):
        read_trajectory(tmp_path / "a.txt", format="kitti")


@given(st.binary(max_size=200) | st.text(alphabet="0123456789.,-enaif#tqxyzw \n", max_size=200).map(str.encode))
@settings(max_examples=150)
def test_no_file_makes_a_traceback(content: bytes) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "any.txt"
        path.write_bytes(content)
        try:
            trajectory = read_trajectory(path)
        except LslamError:
            return
        assert np.isfinite(trajectory.poses).all()


def test_a_folder_that_is_not_there_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write_tum(tmp_path / "none" / "a.tum", sample(3))


def test_times_must_increase(tmp_path: Path) -> None:
    (tmp_path / "times.txt").write_text("0.0\n0.1\n0.1\n")
    with pytest.raises(InputError, match="line 3"):
        read_times(tmp_path / "times.txt")


def test_real_files(recordings: Callable[[str], Path]) -> None:
    truth = read_trajectory(recordings("mcd_kth_day_06") / "mcd_kth_day_06/pose_inW.csv")
    assert len(truth) == 8897
    assert truth.stamps_ns[0] == 1670403902235281229
    drive = recordings("kitti_raw_0005") / "2011_09_26/2011_09_26_drive_0005_sync"
    assert len(read_trajectory(drive / "reference_lidar.tum")) == 154
    poses = read_trajectory(recordings("kitti_poses") / "kitti_poses/ground_truth/00.txt")
    assert (len(poses), poses.has_stamps, int(poses.stamps_ns[1])) == (4541, True, 103_735_900)


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_of_the_table_reads_what_it_writes(name: str, tmp_path: Path) -> None:
    one = FORMATS[name]
    one.write(tmp_path / "a", sample())
    again = read_trajectory(tmp_path / "a")
    np.testing.assert_allclose(again.poses, sample().poses, atol=1e-9, rtol=0)
    assert again.has_stamps == one.has_stamps
    first = next(line for line in (tmp_path / "a").read_text().splitlines() if not line.startswith("#"))
    assert next(other for other in FORMATS if FORMATS[other].fits(first)) == name


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [(3 * "1 2 3 4 5 6 7 8 9 10 11 12\n", "line 2: the 3x3 part is no rotation"), ("", "no poses")],
)
def test_matrices_below_a_header_are_read_or_refused_in_a_sentence(rows: str, sentence: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("a b c d e f g h i j k l\n" + rows)
    with pytest.raises(InputError, match=sentence):
        read_trajectory(tmp_path / "a.txt", "kitti")
    (tmp_path / "a.txt").write_text("a b c d e f g h i j k l\n" + 3 * "1 0 0 4 0 1 0 8 0 0 1 12\n")
    assert read_trajectory(tmp_path / "a.txt", "kitti").positions.tolist() == 3 * [[4, 8, 12]]

"""A drive written to disk and read back; nothing half-written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import OutputError, OutputExistsError
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.io.formats.kitti_layout import read_odometry_calib
from lslam.io.formats.sequence_toml import read_sequence_toml
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.simulation.record import record
from lslam.simulation.scenarios import SimulatedDrive, simulate

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return simulate("block", count=4, motion_compensated=False)


def files_of(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_what_is_read_is_what_was_simulated(drive: SimulatedDrive, tmp_path: Path) -> None:
    done = record(drive, tmp_path / "out")
    folder = tmp_path / "out" / "sequences" / "00"
    assert done.sequence == folder
    for index, scan in enumerate(drive):
        raw = np.fromfile(folder / "velodyne" / f"{index:06d}.bin", "<f4").reshape(-1, 4)
        np.testing.assert_array_equal(raw[:, :3], scan.points)
        np.testing.assert_array_equal(raw[:, 3], scan.intensity)
        with np.load(folder / "per_point" / f"{index:06d}.npz") as beside:
            np.testing.assert_array_equal(beside["t"], scan.times)
            np.testing.assert_array_equal(beside["ring"], scan.rings)
            assert (beside["t"].dtype, beside["ring"].dtype) == (np.float32, np.uint16)
    info = read_sequence_toml(folder / "sequence.toml")
    assert info.motion_compensated is False
    assert info.vertical_correction_deg == 0.0
    assert (info.rings, info.rate_hz, info.per_point) == (16, 10.0, "per_point")
    assert info.ground_truth is not None
    assert (folder / info.ground_truth).resolve() == done.poses.resolve()


def test_ground_truth_comes_back_through_the_camera(drive: SimulatedDrive, tmp_path: Path) -> None:
    done = record(drive, tmp_path / "out")
    cam0 = read_trajectory(done.poses)
    Tr = read_odometry_calib(done.sequence / "calib.txt")
    assert Tr is not None
    assert drive.ground_truth is not None
    lidar = se3.inverse(Tr) @ cam0.poses @ Tr
    np.testing.assert_allclose(lidar, drive.ground_truth.poses, atol=1e-10)
    np.testing.assert_array_equal(cam0.stamps_ns, drive.stamps_ns)
    assert cam0.positions[-1, 2] > 2.0, "a camera's forward is z"
    assert np.abs(np.degrees(np.arccos(Tr[2, 0]))) < 1.0


def test_a_reader_opens_it(drive: SimulatedDrive, tmp_path: Path) -> None:
    from lslam.io.readers import open_sequence

    record(drive, tmp_path / "out")
    sequence = open_sequence(tmp_path / "out")
    assert len(sequence) == len(drive)
    assert sequence.problems == []
    assert sequence.motion_compensated is False
    scan = sequence.scan(2)
    expected = drive.scan(2)
    np.testing.assert_array_equal(scan.points, expected.points)
    np.testing.assert_array_equal(scan.times, expected.times)
    np.testing.assert_array_equal(scan.rings, expected.rings)
    assert sequence.ground_truth is not None
    assert drive.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.poses, drive.ground_truth.poses, atol=1e-9)


def test_same_seed_same_files(drive: SimulatedDrive, tmp_path: Path) -> None:
    record(drive, tmp_path / "a")
    record(simulate("block", count=4, motion_compensated=False), tmp_path / "b")
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")


def test_an_existing_folder_is_replaced_only_when_asked(drive: SimulatedDrive, tmp_path: Path) -> None:
    out = tmp_path / "out"
    record(simulate("block", count=6), out)
    (out / "README.md").write_text("mine")
    before = files_of(out)
    with pytest.raises(OutputExistsError, match="--overwrite"):
        record(drive, out)
    assert files_of(out) == before
    record(drive, out, overwrite=True)
    after = files_of(out)
    assert after.pop("README.md") == b"mine"
    assert sum(name.endswith(".bin") for name in after) == 4
    record(drive, tmp_path / "fresh")
    assert after == files_of(tmp_path / "fresh")


def test_an_empty_folder_is_fine_and_a_file_is_not(drive: SimulatedDrive, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    record(drive, tmp_path / "empty")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputExistsError, match="is a file"):
        record(drive, tmp_path / "file", overwrite=True)
    with pytest.raises(OutputError, match="cannot be"):
        record(drive, tmp_path / "file" / "below")


def test_a_failure_before_the_first_scan_leaves_nothing(
    drive: SimulatedDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: SimulatedDrive, index: int) -> Scan:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(SimulatedDrive, "scan", broken)
    with pytest.raises(OutputError, match="No space left"):
        record(drive, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_was_interrupted_goes_on_with_the_same_bytes(drive: SimulatedDrive, tmp_path: Path) -> None:
    traced: list[int] = []

    def stop(index: int) -> None:
        if index == 1:
            raise KeyboardInterrupt

    record(drive, tmp_path / "whole")
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        record(drive, out, on_scan=stop)
    assert not (out / "sequences" / "00").exists()
    part = out / "sequences" / "00.part"
    assert sorted(p.name for p in (part / "per_point").iterdir()) == ["000000.npz", "000001.npz"]
    # A .bin whose times are missing is half a scan.
    (part / "velodyne" / "000002.bin").write_bytes(b"half")
    with pytest.raises(OutputExistsError, match="--resume goes on"):
        record(drive, out)
    stamp = (part / "velodyne" / "000000.bin").stat().st_mtime_ns
    done = record(drive, out, resume=True, on_scan=traced.append)
    assert traced == [0, 1, 2, 3]
    assert (done.sequence / "velodyne" / "000000.bin").stat().st_mtime_ns == stamp
    assert files_of(out) == files_of(tmp_path / "whole")
    assert done.points == sum(len(scan) for scan in drive)


def test_another_drive_does_not_go_on(drive: SimulatedDrive, tmp_path: Path) -> None:
    def stop(index: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(drive, tmp_path / "out", on_scan=stop)
    begun = files_of(tmp_path / "out")
    for other in (
        simulate("block", seed=1, count=4, motion_compensated=False),
        simulate("block", count=5, motion_compensated=False),
        simulate("block", count=4),
        simulate("block", count=4, motion_compensated=False, lidar="vlp16"),
        simulate("block", count=4, motion_compensated=False, speed=5.0),
    ):
        with pytest.raises(OutputExistsError, match="begun with other settings"):
            record(other, tmp_path / "out", resume=True)
    assert files_of(tmp_path / "out") == begun
    record(drive, tmp_path / "out", overwrite=True)
    assert not (tmp_path / "out" / "sequences" / "00.part").exists()


def test_there_is_nothing_to_resume_in_a_finished_or_foreign_folder(drive: SimulatedDrive, tmp_path: Path) -> None:
    record(drive, tmp_path / "out")
    with pytest.raises(OutputExistsError, match="nothing in it was interrupted"):
        record(drive, tmp_path / "out", resume=True)
    # Where nothing was begun, there is just everything to do.
    assert record(drive, tmp_path / "new", resume=True).sequence.is_dir()


def test_an_interrupted_overwrite_leaves_the_old_sequence_whole(drive: SimulatedDrive, tmp_path: Path) -> None:
    def stop(index: int) -> None:
        if index == 2:
            raise KeyboardInterrupt

    out = tmp_path / "out"
    record(drive, out)
    before = files_of(out / "sequences" / "00")
    with pytest.raises(KeyboardInterrupt):
        record(drive, out, overwrite=True, on_scan=stop)
    assert files_of(out / "sequences" / "00") == before


def test_scans_traced_ahead_by_threads_are_those_traced_one_by_one(tmp_path: Path) -> None:
    drive = simulate("identical", count=6, settings=["traffic.cars=40"], lidar="vlp16")
    record(drive, tmp_path / "out")
    for index in range(6):
        raw = np.fromfile(tmp_path / "out" / "sequences" / "00" / "velodyne" / f"{index:06d}.bin", "<f4").reshape(-1, 4)
        assert raw[:, :3].tobytes() == drive.scan(index).points.tobytes()


def test_a_disk_too_small_is_said_before_the_first_scan(
    drive: SimulatedDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Small:
        free = 1000

    monkeypatch.setattr(shutil, "disk_usage", lambda _: Small)
    with pytest.raises(OutputError, match=r"needs up to \d\.\d MB, the disk has 0\.0 MB left"):
        record(drive, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.unperturbed
def test_the_sample_is_what_the_command_in_its_readme_makes() -> None:
    """To a centimetre for all but a few points: another processor may round a ray or lose an echo differently."""
    said = json.loads((SAMPLE / "sequences" / "00" / "manifest.json").read_text(encoding="utf-8"))
    assert f"    {said['command']}\n" in (SAMPLE / "README.md").read_text()
    made = simulate("block")
    assert (said["seed"], said["scans"]) == (made.seed, len(made))
    folder = SAMPLE / "sequences" / "00"
    assert len(list((folder / "velodyne").glob("*.bin"))) == len(made)
    for index in (0, 50):
        stored, fresh = (
            np.fromfile(folder / "velodyne" / f"{index:06d}.bin", "<f4").reshape(-1, 4)[:, :3],
            made.scan(index).points,
        )
        assert abs(len(stored) - len(fresh)) <= 0.01 * len(fresh)
        from scipy.spatial import cKDTree

        assert np.mean(np.asarray(cKDTree(stored).query(fresh)[0]) < 0.01) > 0.99


def test_the_sample_is_small() -> None:
    size = sum(p.stat().st_size for p in SAMPLE.rglob("*") if p.is_file())
    assert 1e6 < size < 10_000_000
    assert len(read_trajectory(SAMPLE / "poses" / "00.txt")) == 95

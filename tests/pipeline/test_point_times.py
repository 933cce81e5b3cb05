"""A folder of bare points from a recording to a run folder: its clock in notes, manifest, info, map and resumption."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from point_writers import write_points

from lslam.cli.main import cli
from lslam.core.config import load_config
from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.geometry.se3 import poses_at
from lslam.io.readers import open_sequence
from lslam.pipeline.rebuild import open_scans, read_run
from lslam.pipeline.run import run
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

COUNT = 14
SETTINGS = ["report.html=false", "loops.use=false", "map.write=false"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans of a street as x, y, z and intensity in the order of firing, with stamps."""
    lidar = dataclasses.replace(LIDARS["vlp16"], columns=900)
    drive = simulate("street", lidar=lidar, count=COUNT, motion_compensated=False)
    place = tmp_path_factory.mktemp("bare")
    for index in range(COUNT):
        scan = drive.scan(index)
        assert scan.times is not None
        scan = scan.select(np.argsort(scan.times, kind="stable"))
        write_points(place / f"{index:06d}.bin", scan.points, scan.intensity)
    (place / "times.txt").write_text("".join(f"{stamp * 1e-9:.6f}\n" for stamp in drive.stamps_ns))
    np.save(place.parent / "truth.npy", drive.vehicle.poses(drive.stamps_ns * 1e-9))
    return place


def ran(folder: Path, out: Path | None = None, **reading: Any) -> Any:
    return run(open_sequence(folder, **reading), load_config(None, SETTINGS, {}), out=out).record


def error_m(record: Any, folder: Path) -> float:
    """Position error, m, against the truth at the starts of sweeps, both from the same first pose."""
    true = np.load(folder.parent / "truth.npy")
    off = record.trajectory.poses[:, :3, 3] - se3.relative(true[0], true)[:, :3, 3]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def test_a_run_takes_the_clock_and_its_folder_keeps_it(folder: Path, tmp_path: Path) -> None:
    record = ran(folder, tmp_path / "run")
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    facts = manifest["sequence"]["point_times"]
    assert facts["verdict"] == "clear"
    assert facts["clock"]["kind"] == "order"
    assert any(note.startswith("point times: by the order of the points") for note in manifest["sequence"]["decisions"])
    assert manifest["frames"]["deskew"].startswith("by the motion prior")
    assert manifest["status"] == "done"
    assert error_m(record, folder) < 0.7 * error_m(ran(folder, point_times="none"), folder)
    # What comes after the run works on the same times, without finding them out again.
    again = open_scans(read_run(tmp_path / "run"))
    times = again.scan(5).times
    assert times is not None
    assert np.ptp(times) == pytest.approx(0.1, abs=0.002)
    # Nor where another clock was chosen for later scans.
    facts["later"] = [{"scan": 6, "clock": {**facts["clock"], "is_reversed": True}, "verdict": "clear", "scores": {}}]
    (tmp_path / "run" / "manifest.json").write_text(json.dumps(manifest))
    changed = open_scans(read_run(tmp_path / "run"))
    np.testing.assert_array_equal(changed.scan(5).times, times)  # type: ignore[arg-type]
    later, before = changed.scan(6).times, again.scan(6).times
    assert later is not None
    assert before is not None
    np.testing.assert_allclose(later, 0.1 - before, atol=2e-3)
    # The same clock stated gives the same bytes.
    stated = ran(folder, point_times="order")
    assert stated.trajectory.poses.tobytes() == record.trajectory.poses.tobytes()


def test_a_manifest_with_another_clock_is_refused(folder: Path, tmp_path: Path) -> None:
    ran(folder, tmp_path / "run", point_times="order")
    path = tmp_path / "run" / "manifest.json"
    path.write_text(path.read_text().replace('"begin_rad"', '"begin"'))
    with pytest.raises(InputError, match="point_times"):
        open_scans(read_run(tmp_path / "run"))


def test_info_says_the_clock_and_how_clear_it_was(folder: Path) -> None:
    shown = CliRunner().invoke(cli, ["info", str(folder), "--json"])
    facts = json.loads(shown.stdout)
    assert facts["point_times"]["verdict"] == "clear"
    assert facts["points"]["per_point_times"][1] == pytest.approx(0.1, abs=0.005)
    assert any("clear by the agreement of scans (t = " in note for note in facts["notes"])
    assert not any("per-point times" in problem for problem in facts["problems"])
    quick = CliRunner().invoke(cli, ["info", str(folder), "--quick"])
    assert "per-point times    none" in quick.output
    assert "whether the order of the points tells them is not looked into" in " ".join(quick.output.split())
    assert "not looked into" not in shown.output
    stated = CliRunner().invoke(cli, ["info", str(folder), "--quick", "--point-times", "azimuth"])
    assert "point times: by the azimuth of the points, clockwise, from azimuth 0 deg" in stated.output
    assert "not looked into" not in " ".join(stated.output.split())


def test_sequence_toml_states_the_clock(folder: Path) -> None:
    toml = folder / "sequence.toml"
    try:
        toml.write_text('point_times = "order"\npoint_time_reference = "end"\n')
        stated = open_sequence(folder)
        assert (stated.stated_times.kind, stated.stated_times.reference) == ("order", "end")  # type: ignore[attr-defined]
        toml.write_text('point_times = "rows"\n')
        with pytest.raises(
            InputError, match="point_times = 'rows', expected one of field, columns, order, azimuth, none"
        ):
            open_sequence(folder)
        toml.write_text('point_times = "order"\nmotion_compensated = true\n')
        with pytest.raises(InputError, match="contradict"):
            open_sequence(folder)
    finally:
        toml.unlink()


def test_organised_clouds_of_a_recorded_walk_are_timed_by_column(recordings: Any) -> None:
    """KTH, 64 x 1024: its truth belongs to the end of each sweep. Without times its error is 0.05 m there."""
    folder = recordings("mcd_kth_day_06") / "mcd_kth_day_06"
    sequence = open_sequence(folder)
    record = run(sequence, load_config(None, SETTINGS, {})).record
    facts = record.manifest["sequence"]["point_times"]
    assert (facts["verdict"], facts["clock"]["kind"], facts["clock"]["rows"]) == ("clear", "columns", 64)
    assert not facts["clock"]["is_reversed"]
    truth = sequence.ground_truth
    assert truth is not None
    at_end = truth.stamps_ns[:-1] + 90_000_000
    found = poses_at(record.trajectory.stamps_ns, record.trajectory.poses, at_end)[:, :3, 3]
    true = truth.poses[:-1, :3, 3]
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    U, _, Vt = np.linalg.svd(found.T @ true)
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    assert np.sqrt(np.mean(np.sum((found @ R - true) ** 2, axis=1))) < 0.025

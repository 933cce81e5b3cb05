"""`graph.refine` of whole runs: drift is undone, what is right stays as it is, and points that were kept out decide."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from graph_builders import ate
from rooms import in_room, walk

import lslam
from lslam.backend.adjustment import Adjustment, SweptPoints
from lslam.core.config import load_config
from lslam.core.errors import InterruptedRunError
from lslam.core.geometry import geodesy
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.pipeline import refinement
from lslam.pipeline.refinement import PosedDrive, thinner_windows
from lslam.pipeline.watch import RunOutcome, Watch
from lslam.reports.text import summary
from lslam.simulation.scenarios import ORIGIN, simulate
from lslam.simulation.sensors import GnssModel

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "sequences" / "00"
DRIFT = ("debug.drift=true", "debug.drift_percent=1", "debug.drift_deg_per_100m=1", "loops.use=false")
SHORT = ("input.count=60", "report.html=false", "map.write=false")


def made(sequence: Sequence | Path, *settings: str, out: Path | None = None, watch: Watch | None = None) -> RunOutcome:
    return lslam.run(sequence, load_config(None, [*SHORT, *settings], {}), out=out, watch=watch, resume=out is not None)


@pytest.fixture(scope="module", params=[31, 32])
def drive(request: pytest.FixtureRequest) -> Sequence:
    return simulate("small-eight", seed=request.param, lidar="vlp16", count=60)


@pytest.mark.usefixtures("shared_odometry")
def test_drift_is_undone_without_a_loop(drive: Sequence) -> None:
    assert drive.ground_truth is not None
    truth = drive.ground_truth.poses
    before, after = (made(drive, *DRIFT, f"graph.refine={refine}").record for refine in ("false", "true"))
    assert ate(after.trajectory.poses, truth) < 0.2 * ate(before.trajectory.poses, truth)
    np.testing.assert_allclose(after.trajectory.poses[0], before.trajectory.poses[0], atol=1e-9)
    facts = after.manifest["refinement"]
    assert facts["is_taken"]
    assert facts["thickness_mm"] < facts["thickness_before_mm"]
    assert facts["moved_most_m"] > 0.1
    assert f"60 scans: planes of the points kept out {facts['thickness_mm']} mm thick" in summary(after, None)


@pytest.mark.usefixtures("shared_odometry")
def test_poses_that_no_plane_contradicts_do_not_get_worse(drive: Sequence) -> None:
    assert drive.ground_truth is not None
    truth = drive.ground_truth.poses
    before, after = (made(drive, f"graph.refine={refine}").record for refine in ("false", "true"))
    if not after.manifest["refinement"]["is_taken"]:
        np.testing.assert_array_equal(after.trajectory.poses, before.trajectory.poses)
    assert ate(after.trajectory.poses, truth) < 1.02 * ate(before.trajectory.poses, truth) + 1e-4


@pytest.mark.usefixtures("shared_odometry")
@pytest.mark.parametrize("seed", [33, 34])
def test_fixes_hold_the_place_while_planes_undo_the_drift(seed: int) -> None:
    """Odometry drifts by 4 %, fixes err by a centimetre: planes alone would leave it farther off than it was."""
    drive = simulate("small-eight", seed=seed, lidar="vlp16", count=120, gnss=GnssModel(white=0.01, slow=0.01))
    assert drive.ground_truth is not None
    truth = (drive.T_city_world @ drive.ground_truth.poses)[:, :3, 3]
    far = ("input.count=120", "debug.drift_percent=4", "debug.drift_deg_per_100m=4")
    errors = []
    for refine in ("false", "true"):
        record = made(drive, "gnss.mode=graph", *DRIFT, *far, f"graph.refine={refine}").record
        assert record.georeference is not None
        places = geodesy.from_local(record.trajectory.poses[:, :3, 3], record.georeference.origin)
        off = (geodesy.to_local(places, ORIGIN) - truth)[:, :2]
        errors.append(float(np.sqrt(np.mean(np.sum(off**2, axis=1)))))
    assert record.manifest["refinement"]["is_taken"]
    assert errors[1] < 0.85 * errors[0]


@pytest.mark.usefixtures("shared_odometry")
def test_without_points_in_range_the_run_says_so(drive: Sequence) -> None:
    beyond = ("map.range_min=500", "map.range_max=600", "map.occupancy_range=600")
    before, after = (made(drive, *beyond, f"graph.refine={refine}").record for refine in ("false", "true"))
    np.testing.assert_array_equal(after.trajectory.poses, before.trajectory.poses)
    assert "refined      no scan: no point lies within the range of the map" in summary(after, None)


def test_only_windows_whose_planes_became_thinner_are_taken() -> None:
    """The third window gets thinner by a tenth of what its cells differ by: chance."""
    rng = np.random.default_rng(0)
    scans, cells = np.repeat(np.arange(200), 20), np.tile(np.arange(20), 200)
    window = scans // 50
    differing = rng.normal(size=(4, 20)) * [[0.01], [0.01], [0.5], [0.01]]
    differing -= differing.mean(axis=1, keepdims=True)
    gain = np.array([-0.1, 0.1, -0.05, -0.1])[window] + differing[window, cells]
    gain[[3, 3000]] = np.nan
    taken = thinner_windows(gain, scans, np.column_stack([cells, 0 * cells, 0 * cells]), 200)
    np.testing.assert_array_equal(np.flatnonzero(~taken), np.arange(50, 150))
    assert not thinner_windows(np.full(4, np.nan), np.arange(4), np.zeros((4, 3), np.int64), 4).any()


def test_poses_in_frames_of_their_own_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """The correction is that of another frame; the scan that was bridged beside it follows."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.arange(6)
    results = [
        ScanResult(k, 10**8 * k, poses[k], frame=int(k == 2), status="bridged" if k == 3 else "ok") for k in range(6)
    ]
    nodes, better, drives = [0, 1, 4, 5], poses.copy(), [PosedDrive(None, results, None)]  # type: ignore[arg-type]
    better[:, 1, 3] = 0.1 * np.arange(6)
    monkeypatch.setattr(refinement, "adjust", lambda *all_of_it: Adjustment(better[nodes], 1))
    is_thinner = np.ones(4, bool)
    monkeypatch.setattr(refinement, "thinner_windows", lambda gain, scans, cells, count: is_thinner)
    swept = SweptPoints(np.random.default_rng(0).random((4000, 3)) * 4, np.zeros(4000, np.int64), np.zeros(4000))
    facts, refined = refinement._adjustment(drives, swept, None, np.zeros(0, np.int64), None)
    assert refined is not None
    (moved,) = refined
    assert facts["scans"] == 4
    np.testing.assert_array_equal(moved[2].T_world_lidar, poses[2])
    np.testing.assert_allclose([moved[k].T_world_lidar for k in (0, 1, 3, 4, 5)], better[[0, 1, 3, 4, 5]], atol=1e-9)
    # Of a drive whose last scans do not get thinner these follow; in a map they stay.
    is_thinner[2:] = False
    for known, last in ((None, better[1, :3, 3] + [4, 0, 0]), (swept.points, poses[5, :3, 3])):
        _, refined = refinement._adjustment(drives, swept, None, np.zeros(0, np.int64), known)
        assert refined is not None
        np.testing.assert_allclose(refined[0][1].T_world_lidar, better[1], atol=1e-9)
        np.testing.assert_allclose(refined[0][5].T_world_lidar[:3, 3], last, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_a_map_that_stays_draws_the_poses_into_its_frame(seed: int) -> None:
    """Located 9 cm off, with 3 mm of noise: planes of the map give the place. Poses alone would keep theirs."""
    rng, truth = np.random.default_rng(seed), walk(60)
    points, scans = in_room(truth, 600, rng)
    located = truth.copy()
    located[:, :3, 3] += [0.06, -0.06, 0.03] + 0.003 * rng.normal(size=(60, 3))
    swept = SweptPoints(
        np.einsum("nij,nj->ni", located[scans, :3, :3], points) + located[scans, :3, 3], scans, 0.0 * scans
    )
    room, seen_from = in_room(truth[::10], 6000, rng)
    prior_map = np.einsum("nij,nj->ni", truth[::10][seen_from, :3, :3], room) + truth[::10][seen_from, :3, 3]
    results = [ScanResult(k, 10**8 * k, T) for k, T in enumerate(located)]
    drives = [PosedDrive(None, results, None)]  # type: ignore[arg-type]
    for known, most in ((prior_map, 0.01), (None, np.inf)):
        facts, refined = refinement._adjustment(drives, swept, None, np.zeros(0, np.int64), known)
        assert facts["is_taken"]
        assert refined is not None
        away = np.stack([result.T_world_lidar for result in refined[0]])[:, :3, 3] - truth[:, :3, 3]
        assert np.linalg.norm(away, axis=1).max() < most
    assert np.linalg.norm(away, axis=1).max() > 0.03


def test_it_goes_on_to_the_same_bytes_with_any_number_of_threads(tmp_path: Path) -> None:
    settings = (*DRIFT, "graph.refine=true")
    made(SAMPLE, *settings, "input.threads=1", out=tmp_path / "one")

    def is_refining() -> bool:
        frame = sys._getframe(1)
        while frame is not None and frame.f_code.co_name != "refine_poses":
            frame = frame.f_back  # type: ignore[assignment]
        return frame is not None

    with pytest.raises(InterruptedRunError, match="while the poses were refined"):
        made(SAMPLE, *settings, "input.threads=2", out=tmp_path / "two", watch=Watch(should_stop=is_refining))
    assert json.loads((tmp_path / "two" / "manifest.json").read_text())["status"] == "interrupted"
    made(SAMPLE, *settings, "input.threads=2", out=tmp_path / "two")
    for name in ("trajectory.tum", "evaluation.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    assert json.loads((tmp_path / "two" / "manifest.json").read_text())["refinement"]["is_taken"]

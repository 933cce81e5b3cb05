"""Tracking that leaves off after some scan and goes on from a file gives the same bits as tracking in one go."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from stub_sequences import Stub, sample, with_points

from lslam.core.config import Config, load_config
from lslam.core.errors import InputError
from lslam.core.types.imu import ImuDiagnostics
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.io.formats.state_files import Records, read_state, write_state
from lslam.odometry import METHODS, create_odometry
from lslam.odometry.base import Resumable
from lslam.odometry.frontend.checkpoints import STATE_CLASSES
from lslam.odometry.frontend.inertial_start import Inertial, begin_inertial
from lslam.odometry.frontend.register_scans import read_ahead
from lslam.odometry.frontend.tracker import Tracker
from lslam.odometry.inertial.constant_velocity import ConstantVelocity
from lslam.odometry.stationary import StationaryDetector
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.preprocessing.views import with_rings
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

OURS = [name for name in METHODS if name not in ("kiss-icp", "small-gicp", "open3d-gicp", "poses")]
# One of each kind of state: methods that are not here share theirs with one that is.
VARIANTS: list[tuple[str, tuple[str, ...]]] = [
    ("icp", ("preprocess.skip_standing=true",)),
    ("icp", ("registration.target=keyframe", "registration.keyframes=2")),
    ("ndt", ("registration.target=scan",)),
    ("dlo", ()),
    ("ct-icp", ()),
    ("icp-svd", ()),
    ("loam", ()),
    ("lego-loam", ()),
]


def config_of(method: str, *settings: str) -> Config:
    return load_config(None, [f"odometry.method={method}", *settings], {})


def tracker_of(config: Config, part: Inertial | None = None) -> Tracker:
    stationary = StationaryDetector(config.preprocess, config.registration) if config.preprocess.skip_standing else None
    return Tracker(create_odometry(config), stationary, None if part is None else part.motion)


def tracked(tracker: Tracker, sequence: Sequence, begin: int, end: int) -> Iterator[ScanResult]:
    for loaded in list(read_ahead(sequence, tracker.odometry.prepare, 1))[begin:end]:
        yield tracker.track(loaded)


def assert_same(a: ScanResult, b: ScanResult) -> None:
    """All but the time that was taken."""
    a, b = (replace(r, imu=replace(r.imu, saved_s=None)) for r in (a, b))
    for field in fields(ScanResult):
        if field.name != "stages":
            one, other = (
                astuple(v) if is_dataclass(v) else v for v in (getattr(a, field.name), getattr(b, field.name))
            )
            np.testing.assert_equal(other, one, err_msg=f"scan {a.index} {field.name}")


def drive() -> Sequence:
    """Fourteen scans: three while the sensor stands, and one that belongs elsewhere."""
    moving, astray = sample(14), sample(1, start=60).scans[0]
    assert isinstance(astray, Scan)
    scans = [
        replace(s, index=i, stamp_ns=i * 100_000_000) for i, s in enumerate([moving.scans[0]] * 3 + moving.scans[:11])
    ]
    return with_rings(with_points(replace(moving, scans=scans), 9, astray.points), "elevation:16")


@pytest.mark.quick
@pytest.mark.parametrize(("method", "settings"), VARIANTS)
def test_every_method_resumes_to_the_last_bit(method: str, settings: tuple[str, ...], tmp_path: Path) -> None:
    config, sequence = config_of(method, *settings), drive()
    whole = tracker_of(config)
    assert isinstance(whole.odometry, Resumable)
    expected = []
    for result in tracked(whole, sequence, 0, 14):
        expected.append(result)
        if len(expected) in (1, 5, 9, 12):
            write_state(tmp_path / f"{len(expected)}.npz", whole.state())
    for i in (1, 5, 9, 12):
        again = tracker_of(config)
        again.restore(read_state(tmp_path / f"{i}.npz", STATE_CLASSES))
        for one, other in zip(expected[i:], tracked(again, sequence, i, 14), strict=True):
            assert_same(one, other)


@pytest.mark.parametrize("method", OURS)
def test_every_method_of_ours_can_leave_off(method: str) -> None:
    assert isinstance(create_odometry(config_of(method)), Resumable)


def test_the_imu_resumes_to_the_last_bit(tmp_path: Path) -> None:
    lidar = replace(LIDARS["vlp16"], columns=900)
    walk = simulate("walk", lidar=lidar, count=20, imu="icm20948", motion_compensated=False)
    sequence = Stub([walk.scan(i) for i in range(20)], None, walk.calibration, motion_compensated=False, imu=walk.imu)
    config = config_of("icp", "imu.use=true", "imu.start_s=1")
    part = begin_inertial(sequence, config)
    whole = tracker_of(config, part)
    expected = []
    for result in tracked(whole, sequence, 0, 20):
        expected.append(result)
        if len(expected) == 10:
            write_state(tmp_path / "10.npz", whole.state())
    again = tracker_of(config, begin_inertial(sequence, config))
    again.restore(read_state(tmp_path / "10.npz", STATE_CLASSES))
    for one, other in zip(expected[10:], tracked(again, sequence, 10, 20), strict=True):
        assert_same(one, other)


def test_every_part_of_the_state_affects_the_resumed_result(tmp_path: Path) -> None:
    """The comparison above is worth something: a velocity that is lost changes bits."""
    config, sequence = config_of("icp"), sample(8)
    whole = tracker_of(config)
    expected = list(tracked(whole, sequence, 0, 5))
    write_state(tmp_path / "5.npz", whole.state())
    expected += tracked(whole, sequence, 5, 8)
    again = tracker_of(config)
    again.restore(read_state(tmp_path / "5.npz", STATE_CLASSES) | {"motion": ConstantVelocity().state()})
    other = next(tracked(again, sequence, 5, 8))
    with pytest.raises(AssertionError, match="scan 5"):
        assert_same(expected[5], other)


def test_results_come_back_to_the_last_bit(tmp_path: Path) -> None:
    """Every field, also ones that are added later, with and without a value."""
    full = list(tracked(tracker_of(config_of("icp")), sample(4), 0, 4))
    bare = ScanResult(7, 123, np.eye(4), "skipped", "gone", stages={"read": 0.1})
    odd = replace(
        full[2],
        degenerate=np.eye(6)[:2],
        reason="ä\n",
        imu=ImuDiagnostics(steady_norm=0.1 + 0.2),
        prior_error=(1e-300, np.inf),
    )
    for name, rows in (("some", [*full, bare, odd]), ("none", [bare, bare]), ("empty", [])):
        write_state(tmp_path / f"{name}.npz", Records(rows))
        again = read_state(tmp_path / f"{name}.npz", STATE_CLASSES)
        assert len(again) == len(rows)
        for one, other in zip(rows, again, strict=True):
            assert_same(one, other)
            assert list(other.stages.items()) == list(one.stages.items())
            for field in fields(ScanResult):
                assert type(getattr(one, field.name)) is type(getattr(other, field.name)), field.name


@dataclass
class Foreign:
    """A record of another program."""

    count: int


def test_only_known_records_are_made_of_a_file(tmp_path: Path) -> None:
    write_state(tmp_path / "a.npz", {"record": Foreign(1)})
    with pytest.raises(InputError, match=r"a\.npz is damaged: KeyError 'Foreign'"):
        read_state(tmp_path / "a.npz", STATE_CLASSES)
    with pytest.raises(TypeError, match="object"):
        write_state(tmp_path / "b.npz", object())
    assert not (tmp_path / "b.npz").exists()


@pytest.mark.parametrize("how", ["cut", "flip", "empty", "text"])
def test_damage_is_found(tmp_path: Path, how: str) -> None:
    path = tmp_path / "state.npz"
    write_state(path, {"a": np.arange(1000), "b": [1, (2.5, None), "x"]})
    data = path.read_bytes()
    middle = len(data) // 2
    flipped = data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]
    path.write_bytes({"cut": data[:middle], "flip": flipped, "empty": b"", "text": b"hello"}[how])
    with pytest.raises(InputError, match="damaged"):
        read_state(path, STATE_CLASSES)


@pytest.mark.parametrize(("name", "value"), [("moments", -1), ("pool", -5), ("free", 10**6), ("capacity", 3)])
def test_a_map_that_does_not_add_up_is_refused(name: str, value: int) -> None:
    """Kernels do not check bounds: what a file says must not lead them astray."""
    voxels = GaussianMap(1.0, reach=5.0, capacity=64)
    for k in range(6):
        pose = np.eye(4)
        pose[0, 3] = 4.0 * k
        voxels.insert(np.random.default_rng(k).uniform(-4, 4, (200, 3)).astype(np.float32), pose)
    state = dict(voxels.state())
    assert len(state["free"]) > 0
    state[name] = value if name == "capacity" else state[name][:-1] if name == "moments" else state[name] + value
    with pytest.raises((InputError, ValueError)):
        GaussianMap(1.0, reach=5.0).restore(state)

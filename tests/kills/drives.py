"""What the harness runs: the sample's drive with each thing a run may do."""

from __future__ import annotations

from pathlib import Path

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
_MAP = str(SAMPLE / "sequences" / "00" / "map_perturbed.osm")
_LONG_MAP = ("--clean", "--occupancy")
_ALL = ("--imu", "--gnss", "--osm", _MAP, "--set", "osm.mode=non-rigid", *_LONG_MAP)

# name -> words behind `lslam run sample_data`
DRIVES: dict[str, tuple[str, ...]] = {
    "plain": ("--no-loops",),
    "loops": ("--set", "loops.min_travel=20", *_LONG_MAP),
    "IMU": ("--imu",),
    "GNSS": ("--gnss", *_LONG_MAP),
    "OSM": ("--osm", _MAP, "--georeference", "--set", "osm.mode=two-level"),
    "features": ("--method", "loam", "--save-feature-map"),
    "all": _ALL,
    # For the tests: half the scans, half as many keyframes, and an eighth of the map's voxels.
    "sparse": (*_ALL, *("--set", "input.skip_frames=2", "--set", "keyframes.distance=4", "--set", "map.voxel=0.4")),
}


def words_of(drive: str, out: str) -> list[str]:
    """The words of a run that goes on where an earlier one left off; checkpoints come often, for it is short."""
    asked = [*DRIVES[drive], "--set", "odometry.checkpoint_s=0.2", "--threads", "2"]
    return ["run", str(SAMPLE), "--out", out, "--resume", *asked]

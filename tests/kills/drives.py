"""What the harness runs: the sample's drive with each thing a run may do."""

from __future__ import annotations

from pathlib import Path

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
_MAP = str(SAMPLE / "sequences" / "00" / "map_perturbed.osm")
_LONG_MAP = ("--clean", "--occupancy")

# name -> words behind `lslam run sample_data`
DRIVES: dict[str, tuple[str, ...]] = {
    "plain": ("--no-loops",),
    "loops": ("--set", "loops.min_travel=20", *_LONG_MAP),
    "IMU": ("--imu",),
    "GNSS": ("--gnss", *_LONG_MAP),
    "OSM": ("--osm", _MAP, "--georeference", "--set", "osm.mode=two-level"),
    "features": ("--method", "loam", "--save-feature-map"),
    "all": ("--imu", "--gnss", "--osm", _MAP, "--set", "osm.mode=non-rigid", *_LONG_MAP),
}


def words_of(drive: str, out: str) -> list[str]:
    """The words of a run that goes on where an earlier one left off; checkpoints come often, for it is short."""
    asked = [*DRIVES[drive], "--set", "odometry.checkpoint_s=0.2", "--threads", "2"]
    return ["run", str(SAMPLE), "--out", out, "--resume", *asked]

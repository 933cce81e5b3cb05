"""A simulated drive and its run have the same bytes, whatever kernels BLAS, NumPy and numba choose for the processor."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64"), reason="the settings are those of x86-64"
)

# Of NumPy since 2.4, and before; it takes no notice of the names that it does not know.
NO_VECTORS = "X86_V3 X86_V4 AVX512_ICL AVX512_SPR AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX2 FMA3"
# Each of what BLAS, NumPy and numba can be told once, together: where one of them changes a byte, the test of its row fails.
# Kernels are compiled for the least and, in the other rows, for all that this processor has: what is between costs half a minute.
SETTINGS = {
    "Haswell on four cores, numba generic": {
        "OPENBLAS_CORETYPE": "Haswell",
        "OPENBLAS_NUM_THREADS": "4",
        "NUMBA_CPU_NAME": "generic",
    },
    "SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "Zen, numpy without vector units": {"OPENBLAS_CORETYPE": "Zen", "NPY_DISABLE_CPU_FEATURES": NO_VECTORS},
    "Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
}
OUTPUTS = (
    "trajectory.tum",
    "trajectory_kitti.txt",
    "covariances.npz",
    "evaluation.json",
    "map.ply",
    "scans.csv",
)
# Commands of one process, of which the first pins what BLAS does.
ONE_AFTER_THE_OTHER = """
import json, sys
from lslam.cli.main import main
for words in json.loads(sys.argv[1]):
    sys.argv = ["lslam", *words]
    try:
        main()
    except SystemExit as ended:
        if ended.code:
            raise
"""
IN_PROCESS = """
import sys, hashlib
import numpy as np
from lslam.simulation.scenarios import simulate
for scenario in ("quadrotor", "walk"):
    drive = simulate(scenario, count=3, imu="icm20948", motion_compensated=False)
    digest = hashlib.sha256()
    for k in range(3):
        digest.update(drive.scan(k).points.tobytes())
    digest.update(drive.imu.accel.tobytes() + drive.imu.gyro.tobytes() + drive.ground_truth.poses.tobytes())
    print(scenario, digest.hexdigest())
"""


def simulated_and_run(
    setting: dict[str, str], folder: Path, recorded: Path | None = None
) -> tuple[dict[str, str], dict[str, str]]:
    """Digests of the files of a drive, and of a run on it or on the one that is given."""
    drive, run = folder / "drive", folder / "run"
    calls = [
        ("simulate", "block", "--lidar", "vlp16", "--distorted", "--count", "5", "--out", drive, "-q"),
        ("run", recorded or drive, "--method", "icp", "--imu", "--no-loops", "--out", run, "--set", "report.html=false", "-q"),
    ]  # fmt: skip
    env = {**{k: v for k, v in os.environ.items() if k not in ("OPENBLAS_CORETYPE", "NUMBA_CPU_NAME")}, **setting}
    command = [sys.executable, "-c", ONE_AFTER_THE_OTHER, json.dumps(calls, default=str)]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # The manifest holds the command and the place.
    names = [p.relative_to(drive) for p in sorted(drive.rglob("*")) if p.is_file() and p.name != "manifest.json"]
    assert len(names) > 15
    return digests(drive, names), digests(run, [Path(name) for name in OUTPUTS])


def digests(folder: Path, names: list[Path]) -> dict[str, str]:
    return {str(name): hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("usual")


@pytest.fixture(scope="module")
def usual(folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    return simulated_and_run({}, folder)


@pytest.mark.parametrize("name", SETTINGS)
def test_drive_and_run(name: str, folder: Path, usual: tuple[dict[str, str], dict[str, str]], tmp_path: Path) -> None:
    assert simulated_and_run(SETTINGS[name], tmp_path, folder / "drive") == usual


def test_drives_of_a_process_that_chose_its_own_kernels() -> None:
    """In Python nothing is pinned: the simulator itself calls no BLAS."""
    seen = set()
    for setting in ({}, *SETTINGS.values()):
        env = {**os.environ, **setting}
        command = [sys.executable, "-c", IN_PROCESS]
        seen.add(subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout)
    assert len(seen) == 1
    assert len(seen.pop().split()) == 4


def test_digests_tell_a_last_bit(folder: Path, usual: tuple[dict[str, str], dict[str, str]], tmp_path: Path) -> None:
    """The sentinel: one bit of one coordinate."""
    name = Path("sequences/00/velodyne/000003.bin")
    points = np.fromfile(folder / "drive" / name, np.float32)
    points[7] = np.nextafter(points[7], np.float32(np.inf))
    (tmp_path / name).parent.mkdir(parents=True)
    points.tofile(tmp_path / name)
    assert digests(tmp_path, [name])[str(name)] != usual[0][str(name)]

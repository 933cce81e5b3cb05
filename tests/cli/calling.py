"""lslam as a user calls it, and broken copies of the sample."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
COMMAND = (sys.executable, "-m", "lslam")
Done = subprocess.CompletedProcess[str]


def environment(**more: str) -> dict[str, str]:
    """This process's environment without lslam's own variables and colours."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("LSLAM_") and k not in ("NO_COLOR", "FORCE_COLOR")}
    return clean | more


def lslam(*words: object, env: dict[str, str] | None = None, cwd: Path | None = None) -> Done:
    return subprocess.run(
        [*COMMAND, *map(str, words)], capture_output=True, text=True, timeout=180, check=False, cwd=cwd,
        env=environment() if env is None else env,
    )  # fmt: skip


def manifest(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / "manifest.json").read_text(), parse_constant=_refuse)
    return document


def strict_json(text: str) -> Any:
    """One JSON document and nothing else; NaN and Infinity are not JSON."""
    return json.loads(text, parse_constant=_refuse)


def _refuse(name: str) -> None:
    raise AssertionError(f"{name} is not JSON")


def sample_copy(folder: Path, count: int) -> Path:
    """The sample's first scans as KITTI sequence 00 below `folder`; returns sequences/00."""
    source, target = SAMPLE / "sequences" / "00", folder / "sequences" / "00"
    (target / "velodyne").mkdir(parents=True)
    for i in range(count):
        shutil.copy(source / "velodyne" / f"{i:06d}.bin", target / "velodyne")
    for name in ("calib.txt", "imu.csv", "gnss.csv"):
        shutil.copy(source / name, target)
    for file, out in ((source / "times.txt", target / "times.txt"), (SAMPLE / "poses/00.txt", folder / "poses/00.txt")):
        out.parent.mkdir(exist_ok=True)
        out.write_text("".join(file.read_text().splitlines(keepends=True)[:count]))
    text = (source / "sequence.toml").read_text()
    (target / "sequence.toml").write_text(text.replace('per_point = "per_point"\n', ""))
    return target


def assert_one_sentence(stderr: str) -> None:
    """Only log lines and one error line; never a traceback."""
    assert "Traceback" not in stderr
    errors = [line for line in stderr.splitlines() if not line.startswith(("INFO: ", "WARNING: "))]
    assert len(errors) == 1, stderr
    assert errors[0].startswith("error: ")

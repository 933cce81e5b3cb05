"""lslam as a user calls it, and broken copies of the sample."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from lslam.cli.main import main
from lslam.core.stopping import SIGNALS

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
COMMAND = (sys.executable, "-m", "lslam")
Done = subprocess.CompletedProcess[str]


def environment(**more: str) -> dict[str, str]:
    """This process's environment without lslam's own variables and colours."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("LSLAM_") and k not in ("NO_COLOR", "FORCE_COLOR")}
    return clean | more


def lslam(*words: object, cwd: Path | None = None) -> Done:
    """The command from its words to its exit code, in this process: starting Python takes longer than most of them."""
    argv = ["lslam", *map(str, words)]
    # Bytes, as a pipe has them: what an encoding cannot hold shows.
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    with (
        _nothing_left_behind(), mock.patch.object(sys, "argv", argv),
        contextlib.chdir(cwd or Path.cwd()), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err),
    ):  # fmt: skip
        try:
            main()
        except SystemExit as ended:
            code = ended.code
    assert isinstance(code, int)
    return Done(argv, code, *(stream.buffer.getvalue().decode() for stream in (out, err)))  # type: ignore[attr-defined]


def lslam_process(*words: object, env: dict[str, str] | None = None, cwd: Path | None = None) -> Done:
    """Likewise, in a process of its own: where its memory, its variables or what libraries print are looked at."""
    return subprocess.run(
        [*COMMAND, *map(str, words)], capture_output=True, text=True, timeout=180, check=False, cwd=cwd,
        env=environment() if env is None else env,
    )  # fmt: skip


@contextlib.contextmanager
def _nothing_left_behind() -> Iterator[None]:
    """The variables of `environment`; what `main` sets for its process is put back: the log and the answer to signals."""
    hidden = {name: os.environ.pop(name) for name in os.environ.keys() - environment()}
    log, heard = logging.getLogger("lslam"), {number: signal.getsignal(number) for number in SIGNALS}
    before, raises = (list(log.handlers), log.level, log.propagate), logging.raiseExceptions
    try:
        yield
    finally:
        (log.handlers[:], log.level, log.propagate), logging.raiseExceptions = before, raises
        for number, handler in heard.items():
            signal.signal(number, handler)
        os.environ.update(hidden)


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

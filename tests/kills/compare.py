"""Two run folders, byte by byte, but for what is a time.

Not compared: log.txt, timing.csv and keyframes/odometry.npz, which have the seconds of each scan. Of manifest.json, and where
the report shows it: `timings`, `started`, `written`, `peak_memory_mb`, `resumed_after_scans` and `imu.saved_ms_per_scan`. Of
report.html: its section "Time", the two headline numbers of it, and the milliseconds in the sentence about the IMU.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

TIMED_FILES = ("log.txt", "timing.csv", "keyframes/odometry.npz")
TIMED_KEYS = ("timings", "started", "written", "peak_memory_mb", "resumed_after_scans")
_ROWS = "|".join(re.escape(key) for key in (*TIMED_KEYS, "imu.saved_ms_per_scan"))
_TIMES_OF_REPORT = (
    re.compile(r"<section>\s*<details[^>]*>\s*<summary><h2>Time</h2>.*?</section>", re.S),
    re.compile(r"<b>[^<]*</b>(?= ?(ms<span>median time per scan|×<span>real time))"),
    re.compile(rf'<tr><th scope="row">({_ROWS})[^<]*</th>.*?</tr>\s*', re.S),
    re.compile(r"[0-9.]+ ms per scan (saved|lost)"),
)


def differences(folder: Path, whole: Path) -> list[str]:
    """What of `folder` is not as in `whole`, a sentence per file."""
    ours, theirs = (_contents(f) for f in (folder, whole))
    said = [f"{name} is missing" for name in sorted(theirs.keys() - ours.keys())]
    said += [f"{name} should not be there" for name in sorted(ours.keys() - theirs.keys())]
    return said + [f"{name} differs" for name in sorted(ours.keys() & theirs.keys()) if ours[name] != theirs[name]]


def _contents(folder: Path) -> dict[str, bytes]:
    files = (file for file in folder.rglob("*") if not file.is_dir())
    return {name: _untimed(name, file) for file in files if (name := file.relative_to(folder).as_posix())}


def _untimed(name: str, path: Path) -> bytes:
    if name in TIMED_FILES:
        return b""
    if name == "manifest.json":
        tree = {key: value for key, value in json.loads(path.read_bytes()).items() if key not in TIMED_KEYS}
        tree.get("imu", {}).pop("saved_ms_per_scan", None)
        return json.dumps(tree).encode()
    if name == "report.html":
        page = path.read_text(encoding="utf-8")
        for pattern in _TIMES_OF_REPORT:
            page = pattern.sub("", page)
        return page.encode()
    return path.read_bytes()

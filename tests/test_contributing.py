"""CONTRIBUTING.md: what it names is there, and no everyday change is said to touch more than three files."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_ten_changes_touch_three_files_at_most() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text()
    rows = re.findall(r"^\| (an? .+?) \| (.+) \| (\d) \|$", text, re.MULTILINE)
    assert len(rows) == 10
    assert max(int(count) for _, _, count in rows) <= 3
    named = set(re.findall(r"`((?:lslam|tests)/[^`]*)`", text))
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []
    for _, files, _ in rows:
        for path, table in re.findall(r"`(lslam/[\w/]+\.py)` \(`([A-Z_]+)`", files):
            assert re.search(rf"^{table}\b", (ROOT / path).read_text(), re.MULTILINE), f"{path} has no {table}"

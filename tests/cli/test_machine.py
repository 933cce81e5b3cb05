"""`lslam info --machine`: what this machine has, where parts are broken too."""

from __future__ import annotations

import json
import shutil
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest
from calling import SAMPLE, lslam, lslam_process

from lslam.cli import machine
from lslam.core.geometry import geodesy

ROOT = SAMPLE.parent


def document() -> dict[str, Any]:
    done = lslam("info", "--machine", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert isinstance(found, dict)
    return found


def test_it_tells_every_part_in_a_second() -> None:
    began = time.monotonic()
    found = document()
    assert time.monotonic() - began < 3
    assert not [name for name, part in found.items() if isinstance(part, dict) and "problem" in part]
    assert 1 <= found["cores"]["usable"] <= found["cores"]["machine"]
    assert 0 < found["memory"]["free_bytes"] < found["memory"]["total_bytes"]
    assert found["disk"] == {
        "folder": str(Path.cwd()),
        "free_bytes": pytest.approx(shutil.disk_usage(".").free, rel=0.1),
    }
    assert found["libraries"]["gtsam"]
    assert not found["proj"]["network"]
    done = lslam("info", "--machine")
    assert [line.split()[0] for line in done.stdout.splitlines() if not line.startswith(" ")] == list(found)
    for name in found["extras"]:
        assert f"{name} " in done.stdout
    shown = (ROOT / "docs/tasks/installing.md").read_text().partition("```text\nlslam ")[2].partition("```")[0]
    assert [line.split()[0] for line in f"lslam {shown}".splitlines() if not line.startswith(" ")] == list(found)


def test_one_of_a_sequence_and_the_machine() -> None:
    for words in ((), (SAMPLE, "--machine")):
        done = lslam("info", *words)
        assert done.returncode == 2
        assert "give one of them" in done.stderr


def test_extras_are_those_of_the_package_and_missing_ones_have_their_command(monkeypatch: pytest.MonkeyPatch) -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(machine.EXTRAS) == set(declared) - {"all", "test", "peers", "docs", "browser"}
    page = (ROOT / "docs/tasks/installing.md").read_text()
    assert all(f"| `{name}` |" in page for name in machine.EXTRAS)
    monkeypatch.setattr(machine, "find_spec", lambda module: None if module == "gpxpy" else object())
    found = document()["extras"]
    assert [name for name, one in found.items() if not one["installed"]] == ["geo"]
    assert "[geo]" in found["geo"]["install"]
    assert f"geo        missing    {found['geo']['for']}: pip install" in lslam("info", "--machine").stdout


def test_a_kernel_cache_is_cold_until_there_is_a_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    cold = document()["kernels"]
    assert Path(cold["folder"]).parent == tmp_path
    assert (cold["kernels"], cold["is_warm"], cold["bytes"]) == (0, False, 0)
    assert "none yet" in lslam("info", "--machine").stdout
    kept = Path(cold["folder"]) / "lslam_1"
    kept.mkdir()
    (kept / "a.nbi").write_bytes(b"1234")
    (kept / "a.1.nbc").write_bytes(b"123456")
    warm = document()["kernels"]
    assert (warm["kernels"], warm["is_warm"], warm["bytes"]) == (1, True, 10)


def test_grids_of_heights_are_told_from_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("de_bkg_gcg2016.tif", "egm96_15.gtx", "de_adv_BETA2007.tif", "mine.tif", "notes.txt"):
        (tmp_path / name).touch()
    monkeypatch.setattr("pyproj.datadir.get_user_data_dir", lambda: str(tmp_path))
    found = geodesy.installed_grids()
    assert found["vertical"] == ["de_bkg_gcg2016.tif", "egm96_15.gtx"]
    assert found["others"] == ["de_adv_BETA2007.tif", "mine.tif"]
    assert str(tmp_path) in found["folders"]


def test_limits_of_a_container_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each group limits those within it: the least counts."""
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    (inner / "cpu.max").write_text("max 100000\n")
    (tmp_path / "a" / "cpu.max").write_text("150000 100000\n")
    (inner / "memory.max").write_text("4000000000\n")
    (tmp_path / "a" / "memory.max").write_text("8000000000\n")
    known = tmp_path / "cgroup"
    known.write_text("0::/a/b\n")
    monkeypatch.setattr(machine, "CGROUP", known)
    monkeypatch.setattr(machine, "CGROUPS", tmp_path)
    found = document()
    assert found["cores"]["container"] == 1.5
    assert found["memory"]["container_bytes"] == 4e9
    text = lslam("info", "--machine").stdout
    assert ", 1.5 in this container" in text
    assert ", 4.0 GB in this container" in text


@pytest.mark.parametrize(
    ("broken", "part"),
    [
        ("lslam.core.geometry.geodesy.installed_grids", "proj"),
        ("lslam.core.kernels.cache.kernel_folder", "kernels"),
        ("webbrowser.get", "browser"),
        ("lslam.core.machine.available_cores", "cores"),
        ("shutil.disk_usage", "disk"),
        ("importlib.metadata.version", "libraries"),
        ("os.sysconf", "memory"),
        ("lslam.cli.machine.find_spec", "extras"),
    ],
)
def test_a_broken_part_is_said_and_breaks_no_other(broken: str, part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("it is broken")

    monkeypatch.setattr(broken, fail)
    found = document()
    wrong = {name: one for name, one in found.items() if isinstance(one, dict) and "problem" in one}
    assert list(wrong) == [part]
    assert wrong[part]["problem"] == "cannot be told (OSError: it is broken)"
    assert f"{part:<10} cannot be told (OSError: it is broken)" in lslam("info", "--machine").stdout


def test_nothing_heavy_is_loaded_for_it() -> None:
    script = "import sys; from lslam.cli.machine import machine_document as d; d(); print(*sorted(sys.modules))"
    import subprocess
    import sys

    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not {"numba", "scipy", "gtsam", "open3d", "matplotlib", "pyarrow"} & set(done.stdout.split())
    assert lslam_process("info", "--machine").returncode == 0

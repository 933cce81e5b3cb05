"""`lslam simulate --osm` as a user calls it, and what every kind of bad input is answered with: one sentence, one code."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from calling import Done, assert_one_sentence, environment, lslam, strict_json

VILLAGE = Path(__file__).resolve().parents[1] / "simulation" / "osm_village.py"
AT = "49.0112,8.4229"


def load_village() -> ModuleType:
    spec = importlib.util.spec_from_file_location("osm_village", VILLAGE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an extract, others that are broken, and way-points."""
    folder, village = tmp_path_factory.mktemp("place"), load_village()
    whole = village.write_village(folder / "village.osm")
    village.write_village(folder / "bare.osm", streets=False)
    (folder / "cut.osm").write_bytes(whole.read_bytes()[:3000])
    (folder / "empty.osm").write_text('<osm version="0.6"></osm>')
    (folder / "far.csv").write_text("-100,-900\n50,-900\n")
    (folder / "through.csv").write_text("-50,0\n-50,-40\n")
    (folder / "sharp.csv").write_text("-100,0\n0,0\n-100,2\n")
    (folder / "mine.toml").write_text('base = "urban"\nsummary = "Mine."\n[layout]\nparkd = 0.1\n')
    (folder / "wrong.toml").write_text("speed = \n")
    (folder / "own.toml").write_text('base = "walk"\nsummary = "Mine."\nlidar = "vlp16"\n[layout]\nparked = 0.9\n')
    return folder


def test_a_city_of_a_map_is_recorded_and_drawn_in_one_go(here: Path, tmp_path: Path) -> None:
    out, plan = tmp_path / "out", tmp_path / "plan.png"
    done = lslam(
        "simulate", "--osm", "village.osm", "--origin", AT + ",120", "--out", out, "--plan", plan, "--scans", 3,
        "--lidar", "vlp16", cwd=here,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == [str(plan), str(out / "sequences" / "00")]
    assert plan.read_bytes()[:4] == b"\x89PNG"
    said = strict_json((out / "sequences" / "00" / "manifest.json").read_text())
    assert said["place"]["origin_lat_lon_alt"] == [49.0112, 8.4229, 120.0]
    assert said["command"].split()[1:4] == ["simulate", "--osm", "village.osm"]
    assert "OpenStreetMap contributors" in said["attribution"]
    lat, lon = map(float, (out / "sequences" / "00" / "gnss.csv").read_text().splitlines()[1].split(",")[1:3])
    assert abs(lat - 49.0112) < 0.003
    assert abs(lon - 8.4229) < 0.003
    facts = strict_json(lslam("info", out, "--json").stdout)
    assert facts["problems"] == []


def test_a_map_without_streets_is_drawn_to_pick_a_path_from(here: Path, tmp_path: Path) -> None:
    asked = lslam("simulate", "--osm", "bare.osm", "--out", tmp_path / "out", cwd=here)
    assert asked.returncode == 2
    assert_one_sentence(asked.stderr)
    assert "give --path FILE" in asked.stderr
    assert "--osm bare.osm --plan map.png" in asked.stderr
    drawn = lslam("simulate", "--osm", "bare.osm", "--plan", tmp_path / "map.png", cwd=here)
    assert drawn.returncode == 0, drawn.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["map.png"]


def test_a_scenario_of_ones_own(here: Path, tmp_path: Path) -> None:
    shown = lslam("simulate", "own.toml", "--show", "--set", "speed=1", cwd=here)
    assert shown.returncode == 0, shown.stderr
    again = tmp_path / "again.toml"
    again.write_text(shown.stdout)
    twice = lslam("simulate", again, "--show")
    assert twice.stdout == shown.stdout
    for line in ('carrier = "walker"', 'lidar = "vlp16"', "parked = 0.9", "speed = 1"):
        assert line in shown.stdout


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (
            "--osm village.osm --path far.csv --origin " + AT,
            3,
            "no building within 150 m of the path, the nearest is 8",
        ),
        (
            "--osm village.osm --path through.csv --origin " + AT,
            2,
            "crosses a building, 9 m along at x = -50.",
        ),
        ("--osm village.osm --path sharp.csv --origin " + AT, 2, "the path bends with a radius of"),
        ("--osm village.osm --path absent.csv", 3, "absent.csv does not exist"),
        ("--osm absent.osm", 3, "absent.osm cannot be read: No such file"),
        ("--osm cut.osm", 3, "cut.osm is broken XML or cut short"),
        ("--osm empty.osm", 3, "empty.osm holds no building outline"),
        ("--osm village.osm --origin 95,8", 2, "--origin 95,8 is out of range"),
        ("--osm village.osm --origin north", 2, "--origin north: expected LAT,LON"),
        ("--osm village.osm --origin 49.5,8.4", 3, "km away from the origin (49.50000,8.40000): check --origin"),
        ("--osm village.osm --speed 400", 2, "--speed 400 is out of range"),
        ("mine.toml", 2, "mine.toml: unknown key 'layout.parkd'; did you mean 'parked'?"),
        ("wrong.toml", 3, "wrong.toml is not valid TOML"),
        ("absent.toml", 3, "absent.toml cannot be read"),
    ],
)
def test_bad_input_is_one_sentence_and_its_code(
    here: Path, words: str, code: int, sentence: str, tmp_path: Path
) -> None:
    done = lslam("simulate", *words.split(), "--out", tmp_path / "out", cwd=here)
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert sentence in done.stderr
    assert_one_sentence(done.stderr.split("; see ")[0])
    assert not (tmp_path / "out").exists()


def simulate_after(preparation: str, out: Path) -> Done:
    """`lslam simulate` of three scans of 64 rings, with a line of Python before it."""
    code = f"import shutil, resource, signal, sys\n{preparation}\nfrom lslam.cli.main import main\nmain()"
    words = ["simulate", "block", "--lidar", "hdl64", "--scans", "3", "--out", str(out)]
    return subprocess.run(
        [sys.executable, "-c", code, *words],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env=environment(),
    )


def test_a_full_disk_is_said_before_and_while_writing(tmp_path: Path) -> None:
    small = "import types; shutil.disk_usage = lambda _: types.SimpleNamespace(free=5_000_000)"
    before = simulate_after(small, tmp_path / "a")
    assert before.returncode == 3
    assert_one_sentence(before.stderr)
    assert "needs up to 7." in before.stderr
    assert "the disk has 5.0 MB left" in before.stderr
    # No file may grow beyond 300 kB: the system refuses to write on, as on a disk that fills up meanwhile.
    full = "resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))"
    during = simulate_after(full, tmp_path / "b")
    assert during.returncode == 3, during.stderr
    assert_one_sentence(during.stderr)
    assert "000000.bin cannot be written" in during.stderr
    assert list(tmp_path.iterdir()) == []

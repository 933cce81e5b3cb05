"""`lslam osm` as a user calls it: files, numbers, one sentence and a code for everything that goes wrong."""

from __future__ import annotations

import importlib.util
import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import click
import pytest
from calling import SAMPLE, assert_one_sentence, environment, lslam, lslam_process, strict_json
from click.testing import CliRunner

from lslam.cli.main import cli
from lslam.core.errors import LslamError

FAKE = Path(__file__).resolve().parents[1] / "osm" / "overpass_server.py"
VILLAGE = Path(__file__).resolve().parents[1] / "simulation" / "osm_village.py"
Call = Callable[..., tuple[int, str]]
PLACE = "49.0112,8.4229"


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def server() -> Iterator[Any]:
    with load(FAKE).running() as fake:
        yield fake


@pytest.fixture
def osm(server: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Call]:
    """`lslam osm` in this process, with a cache of its own: (exit code, stdout or sentence)."""
    log = logging.getLogger("lslam")
    before = (list(log.handlers), log.level, log.propagate)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("LSLAM_OSM_SERVER", server.url)

    def call(*words: object) -> tuple[int, str]:
        done = CliRunner().invoke(cli, ["osm", *map(str, words)], standalone_mode=False)
        if isinstance(done.exception, LslamError):
            return done.exception.exit_code, str(done.exception)
        if isinstance(done.exception, click.ClickException):
            return done.exception.exit_code, done.exception.format_message()
        assert done.exception is None, done.exception
        return 0, done.stdout

    yield call
    log.handlers[:], log.level, log.propagate = before


def test_what_is_fetched_is_there_again_without_network(server: Any, osm: Call, tmp_path: Path) -> None:
    said = "map.osm: 2 buildings. © OpenStreetMap contributors, ODbL 1.0, openstreetmap.org/copyright\n"
    assert osm("fetch", "--around", PLACE) == (0, said)
    (asked, _), *more = server.requests
    assert not more
    assert "(49.010122,8.421256,49.012278,8.424544)" in asked, "120 m each way"
    assert osm("fetch", "--around", PLACE, "--radius", 50, "--offline", "--out", "less.json")[0] == 0
    assert len(server.requests) == 1
    for name in ("map.osm", "less.json"):
        facts = strict_json(osm("show", name, "--json")[1])
        assert facts["buildings"] == 2
        assert facts["ground_covered_m2"] == pytest.approx(2 * 11.12 * 7.31, rel=0.01)
        assert facts["walls_m"] == pytest.approx(2 * 2 * (11.12 + 7.31), rel=0.01)
    code, sentence = osm("fetch", "--around", PLACE)
    assert (code, sentence) == (2, "map.osm exists; name another file with --out or replace it with --overwrite")


def test_a_sequence_a_line_and_a_trajectory_say_where_they_are(server: Any, osm: Call, tmp_path: Path) -> None:
    first = (SAMPLE / "sequences" / "00" / "gnss.csv").read_text().splitlines()[1].split(",")
    (tmp_path / "a.tum").write_text("0 0 0 0 0 0 0 1\n1 300 0 0 0 0 0 1\n")
    (tmp_path / "way.geojson").write_text('{"type": "LineString", "coordinates": [[8.42, 49.01], [8.43, 49.01]]}')
    (tmp_path / "fixes.csv").write_text("stamp_ns,lat_deg,lon_deg,alt_m\n0,49.01,8.42,110\n1000000000,49.01,8.43,110\n")
    for k, words in enumerate((["a.tum", "--origin", PLACE], ["way.geojson"], ["fixes.csv"], [str(SAMPLE)])):
        assert osm("fetch", "--along", *words, "--radius", 20, "--out", f"{k}.osm")[0] == 0
    boxes = [[float(v) for v in q.split('(way["building"](')[1].split(")")[0].split(",")] for q, _ in server.requests]
    south, west, north, east = boxes[0]
    assert south < 49.0112 < north
    assert east - west == pytest.approx(340 / 111320 / 0.6559, rel=0.01)
    assert len(boxes) == 3, "the line and the fixes are one place"
    assert boxes[1][1] < 8.42 < 8.43 < boxes[1][3]
    assert boxes[2][0] < float(first[1]) < boxes[2][2]


def test_extracts_are_shown_and_drawn(tmp_path: Path) -> None:
    load(VILLAGE).write_village(tmp_path / "village.osm")
    done = lslam("osm", "show", "village.osm", "--png", "plan.png", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    said = {line.split("  ")[0].strip(): line[11:] for line in done.stdout.splitlines()}
    assert said["buildings"] == "29 with 29 outlines, 29 with a height"
    assert said["extent"].startswith("207 x 154 m, ")
    assert "OpenStreetMap contributors, ODbL 1.0" in said["licence"]
    assert (tmp_path / "plan.png").read_bytes()[:4] == b"\x89PNG"
    assert lslam("osm", "show", "village.osm", "--png", "plan.png", cwd=tmp_path).returncode == 2


@pytest.mark.parametrize(
    ("words", "script", "code", "sentence"),
    [
        ("fetch --around " + PLACE, "html html html", 3, "answered with a web page, not with data"),
        ("fetch --around " + PLACE, "elsewhere", 3, "most of it lies elsewhere"),
        ("fetch --around " + PLACE + " --server http://127.0.0.1:9/api", "", 3, "127.0.0.1:9/api cannot be reached"),
        ("fetch --around " + PLACE + " --offline", "", 3, "no reply for 49.010122"),
        ("fetch --around 8.4229", "", 2, "--around 8.4229: expected LAT,LON"),
        ("fetch --around 149,8", "", 2, "--around 149,8 is no place on the Earth"),
        ("fetch --bbox 49,8,48,9", "", 2, "is no box SOUTH,WEST,NORTH,EAST"),
        ("fetch --bbox 49,8.42,49.01,8.40", "", 2, "almost round the Earth: the order is SOUTH,WEST,NORTH,EAST"),
        ("fetch --bbox 49,8.4,49.01,8.42 --origin " + PLACE, "", 2, "--origin goes with --along"),
        ("fetch --bbox 45,8,49,12", "", 2, "public servers are asked for at most"),
        ("fetch", "", 2, "one of --bbox, --around and --along"),
        ("fetch --around " + PLACE + " --out town.png", "", 2, "end the name with .osm or .json"),
        ("fetch --around " + PLACE + " --out nowhere/a.osm", "", 3, "there is no folder"),
        ("fetch --around " + PLACE + " --set osm.renew_radius=200", "", 2, "renew_radius = 200.0 must be less than"),
        ("fetch --along a.tum", "", 2, "a.tum is in metres: --origin LAT,LON says where"),
        ("fetch --along absent", "", 3, "absent"),
        ("show absent.osm", "", 3, "absent.osm cannot be read"),
        ("show a.tum", "", 3, "a.tum is neither XML nor JSON"),
    ],
)  # fmt: skip
def test_what_goes_wrong_is_one_sentence_and_its_code(
    server: Any, osm: Call, tmp_path: Path, words: str, script: str, code: int, sentence: str
) -> None:
    server.script = script.split()
    (tmp_path / "a.tum").write_text("0 0 0 0 0 0 0 1\n1 300 0 0 0 0 0 1\n")
    got, said = osm(*words.split())
    assert (got, "\n" in said) == (code, False)
    assert sentence in said
    assert sorted(p.name for p in tmp_path.iterdir() if p.name != "cache") == ["a.tum"]


def test_a_dead_server_ends_the_command_as_any_error_does(tmp_path: Path) -> None:
    env = environment(LSLAM_OSM_SERVER="http://127.0.0.1:9/api", XDG_CACHE_HOME=str(tmp_path / "cache"))
    done = lslam_process("osm", "fetch", "--bbox", "-0.3,160.1,-0.2,160.2", cwd=tmp_path, env=env)
    assert (done.returncode, done.stdout) == (3, "")
    assert_one_sentence(done.stderr)
    assert "127.0.0.1:9/api cannot be reached" in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["cache"]

"""Words and files beyond any number, name or stack: exit 2 or 3 with one sentence."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread

import pytest
from calling import COMMAND, Done, assert_one_sentence, environment, lslam, manifest, sample_copy

DIGITS = "9" * 5000
DEEP = "[" * 5000
FAR = "1e999999999"
LONG = "x" * 400


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sample_copy(tmp_path_factory.mktemp("strange"), 6)


@pytest.fixture
def spoilt(tmp_path: Path) -> Path:
    return sample_copy(tmp_path, 6)


@pytest.fixture(scope="module")
def finished(sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished") / "out"
    assert lslam("run", sequence, "--out", out, "--no-loops").returncode == 0
    return out


def assert_refused(done: Done, *codes: int) -> None:
    assert done.returncode in (codes or (2, 3)), done.stderr
    assert_one_sentence(done.stderr)
    assert "made a mistake" not in done.stderr
    assert max(map(len, done.stderr.splitlines())) < 2000
    assert done.stdout == ""


@pytest.mark.parametrize(
    "words",
    [
        *[(option, word) for option in ("--start", "--count", "--threads", "--origin") for word in (DIGITS, FAR, "²")],
        *[("--heading", word) for word in (DIGITS, FAR, "²")],
        *[("--set", f"{key}={word}") for key in ("map.voxel", "input.count", "osm.origin") for word in (DIGITS, DEEP, FAR)],
        *[("--extrinsics", word) for word in (LONG, "1," * 300, DEEP, "/" + LONG, "nan," * 6 + "1")],
        *[(option, LONG) for option in ("--config", "--gt", "--poses", "--method", "--preset", "--rings", "--crs")],
        ("--osm", LONG, "--origin", "49,8.4"), ("--out", LONG), ("--out", LONG + "/run"),
    ],
    ids=lambda words: " ".join(word[:20] for word in words),
)  # fmt: skip
def test_words_of_a_run(sequence: Path, tmp_path: Path, words: tuple[str, ...]) -> None:
    out = () if "--out" in words else ("--out", tmp_path / "out")
    assert_refused(lslam("run", sequence, *out, *words, cwd=tmp_path))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "words",
    [
        ("run", LONG), ("info", LONG), ("compare", LONG), ("convert", LONG, "--to", "kitti", "--out", "k"), ("map", LONG),
        ("eval", LONG, LONG), ("batch", LONG), ("sweep", LONG), ("config", "check", LONG), ("osm", "show", LONG),
        ("simulate", LONG, "--out", "o"), ("simulate", "block", "--out", LONG),
    ],
    ids=lambda words: words[0],
)  # fmt: skip
def test_names_of_400_characters(tmp_path: Path, words: tuple[str, ...]) -> None:
    assert_refused(lslam(*words, cwd=tmp_path))
    assert not list(tmp_path.iterdir())


def test_a_sequence_may_have_a_name_of_400_characters(spoilt: Path, tmp_path: Path) -> None:
    about = spoilt / "sequence.toml"
    about.write_text(re.sub("name = .*", f'name = "{LONG}"', about.read_text()))
    assert lslam("run", spoilt, "--no-loops", cwd=tmp_path).returncode == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert manifest(folder)["sequence"]["name"] == LONG
    # A worker is a process of its own, which says what goes wrong before its log is there.
    program = "from lslam.cli.main import main\nif __name__ == '__main__': main()\n"
    (tmp_path / "main.py").write_text(program)
    done = subprocess.run(
        [sys.executable, "main.py", "compare", str(spoilt), "--methods", "icp", "--out", "c"],
        capture_output=True, text=True, cwd=tmp_path, env=environment(), check=False,
    )  # fmt: skip
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr


@pytest.mark.parametrize("command", [("config", "check"), ("run", "--config"), ("sweep",), ("batch",), ("simulate",)])
@pytest.mark.parametrize("text", [f"a = {DIGITS}", f"[map]\nvoxel = {DEEP}", "a." * 3000 + "a = 1"])
def test_files_of_settings(sequence: Path, tmp_path: Path, command: tuple[str, ...], text: str) -> None:
    (tmp_path / "c.toml").write_text(text)
    words = (command[0], sequence, *command[1:]) if command[0] == "run" else command
    out = () if command[0] == "config" else ("--out", tmp_path / "out")
    assert_refused(lslam(*words, tmp_path / "c.toml", *out))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("rate", [DIGITS, "9223372036854775807", "1e308", "1e30", "1e-320", "inf", "0", DEEP])
@pytest.mark.parametrize("command", [("run",), ("info",), ("convert", "--to", "kitti")], ids=lambda words: words[0])
def test_a_rate_that_no_sensor_has(spoilt: Path, tmp_path: Path, rate: str, command: tuple[str, ...]) -> None:
    about = spoilt / "sequence.toml"
    about.write_text(re.sub("rate_hz = .*", f"rate_hz = {rate}", about.read_text()))
    (spoilt / "times.txt").unlink()
    out = () if command[0] == "info" else ("--out", tmp_path / "out")
    assert_refused(lslam(command[0], spoilt, *command[1:], *out), 3)


@pytest.mark.parametrize("stamp", [FAR, f"-{FAR}", DIGITS, "²", "nan"])
@pytest.mark.parametrize(("name", "words"), [("imu.csv", "--imu"), ("gnss.csv", "--gnss")])
def test_a_stamp_that_no_clock_shows(spoilt: Path, tmp_path: Path, stamp: str, name: str, words: str) -> None:
    lines = (spoilt / name).read_text().splitlines()
    lines[3] = ",".join([stamp, *lines[3].split(",")[1:]])
    (spoilt / name).write_text("\n".join(lines) + "\n")
    assert_refused(lslam("run", spoilt, "--out", tmp_path / "out", words), 3)


@pytest.mark.parametrize("stamp", [FAR, DIGITS, "²"])
def test_stamps_of_scans_that_no_clock_shows_are_not_used(spoilt: Path, tmp_path: Path, stamp: str) -> None:
    lines = (spoilt / "times.txt").read_text().splitlines()
    (spoilt / "times.txt").write_text("\n".join([*lines[:3], stamp, *lines[4:]]))
    done = lslam("run", spoilt, "--out", tmp_path / "out")
    assert (done.returncode, manifest(tmp_path / "out")["status"]) == (0, "degraded")
    (said,) = [line for line in done.stderr.splitlines() if line.startswith("WARNING: stamps are not used: ")]
    assert "times.txt, line 4: " in said
    assert len(said) < 1000


@pytest.mark.parametrize("stamp", [FAR, DIGITS, "²"])
def test_a_stamp_of_a_trajectory(sequence: Path, tmp_path: Path, stamp: str) -> None:
    (tmp_path / "t.tum").write_text(f"{stamp} 0 0 0 0 0 0 1\n" * 6)
    for words in (("eval", tmp_path / "t.tum", tmp_path / "t.tum"), ("run", sequence, "--gt", tmp_path / "t.tum")):
        assert_refused(lslam(*words, cwd=tmp_path), 3)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.json", DEEP), ("a.json", '{"elements":' * 3000), ("a.geojson", DEEP), ("a.osm", "<osm>" * 5000),
        ("a.json", f'{{"elements": [{{"type": "node", "id": {DIGITS}, "lat": 1, "lon": 1}}]}}'), ("none.osm", None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("more", [(), ("--dry-run",), ("--dry-run", "--json")])
def test_a_map_that_cannot_be_read_is_exit_3_before_anything_is_done(
    sequence: Path, tmp_path: Path, name: str, text: str | None, more: tuple[str, ...]
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    words = ("run", sequence, "--osm", tmp_path / name, "--origin", "49,8.4", "--out", tmp_path / "out", *more)
    assert_refused(lslam(*words), 3)
    assert not (tmp_path / "out").exists()


def test_a_dry_run_looks_at_all_that_a_run_needs(sequence: Path, tmp_path: Path) -> None:
    """And asks no server, and writes nothing."""
    for words, code in (
        (("--osm", "auto"), 2), (("--osm", tmp_path, "--origin", "49,8.4"), 3), (("--poses", "none.tum"), 3),
        (("--osm", "auto", "--origin", "49,8.4", "--set", "osm.server=http://127.0.0.1:9"), 0),
    ):  # fmt: skip
        assert lslam("run", sequence, "--dry-run", *words, cwd=tmp_path).returncode == code
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("spoil", "codes"),
    [
        (lambda data: data.replace(b"\n", b"\n\n", 3), (0,)),
        (lambda data: data.replace(b"ok", b"\xff\xfe", 1), (3,)),
        (lambda data: data.replace(b"ok", b"\0", 1), (3,)),
        (lambda data: data.replace(b"ok", DIGITS.encode(), 1), (3,)),
        (lambda data: b"\n\n", (3,)),
        (lambda data: b"", (3,)),
    ],
    ids=["empty line", "no UTF-8", "NUL", "digits", "nothing", "empty"],
)
def test_a_table_of_scans_that_was_spoilt(
    sequence: Path, finished: Path, spoil: Callable[[bytes], bytes], codes: tuple[int, ...]
) -> None:
    table, page = finished / "scans.csv", (finished / "report.html").read_bytes()
    good = table.read_bytes()
    table.write_bytes(spoil(good))
    try:
        built = lslam("map", finished, "--overwrite")
        resumed = lslam("run", sequence, "--out", finished, "--no-loops", "--resume")
    finally:
        table.write_bytes(good)
    assert built.returncode in codes, built.stderr
    if built.returncode:
        assert_refused(built)
        assert (finished / "report.html").read_bytes() == page
    assert (resumed.returncode, "nothing is left to do" in resumed.stderr) == (0, True)


@pytest.mark.parametrize("text", [DEEP, '{"a":' * 5000, f'{{"schema": {DIGITS}}}', "\udcff"])
def test_a_manifest_that_was_spoilt(sequence: Path, finished: Path, text: str) -> None:
    path = finished / "manifest.json"
    good = path.read_bytes()
    path.write_bytes(text.encode(errors="surrogateescape"))
    try:
        for words in (("map", finished, "--overwrite"), ("run", sequence, "--out", finished, "--no-loops", "--resume")):
            assert_refused(lslam(*words))
    finally:
        path.write_bytes(good)


class Busy(BaseHTTPRequestHandler):
    """Always too busy, and says until when in digits that are none."""

    def do_POST(self) -> None:
        self.send_response(429)
        self.send_header("Retry-After", "\xb2")
        self.send_header("Content-Length", "0")
        self.end_headers()

    do_GET = do_POST

    def log_message(self, *_: object) -> None:
        """Nothing."""


def test_a_server_that_says_when_in_no_digits(tmp_path: Path) -> None:
    server = HTTPServer(("127.0.0.1", 0), Busy)
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        done = lslam(
            "osm", "fetch", "--around", "49,8.4", "--radius", "100", "--out", tmp_path / "o.osm",
            "--set", "osm.attempts=1", "--server", f"http://127.0.0.1:{server.server_port}",
        )  # fmt: skip
    finally:
        server.shutdown()
        server.server_close()
    assert_refused(done, 3)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [("--help",), ("run", "--help"), ("--version",), ("methods",)])
def test_a_reader_that_has_left_is_no_error(words: tuple[str, ...]) -> None:
    """`lslam --help | true`: the pipe is closed before anything is written."""
    child = subprocess.Popen([*COMMAND, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment())
    assert child.stdout is not None
    child.stdout.close()
    _, stderr = child.communicate(timeout=60)
    assert (child.returncode, stderr) == (0, b"")

"""`lslam view` as a user has it: what the page may ask of a run with a true and a false loop, and how the server ends."""

from __future__ import annotations

import base64
import csv
import http.client
import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from calling import COMMAND, SAMPLE, environment, lslam

from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.pipeline.view.server import RunServer
from lslam.pipeline.view.sites import ViewedSites, change_between, require_page

# Beyond the gates of loops: none closes by itself.
DRIFT = ("--set", "debug.drift=true", "--set", "debug.drift_percent=4", "--set", "debug.drift_deg_per_100m=12")


@pytest.fixture(scope="module")
def lost(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose odometry drifts: it ends where it began, and no loop says so."""
    run = tmp_path_factory.mktemp("viewed") / "lost"
    done = lslam("run", SAMPLE, "--out", run, *DRIFT)
    assert done.returncode == 0, done.stderr
    return run


class Client:
    """Asks the server as its page does."""

    def __init__(self, url: str) -> None:
        self.place = urlsplit(url)

    def ask(self, path: str, document: Any = None) -> Any:
        """The answer's JSON, with its status where it is none of 200."""
        connection = http.client.HTTPConnection(self.place.netloc, timeout=60)
        method, body = ("GET", None) if document is None else ("POST", json.dumps(document))
        connection.request(method, self.place.path + path, body, {"Content-Type": "application/json"})
        reply = connection.getresponse()
        content = json.loads(reply.read())
        connection.close()
        return content if reply.status == 200 else (reply.status, content["error"])

    def until(self, path: str, is_over: Callable[[Any], bool]) -> Any:
        """The answer once it `is_over`."""
        for _ in range(1200):
            if is_over(answer := self.ask(path)):
                return answer
            time.sleep(0.1)
        raise AssertionError(answer)


@pytest.fixture
def served(lost: Path) -> Iterator[Client]:
    """The run, without corrections; the new runs are left for the others to see that theirs are further ones."""
    for name in ("edits.csv", "points.csv"):
        (lost / name).unlink(missing_ok=True)
    with RunServer() as server:
        sites = ViewedSites(server)
        sites.add(lost)
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield Client(server.url)
        server.shutdown()
        sites.stop()


def files(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def accepted(folder: Path) -> list[tuple[int, int]]:
    with (folder / "loops.csv").open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["verdict"] == "accepted"]
    return [(int(row["scan_a"]), int(row["scan_b"])) for row in rows]


def test_a_pair_is_registered_where_truth_has_it_and_a_false_one_is_not(served: Client) -> None:
    pair = served.ask("api/pair?a=94&b=0")
    assert (pair["verdict"], pair["scans"], pair["reason"]) == ("accepted", [0, 94], "")
    poses = open_sequence(SAMPLE).ground_truth.poses  # type: ignore[union-attr]
    true = se3.relative(poses[0], poses[94])
    before, after = (np.array(pair[name]) for name in ("before", "after"))
    assert np.linalg.norm(after[:, 3] - true[:3, 3]) < 0.2
    assert np.linalg.norm(before[:, 3] - true[:3, 3]) > 2.0
    assert pair["overlap"] > 0.5
    for name in ("a", "b"):
        assert len(base64.b64decode(pair[name]["points"])) == 6 * pair[name]["count"] > 6000
    wrong = served.ask("api/pair?a=0&b=50")
    assert wrong["verdict"] == "rejected"
    assert wrong["reason"]
    for words, said in (
        ("a=0&b=0", "one keyframe"),
        ("a=0&b=95", "none of the run's"),
        ("a=x", "none of"),
        ("", "none"),
    ):
        status, error = served.ask(f"api/pair?{words}")
        assert (status, said in error) == (422, True), error


def test_a_known_pair_ties_and_only_two_files_and_a_new_run_are_written(served: Client, lost: Path) -> None:
    assert not accepted(lost)
    before, beside = files(lost), set(lost.parent.iterdir())
    known = {"scan_a": 0, "scan_b": 94, "verdict": "known"}
    assert served.ask("api/graph", {})[0] == 422, "nothing was said yet"
    assert served.ask("api/edits", {"pairs": [known], "points": []}) == {"pairs": 1, "points": 0}
    assert (lost / "edits.csv").read_text() == "scan_a,scan_b,verdict\n0,94,known\n"
    assert served.ask("api/edits")["pairs"][0].items() >= known.items()
    begun = served.ask("api/graph", {})
    assert begun["state"] == "running"
    assert served.ask("api/graph", {})[0] == 422, "one at a time"
    done = served.until("api/graph", lambda state: state["state"] != "running")
    assert done["state"] == "done", done
    new = lost.with_name(done["out"])
    assert set(lost.parent.iterdir()) - beside == {new}
    after = files(lost)
    assert {name for name in after if after[name] != before.get(name)} == {"edits.csv"}
    assert (0, 94) in accepted(new)
    # What moved, as truth has it: the last pose is back where it belongs.
    old, now = (read_trajectory(folder / "trajectory.tum", "tum") for folder in (lost, new))
    moved = np.frombuffer(base64.b64decode(done["positions"]), "<f4").reshape(-1, 3)
    poses = open_sequence(SAMPLE).ground_truth.poses  # type: ignore[union-attr]
    true = se3.relative(poses[0], poses[94])[:3, 3]
    assert np.linalg.norm(moved[94] - moved[0] - true) < 0.3
    assert np.linalg.norm(old.positions[94] - old.positions[0] - true) > 2.0
    assert done["most_m"] == pytest.approx(change_between(old, now)["most_m"], rel=1e-6)
    assert done["most_m"] > 1.0
    # The page of the new run, and its own corrections: those it was made with.
    assert served.ask(f"{done['page']}api/edits")["pairs"][0].items() >= known.items()
    # Forbidden, with its neighbours nothing is closed there; and it goes into a further run.
    served.ask("api/edits", {"pairs": [known | {"verdict": "forbidden"}], "points": []})
    served.ask("api/graph", {})
    again = served.until("api/graph", lambda state: state["state"] != "running")
    assert (again["out"], accepted(lost.with_name(again["out"]))) == ("lost-graph-2", [])


def test_points_are_written_as_lslam_reads_them_and_nonsense_is_refused(served: Client, lost: Path) -> None:
    point = {"scan": 3, "x": 458000.5, "y": 5430000, "z": 115, "sigma": 0.02, "crs": "EPSG:25832"}
    seen = point | {"scan": 90, "lidar_x": 1.5, "lidar_z": -1}
    assert served.ask("api/edits", {"pairs": [], "points": [point]}) == {"pairs": 0, "points": 1}
    assert (lost / "points.csv").read_text() == "scan,x,y,z,sigma,crs\n3,458000.5,5430000.0,115.0,0.02,EPSG:25832\n"
    served.ask("api/edits", {"pairs": [], "points": [point, seen]})
    assert [p["lidar_x"] for p in served.ask("api/edits")["points"]] == [0, 1.5]
    good = files(lost)
    pair = {"scan_a": 0, "scan_b": 9, "verdict": "known"}
    for pairs, points, said in (
        ([pair | {"verdict": "perhaps"}], [], "verdict"),
        ([pair | {"scan_b": 95}], [], "scan 95 is none of the run's"),
        ([pair | {"scan_b": -1}], [], "scan_b"),
        ([pair | {"more": "=cmd()"}], [], "more"),
        ([], [point | {"sigma": 0}], "sigma"),
        ([], [point | {"crs": "25832"}], "EPSG"),
        ([], [point | {"crs": "EPSG:25832\n1,2"}], "EPSG"),
        ([], [point | {"x": "far"}], "x"),
        ([pair] * 5001, [], "5000"),
    ):
        status, error = served.ask("api/edits", {"pairs": pairs, "points": points})
        assert (status, said in error) == (422, True), error
    assert served.ask("api/edits", [])[0] == 422
    assert files(lost) == good
    # Nothing said is no file.
    served.ask("api/edits", {"pairs": [], "points": []})
    assert not {"edits.csv", "points.csv"} & set(files(lost))


def test_tiles_are_the_map_and_know_their_scan(served: Client, lost: Path) -> None:
    from lslam.io.formats.point_files import read_cloud
    from lslam.maps.octree import points_of

    tree = served.until("tiles/tree.json", lambda tree: "nodes" in tree)
    cloud = read_cloud(lost / "map.ply")
    assert tree["points"] == sum(tree["nodes"].values()) == len(cloud)
    connection = http.client.HTTPConnection(served.place.netloc, timeout=60)
    connection.request("GET", f"{served.place.path}tiles/r.bin")
    data, count = connection.getresponse().read(), tree["nodes"]["r"]
    assert len(data) == count * (6 + sum(tree["columns"].values()) + 4)
    points, nearest = points_of("r", data[: 6 * count], tree), np.frombuffer(data[-4 * count :], "<u4")
    positions = read_trajectory(lost / "trajectory.tum", "tum").positions
    away = np.linalg.norm(points[:50, None] - positions, axis=2)
    np.testing.assert_array_equal(nearest[:50], away.argmin(1))


def heed_hangup() -> None:
    """A terminal that hangs up ends the process, though tests may run under `nohup`, which it would inherit."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@contextmanager
def viewing(run: Path, *words: str) -> Iterator[tuple[subprocess.Popen[str], Client]]:
    """`lslam view` in a process of its own."""
    command = [*COMMAND, "view", str(run), "--no-browser", *words]
    with subprocess.Popen(
        command,
        env=environment(),
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=heed_hangup,
    ) as child:
        try:
            assert child.stdout is not None
            yield child, Client(child.stdout.readline().strip())
        finally:
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)


def children(pid: int) -> list[int]:
    """Of any of its threads: that which was asked begins a child, and ends meanwhile."""
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):
            found += [int(word) for word in (task / "children").read_text().split()]
    return found


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_it_ends_with_its_terminal_and_so_does_its_child(lost: Path, number: signal.Signals) -> None:
    with viewing(lost) as (process, client):
        client.ask("api/edits", {"pairs": [{"scan_a": 0, "scan_b": 94, "verdict": "known"}], "points": []})
        out = client.ask("api/graph", {})["out"]
        for _ in range(100):
            if kin := children(process.pid):
                break
            time.sleep(0.01)
        assert len(kin) == 1
        process.send_signal(number)
        assert process.wait(30) == 130
        assert process.stderr is not None
        assert process.stderr.read().splitlines()[-1] == "interrupted"
        assert not Path(f"/proc/{kin[0]}").exists()
    assert not list(lost.with_name(out).glob("*.part")), "stopped as Ctrl-C stops it"


def test_a_run_that_is_none_and_a_port_in_use_are_said(lost: Path, tmp_path: Path) -> None:
    assert lslam("view", tmp_path / "none").returncode == 3
    with RunServer() as server:
        done = lslam("view", lost, "--no-browser", "--port", server.server_port)
        assert (done.returncode, done.stdout) == (2, "")
    assert lslam("view", lost, "--rerun", tmp_path / "a.rrd", "--port", 8000).returncode == 2
    assert lslam("view", lost, "--overwrite").returncode == 2


def test_a_run_without_a_pose_is_not_sent_in_a_circle(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_text(json.dumps({"status": "failed"}))
    with pytest.raises(InputError, match="ended before it had a pose"):
        require_page(tmp_path)

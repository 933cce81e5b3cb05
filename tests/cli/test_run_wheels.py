"""`lslam run --wheels` as a user calls it."""

from __future__ import annotations

from pathlib import Path

import pytest
from calling import assert_one_sentence, lslam, manifest


@pytest.fixture(scope="module")
def tunnel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a road of which nothing tells how far along one is."""
    out = tmp_path_factory.mktemp("tunnel") / "bore"
    done = lslam("simulate", "tunnel", "--seed", 3, "--scans", 20, "--out", out)
    assert done.returncode == 0, done.stderr
    return out


def test_they_carry_through_a_tunnel_and_threads_change_nothing(tunnel: Path, tmp_path: Path) -> None:
    words = ("run", tunnel, "--set", "map.write=false")
    trajectories = []
    for threads in (1, 2):
        out = tmp_path / f"run{threads}"
        done = lslam(*words, "--wheels", "wheels.csv", "--threads", threads, "--out", out)
        assert done.returncode == 0, done.stderr
        trajectories.append((out / "trajectory.tum").read_bytes())
    assert trajectories[0] == trajectories[1]
    assert "  wheels       used; no scan with surfaces along the way told their scale" in done.stdout
    alone = lslam(*words, "--out", tmp_path / "alone")
    assert alone.returncode == 0, alone.stderr
    assert "nothing confirms the poses" in alone.stdout
    assert "nothing confirms the poses" not in done.stdout
    ways = [float(line.split()[1]) for line in (tmp_path / "alone" / "trajectory.tum").read_text().splitlines()[-1:]]
    ways += [float(line.split()[1]) for line in trajectories[0].decode().splitlines()[-1:]]
    true = manifest(tunnel / "sequences" / "00")["length_m"]
    assert ways[0] < 0.5 * true
    assert ways[1] == pytest.approx(true, rel=0.03)
    facts = manifest(tmp_path / "run1")["wheels"]
    assert facts["used"]
    assert facts["readings"] == 101


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--wheels", "odometry.csv"), 3, "no such file"),
        (("--wheels", "imu.csv"), 3, "no line has a speed of wheels"),
        (("--wheels", "wheels.csv", "--set", "wheels.frame=axle"), 3, "nothing says where frame axle sits"),
        (("--wheels", "wheels.csv", "--imu"), 2, "not weighed together yet"),
        (("--wheels", "wheels.csv", "--method", "fast-lio2"), 2, "the IMU of fast-lio2"),
    ],
)
def test_what_cannot_be_is_one_sentence(
    words: tuple[str, ...], code: int, said: str, tunnel: Path, tmp_path: Path
) -> None:
    done = lslam("run", tunnel, *words, "--out", tmp_path / "run")
    assert done.returncode == code
    assert_one_sentence(done.stderr)
    assert said in done.stderr
    assert not (tmp_path / "run").exists()


def test_wheels_that_changed_are_not_resumed(tunnel: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.csv"
    text = (tunnel / "sequences" / "00" / "wheels.csv").read_text()
    own.write_text(text)
    words = ("run", tunnel, "--wheels", own, "--set", "map.write=false", "--out", tmp_path / "run")
    assert lslam(*words).returncode == 0
    own.write_text(text.replace("stamp_ns,speed", "stamp_ns,v").replace("20000000,", "20000001,", 1))
    done = lslam(*words, "--resume")
    assert done.returncode == 2
    assert "the readings of --wheels are others" in done.stderr

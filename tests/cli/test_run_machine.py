"""`lslam run` on odd machines: nowhere to write but the output, many first runs at once, a damaged kernel cache."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
from pathlib import Path

import pytest
from calling import COMMAND, SAMPLE, environment, lslam_process, manifest

STARTS = 4


def cpu_of_children() -> float:
    """Seconds that processes which have ended took, and theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.fixture(scope="module")
def cold_starts(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[tuple[int, str]], Path, float]:
    """First runs at once on one empty kernel cache: the cache, (exit code, stderr) of each, folders, CPU seconds.

    They start away from the sources, here and below: the lslam that is installed compiles, and numba keeps kernels by
    the files they come from.
    """
    base = tmp_path_factory.mktemp("cold")
    env = environment(NUMBA_CACHE_DIR=str(base / "cache"))
    began = cpu_of_children()
    children = [
        subprocess.Popen(
            [*COMMAND, "run", str(SAMPLE), "--count", "5", "--out", str(base / f"run{k}")],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=env, cwd=base,
        )
        for k in range(STARTS)
    ]  # fmt: skip
    ended = [(child.communicate(timeout=300)[1], child.returncode) for child in children]
    return base / "cache", [(code, stderr) for stderr, code in ended], base, cpu_of_children() - began


def test_cold_starts_on_one_cache_all_succeed(
    cold_starts: tuple[Path, list[tuple[int, str]], Path, float],
) -> None:
    _, ended, base, _ = cold_starts
    assert [code for code, _ in ended] == [0] * STARTS
    for _, stderr in ended:
        assert "Traceback" not in stderr
        assert "damaged" not in stderr
        assert stderr.count("compiling kernels, once") <= 1
    # Who finds them compiled while waiting has waited long enough to be told.
    assert sum("compiling kernels, once" in stderr for _, stderr in ended) > STARTS // 2
    trajectories = {(base / f"run{k}" / "trajectory.tum").read_bytes() for k in range(STARTS)}
    assert len(trajectories) == 1


def test_only_the_first_compiles(cold_starts: tuple[Path, list[tuple[int, str]], Path, float], tmp_path: Path) -> None:
    cache, _, _, cold_s = cold_starts
    began = cpu_of_children()
    warm = lslam_process(
        "run",
        SAMPLE,
        "--count",
        5,
        "--out",
        tmp_path / "out",
        env=environment(NUMBA_CACHE_DIR=str(cache)),
        cwd=tmp_path,
    )
    warm_s = cpu_of_children() - began
    assert warm.returncode == 0
    assert "compiling" not in warm.stderr
    assert manifest(tmp_path / "out")["timings"]["compile_s"] < 3
    # To compile takes ten times as long as such a run, on any machine, and all of them would have needed it.
    assert cold_s - STARTS * warm_s < STARTS / 2 * 10 * warm_s


def test_a_damaged_cache_costs_time_not_the_run(
    cold_starts: tuple[Path, list[tuple[int, str]], Path, float], tmp_path: Path
) -> None:
    cache, _, base, _ = cold_starts
    # The smallest kernels, so that compiling them again is quick.
    indices = sorted(cache.rglob("*voxel*.nbi"), key=lambda file: file.stat().st_size)
    codes = sorted(cache.rglob("*voxel*.nbc"), key=lambda file: file.stat().st_size)
    indices[0].write_bytes(b"no index")
    codes[1].write_bytes(codes[1].read_bytes()[:100])
    for number, said in ((1, True), (2, False)):
        out = tmp_path / str(number)
        env = environment(NUMBA_CACHE_DIR=str(cache))
        done = lslam_process("run", SAMPLE, "--count", 5, "--out", out, env=env, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert ("kernel cache is damaged" in done.stderr) == said, "and it is repaired by that"
        assert (out / "trajectory.tum").read_bytes() == (base / "run0" / "trajectory.tum").read_bytes()


def test_a_home_that_cannot_be_written(
    cold_starts: tuple[Path, list[tuple[int, str]], Path, float], tmp_path: Path
) -> None:
    cache, _, _, _ = cold_starts
    (tmp_path / "file").write_text("")
    # The temporary directory stands in; it has the kernels already, so finding them shows that it does.
    stand_in = tmp_path / f"lslam-cache-{os.getuid()}"
    shutil.copytree(cache, stand_in / "numba")
    for home in ("/proc/none", str(tmp_path / "file")):
        more = {"HOME": home, "XDG_CACHE_HOME": f"{home}/cache", "XDG_CONFIG_HOME": f"{home}/config"}
        env = environment(TMPDIR=str(tmp_path), **more)
        env.pop("NUMBA_CACHE_DIR", None)
        out = tmp_path / home.replace("/", "_")
        done = lslam_process("run", SAMPLE, "--count", 4, "--out", out, env=env, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in done.stderr
        assert "compiling" not in done.stderr


def test_nothing_is_written_beside_the_output_and_the_cache(
    cold_starts: tuple[Path, list[tuple[int, str]], Path, float], tmp_path: Path
) -> None:
    cache, _, _, _ = cold_starts
    home, work = tmp_path / "home", tmp_path / "work"
    home.mkdir()
    work.mkdir()
    env = environment(HOME=str(home), XDG_CACHE_HOME=str(home / ".cache"), NUMBA_CACHE_DIR=str(cache))
    assert lslam_process("run", SAMPLE, "--count", 4, "--out", tmp_path / "out", env=env, cwd=work).returncode == 0
    assert list(work.iterdir()) == []
    assert [p.name for p in home.iterdir()] in ([], [".cache"])

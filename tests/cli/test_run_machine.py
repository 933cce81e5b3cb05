"""`lslam run` on odd machines: nowhere to write but the output, many first runs at once, a damaged kernel cache."""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
from pathlib import Path

import pytest
from calling import COMMAND, SAMPLE, environment, lslam_process, manifest

from lslam.core.kernels.cache import kernel_folder

STARTS = 4
# The fewest kernels that make a map: those of a map of given poses.
MAPPING = ("run", SAMPLE, "--poses", SAMPLE / "poses" / "00.txt", "--no-loops", "--count", 5, "--out")
Starts = tuple[Path, list[tuple[int, str]], Path, list[float]]


def cpu_of_children() -> float:
    """Seconds that processes which have ended took, and theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def installed(**more: str) -> dict[str, str]:
    """The environment as it was given: tests prefer their sources to the lslam that is installed."""
    env = environment(**more)
    env["PYTHONPATH"] = env.pop("PYTHONPATH_GIVEN")  # an empty one is none
    return env


@pytest.fixture(scope="module")
def cold_starts(tmp_path_factory: pytest.TempPathFactory) -> Starts:
    """First runs at once on one empty kernel cache: the cache, (exit code, stderr) of each, folders, CPU seconds of each.

    They start away from the sources, here and below: the lslam that is installed compiles, and numba keeps kernels by
    the files they come from.
    """
    base = tmp_path_factory.mktemp("cold")
    env = installed(NUMBA_CACHE_DIR=str(base / "cache"))
    children = [
        subprocess.Popen(
            [*COMMAND, *map(str, MAPPING), str(base / f"run{k}")],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=env, cwd=base,
        )
        for k in range(STARTS)
    ]  # fmt: skip
    ended, seconds = [], []
    for child in children:
        before = cpu_of_children()
        ended.append((child.communicate(timeout=300)[1], child.returncode))
        seconds.append(cpu_of_children() - before)
    return base / "cache", [(code, stderr) for stderr, code in ended], base, seconds


def test_cold_starts_on_one_cache_all_succeed(cold_starts: Starts) -> None:
    _, ended, base, _ = cold_starts
    assert [code for code, _ in ended] == [0] * STARTS
    for _, stderr in ended:
        assert "Traceback" not in stderr
        assert "damaged" not in stderr
    told = [stderr.count("compiling kernels, once; ") for _, stderr in ended]
    assert max(told) == 1
    assert len({(base / f"run{k}" / "map.ply").read_bytes() for k in range(STARTS)}) == 1


def test_no_kernel_is_compiled_twice(cold_starts: Starts, tmp_path: Path) -> None:
    cache, _, _, seconds = cold_starts
    used = []
    for name in (cache, tmp_path / "cache"):
        before = cpu_of_children()
        done = lslam_process(
            *MAPPING, tmp_path / name.parent.name, env=installed(NUMBA_CACHE_DIR=str(name)), cwd=tmp_path
        )
        used.append(cpu_of_children() - before)
        assert done.returncode == 0
        assert ("compiling" in done.stderr) == (name != cache)
    assert manifest(tmp_path / cache.parent.name)["timings"]["compile_s"] < 3
    warm_s, alone_s = used
    assert alone_s > 2 * warm_s
    # All together compile as much as one alone; were it half as much again for each, it would be twice.
    assert sum(seconds) - STARTS * warm_s < 2 * (alone_s - warm_s)


def test_a_damaged_cache_costs_time_not_the_run(cold_starts: Starts, tmp_path: Path) -> None:
    cache, _, base, _ = cold_starts
    # The smallest kernels, so that compiling them again is quick.
    small, larger, *_ = sorted(cache.rglob("*.nbc"), key=lambda file: file.stat().st_size)
    small.with_name(small.name.removesuffix(".1.nbc") + ".nbi").write_bytes(b"no index")
    larger.write_bytes(larger.read_bytes()[:100])
    for number, said in ((1, True), (2, False)):
        out = tmp_path / str(number)
        done = lslam_process(*MAPPING, out, env=installed(NUMBA_CACHE_DIR=str(cache)), cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert ("kernel cache is damaged" in done.stderr) == said, "and it is repaired by that"
        assert (out / "map.ply").read_bytes() == (base / "run0" / "map.ply").read_bytes()


def test_a_home_that_cannot_be_written(cold_starts: Starts, tmp_path: Path) -> None:
    cache, _, _, _ = cold_starts
    (tmp_path / "file").write_text("")
    # The temporary directory stands in; it has the kernels already, so finding them shows that it does.
    stand_in = tmp_path / f"lslam-cache-{os.getuid()}"
    shutil.copytree(cache, stand_in / "numba")
    for home in ("/proc/none", str(tmp_path / "file")):
        more = {"HOME": home, "XDG_CACHE_HOME": f"{home}/cache", "XDG_CONFIG_HOME": f"{home}/config"}
        env = installed(TMPDIR=str(tmp_path), **more)
        env.pop("NUMBA_CACHE_DIR", None)
        done = lslam_process(*MAPPING, tmp_path / home.replace("/", "_"), env=env, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "Traceback" not in done.stderr
        assert "compiling" not in done.stderr


def test_nothing_is_written_beside_the_output_and_the_cache(tmp_path: Path) -> None:
    home, work = tmp_path / "home", tmp_path / "work"
    home.mkdir()
    work.mkdir()
    # The kernels of these tests, compiled already, and the sources that they are of.
    cache = str(kernel_folder())
    env = environment(
        HOME=str(home), XDG_CACHE_HOME=str(home / ".cache"), NUMBA_CACHE_DIR=cache, PYTHONPATH=str(SAMPLE.parent)
    )
    done = lslam_process("run", SAMPLE, "--count", 4, "--out", tmp_path / "out", env=env, cwd=work)
    assert done.returncode == 0, done.stderr
    assert list(work.iterdir()) == []
    assert [p.name for p in home.iterdir()] in ([], [".cache"])


def test_a_profile_shows_where_the_time_went(tmp_path: Path) -> None:
    done = lslam_process(*MAPPING, tmp_path / "out", "--profile", tmp_path / "profile.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads((tmp_path / "profile.json").read_text())
    main = document["profiles"][[p["name"] for p in document["profiles"]].index("MainThread")]
    files = [document["shared"]["frames"][k]["file"] for sample in main["samples"] for k in sample]
    assert any(file.endswith("lslam/pipeline/map_pass.py") for file in files)
    took = sum(manifest(tmp_path / "out")["timings"].values())
    assert main["endValue"] > took

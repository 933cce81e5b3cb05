"""The policy of compiling: flags, where machine code is kept, one process at a time."""

from __future__ import annotations

import importlib
import logging
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lslam
from lslam.core.kernels import cache, jit
from lslam.core.kernels.cache import kernel_sources, source_digest

# isort: split
import numba


def all_kernels() -> list[tuple[str, Any]]:
    found: dict[str, Any] = {}
    package = Path(lslam.__file__).parent
    for path in kernel_sources(package):
        module = importlib.import_module(".".join(["lslam", *path.relative_to(package).with_suffix("").parts]))
        found |= {f"{path.stem}.{n}": f for n, f in vars(module).items() if hasattr(f, "targetoptions")}
    return sorted(found.items())


@pytest.mark.parametrize(("name", "function"), all_kernels())
def test_every_kernel_sums_in_order_and_releases_the_gil(name: str, function: Any) -> None:
    options = function.targetoptions
    assert options["nogil"] is True
    assert not options.get("fastmath")
    assert not options.get("parallel")


def folder_in_new_process(**environment: str) -> Path:
    env = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | environment
    code = "import lslam.core.kernels.jit, numba; print(numba.config.CACHE_DIR)"
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    return Path(done.stdout.strip())


def test_machine_code_lives_in_the_users_cache_under_the_digest_of_the_sources(tmp_path: Path) -> None:
    folder = folder_in_new_process(XDG_CACHE_HOME=str(tmp_path))
    assert folder == tmp_path / "lslam" / "numba" / source_digest()


def test_a_folder_of_the_user_is_kept(tmp_path: Path) -> None:
    assert folder_in_new_process(NUMBA_CACHE_DIR=str(tmp_path)) == tmp_path / source_digest()


def test_a_process_begun_by_another_shares_its_folder(tmp_path: Path) -> None:
    parent = folder_in_new_process(NUMBA_CACHE_DIR=str(tmp_path))
    assert folder_in_new_process(NUMBA_CACHE_DIR=str(parent)) == parent


def test_a_home_that_cannot_be_written_falls_back_to_the_temporary_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file where the cache should be")
    folder = folder_in_new_process(XDG_CACHE_HOME=str(tmp_path / "file"), TMPDIR=str(tmp_path))
    assert folder.parent.parent.parent == tmp_path
    assert folder.parent.parent.name.startswith("lslam-cache-")


def planted(shared: Path, way: str) -> Path:
    """What another user may have left where the cache falls back to."""
    shared.mkdir()
    shared.parent.chmod(0o1777)
    if way in ("group", "open"):
        shared.chmod(0o770 if way == "group" else 0o777)
    elif way == "link":
        shared.rmdir()
        shared.with_name("theirs").mkdir(mode=0o700)
        shared.symlink_to("theirs")
    elif os.getuid() == 0:
        os.chown(shared, 12345, 12345)
    else:
        pytest.skip("only root can give a folder away")
    return shared


def test_a_cache_in_the_home_that_a_group_could_write_is_shut(tmp_path: Path) -> None:
    (tmp_path / "lslam").mkdir()
    (tmp_path / "lslam").chmod(0o775)
    folder = folder_in_new_process(XDG_CACHE_HOME=str(tmp_path))
    assert folder == tmp_path / "lslam" / "numba" / source_digest()
    assert (tmp_path / "lslam").stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize("way", ["group", "open", "link", "theirs"])
def test_a_fallback_that_others_can_write_is_refused_and_kernels_are_compiled_without_a_cache(
    way: str, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("a file where the cache should be")
    shared = planted(tmp_path / f"lslam-cache-{os.getuid()}", way)
    code = (
        "import logging; logging.basicConfig(format='%(message)s')\n"
        "import numpy as np, lslam.core.kernels.voxel as v; v.first_points(np.zeros((3, 3), np.float32), 1.0)"
    )
    env = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    env |= {"XDG_CACHE_HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    assert "is not used as a cache" in done.stderr
    assert "kernels are compiled anew each time" in done.stderr
    assert list(shared.iterdir()) == []


def test_the_fallback_is_for_the_user_alone(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file where the cache should be")
    folder = folder_in_new_process(XDG_CACHE_HOME=str(tmp_path / "file"), TMPDIR=str(tmp_path))
    assert (folder.parent.parent.stat().st_mode & 0o777) == 0o700


def test_importing_the_package_writes_nothing_and_loads_no_numba(tmp_path: Path) -> None:
    code = "import lslam, sys; assert 'numba' not in sys.modules"
    env = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], env=env, check=True)
    assert list(tmp_path.iterdir()) == []


def test_compiled_kernels_are_found_again(tmp_path: Path) -> None:
    code = (
        "import numpy as np, lslam.core.kernels.voxel as v; v.first_points(np.zeros((3, 3), np.float32), 1.0);"
        "print(sum(v.first_points.stats.cache_hits.values()))"
    )
    env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    hits = [
        subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True).stdout.strip()
        for _ in range(2)
    ]
    assert hits == ["0", "1"]


def test_the_digest_follows_every_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sources = [*(tmp_path / room / "kernels" / "loops.py" for room in ("core", "maps")), tmp_path / "io" / "kernels.py"]
    for path in sources:
        path.parent.mkdir(parents=True)
        path.write_text("x = 1\n")
    monkeypatch.setattr(cache, "__file__", str(sources[0].with_name("cache.py")))
    before = source_digest()
    assert before == source_digest()
    for path in sources[1:]:
        path.write_text("x = 2\n")
        assert before != (before := source_digest())


def test_only_compiling_is_announced_and_once(caplog: pytest.LogCaptureFixture) -> None:
    @numba.njit  # is not kept in the cache, where an earlier run of this test would have left it
    def twice(value: float) -> float:
        return value + value

    calls: list[str] = []
    log = logging.getLogger(__name__)  # that of lslam is as the command lines of other tests left it
    with caplog.at_level("INFO", __name__):
        with jit.announce_compiling(log, lambda: calls.append("loaded")):
            time.sleep(0.05)
        assert not caplog.messages
        with jit.announce_compiling(log, lambda: calls.append("compiled")):
            assert (twice(1.0), twice(1)) == (2.0, 2)
        with jit.announce_compiling(log, lambda: calls.append("compiled before")):
            twice(2.0)
    assert calls == ["compiled"]
    assert len(caplog.messages) == 1
    assert caplog.messages[0].startswith("compiling kernels")


def test_what_is_compiled_is_named_and_what_is_ready_counted(caplog: pytest.LogCaptureFixture) -> None:
    @jit.kernel
    def thrice(value: float) -> float:
        return 3.0 * value

    thrice._cache.flush()  # type: ignore[attr-defined]  # of an earlier run of this test
    name = thrice.py_func.__qualname__  # type: ignore[attr-defined]
    log = logging.getLogger(__name__)
    with caplog.at_level("INFO", __name__):
        for total in (5, None, 1):
            with jit.count_kernels(log, total, every_s=0.0):
                assert (thrice(1.0), thrice(np.float32(1.0))) == (3.0, 3.0)
            thrice = jit.kernel(thrice.py_func)  # type: ignore[attr-defined]
        with jit.count_kernels(log, 5):
            thrice(1.0)
    assert caplog.messages == [f"compiling kernels, once: {name} ({n} of 5)" for n in (1, 2)], "the others are loaded"
    events = [vars(record)["event"] for record in caplog.records]
    assert events == [{"event": "compile", "kernel": name, "done": n, "of": 5} for n in (0, 1)]


def test_functions_compiled_into_kernels_are_their_source_for_python() -> None:
    @jit.inline
    def half(value: float) -> float:
        return 0.5 * value

    @jit.kernel
    def quarter(value: float) -> float:
        return half(half(value))

    assert (half(4.0), quarter(4.0), half(2.0)) == (2.0, 1.0, 1.0)

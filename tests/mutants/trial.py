"""One mutant against the tests that run its line, in a copy of the project."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mutants.sites import Mutant

from lslam.core.kernels.cache import kernel_sources

PROJECT = Path(__file__).resolve().parents[2]
TESTS = ("backend/graph", "backend/loops", "odometry/inertial", "evaluation", "registration", "core/kernels", "oracle")
RESIDUALS = "lslam/registration/residuals.py"
PYTEST = ["-o", "addopts=", "-x", "-q", "--tb=no", "--hypothesis-seed=0", "-p", "no:cacheprovider", "-W", "ignore"]


class Copy:
    """A copy of the project in `folder` whose files may be changed."""

    def __init__(self, folder: Path) -> None:
        self.root = folder
        shutil.copytree(PROJECT / "lslam", folder / "lslam", ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copytree(PROJECT / "tests", folder / "tests", ignore=shutil.ignore_patterns("__pycache__", "benchmarks"))
        shutil.copytree(PROJECT / "sample_data", folder / "sample_data")
        shutil.copy(PROJECT / "pyproject.toml", folder)

    def pytest(self, words: list[str], timeout: float | None = None, **environment: str) -> tuple[int | None, str]:
        """Exit code, None after `timeout` seconds, and what was printed."""
        paths = {"PYTHONPATH": f"{self.root}{os.pathsep}{self.root / 'tests'}"}
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *PYTEST, *words],
            cwd=self.root,
            env={**os.environ, **paths, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            said, _ = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return None, ""
        return process.returncode, said

    def trace(self, also: Sequence[str]) -> dict[str, Any]:
        """Per test file its seconds and, per file of lslam, the lines it runs. Without a mutant all tests must pass."""
        told = self.root / "lines.json"
        folders = [f"tests/{name}" for name in (*TESTS, *also)]
        code, said = self.pytest(["-p", "mutants.lines", *folders], MUTANTS_LINES=str(told))
        if code != 0:
            sys.exit(f"the tests fail without a mutant:\n{said}")
        return json.loads(told.read_text())  # type: ignore[no-any-return]

    def judge(self, mutant: Mutant, covered: dict[str, Any]) -> dict[str, Any]:
        """Run the tests of one mutant: a failure or a time of many times theirs kills it."""
        path = self.root / mutant.file
        source, stat = path.read_bytes(), path.stat()
        text = mutant.of(source)
        names = self.tests_of(mutant, covered)
        is_kernel = "/kernels/" in mutant.file
        limit = 60 + 300 * is_kernel + 5 * sum(covered[name]["seconds"] for name in names)
        with tempfile.TemporaryDirectory(dir=self.root) as cache:
            try:
                path.write_bytes(text)
                # Byte code is kept by size and seconds: no mutant may be taken for another.
                os.utime(path, (stat.st_atime, stat.st_mtime - 10 - zlib.crc32(text) % 10**6))
                code, said = self.pytest(names, limit, **({"NUMBA_CACHE_DIR": cache} if is_kernel else {}))
            finally:
                path.write_bytes(source)
                os.utime(path, (stat.st_atime, stat.st_mtime))
        killer = re.search(r"^(?:FAILED|ERROR) (\S+)", said, re.MULTILINE)
        return {
            "mutant": mutant.name,
            "was": _line(source, mutant.line),
            "now": _line(text, mutant.line),
            "is_killed": code != 0 and bool(names),
            "by": "time" if code is None else killer[1] if killer else f"exit {code}" if code else "",
        }

    def tests_of(self, mutant: Mutant, covered: dict[str, Any]) -> list[str]:
        """The test files that run the line, the one of its name first, then the fastest.

        A line that runs on import, or that nothing runs, has those that run anything of its file. What a compiled kernel
        runs is not seen: it has those that import it, or a kernel that imports it, or look residuals up in their table.
        """
        named: list[str] = []
        if "/kernels/" in mutant.file:
            named = self._tests_of_kernel(Path(mutant.file).stem, covered)
            names = [name for name, told in covered.items() if name in named or RESIDUALS in told["lines"]]
        else:
            runs = {name: set(told["lines"].get(mutant.file, ())) for name, told in covered.items()}
            names = [name for name, lines in runs.items() if lines & {mutant.line, mutant.statement}]
            names = names or [name for name, lines in runs.items() if lines]
        stem = Path(mutant.file).stem
        return sorted(names, key=lambda name: (stem not in name, name not in named, covered[name]["seconds"]))

    def _tests_of_kernel(self, stem: str, covered: dict[str, Any]) -> list[str]:
        kernels = {path.stem: path.read_text() for path in kernel_sources(self.root / "lslam")}
        users = {stem} | {user for user, text in kernels.items() if f".kernels.{stem} import" in text}
        pattern = re.compile("|".join(rf"\.kernels\.{user}\b|kernels import .*\b{user}\b" for user in users))
        return [name for name in covered if pattern.search((self.root / name).read_text())]


def _line(source: bytes, line: int) -> str:
    return source.decode().splitlines()[line - 1].strip()

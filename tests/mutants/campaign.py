"""`python -m tests.mutants --count 300 --seed N`: of small faults put into the program, how many the tests notice.

Mutants are drawn from `PACKAGES`, and `--kernels` of them from the compiled
kernels that registration calls. Each is run in a copy of the project, alone, against the test files that run its line.
Results are lines of JSON in `--out`: what is there already is not tried again, or with `--again` only what survived. The
tests of the command line and of whole runs are not asked, unless `--also`: the share is a lower bound.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from mutants.sites import Mutant, mutants
from mutants.trial import PROJECT, Copy

PACKAGES = ("backend/graph", "backend/loops", "odometry/inertial", "evaluation", "registration")


def registration_kernels() -> list[str]:
    """Files of the kernels that registration imports, and of those that they import."""
    found: list[str] = []
    texts = [path.read_text() for path in (PROJECT / "lslam" / "registration").glob("*.py")]
    while texts:
        for room, stem in re.findall(r"lslam\.(\w+)\.kernels(?:\.| import )(\w+)", texts.pop()):
            if stem != "jit" and (file := f"lslam/{room}/kernels/{stem}.py") not in found:
                found.append(file)
                texts.append((PROJECT / file).read_text())
    return sorted(found)


def drawn(count: int, seed: int, kernels: float) -> list[Mutant]:
    """`count` mutants, of which the share `kernels` in compiled code.

    Each has a lot of its own, whatever became of other lines: after an edit the same are drawn again.
    """
    paths = [path for name in PACKAGES for path in sorted((PROJECT / "lslam" / name).glob("*.py"))]
    interpreted = [m for path in paths for m in mutants(PROJECT, str(path.relative_to(PROJECT)))]
    compiled = [m for file in registration_kernels() for m in mutants(PROJECT, file)]
    print(f"{len(interpreted)} mutants of interpreted code, {len(compiled)} of compiled code", flush=True)

    def lot(mutant: Mutant) -> bytes:
        return hashlib.sha256(f"{seed} {mutant.name}".encode()).digest()

    some = round(count * kernels)
    return sorted(sorted(interpreted, key=lot)[: count - some] + sorted(compiled, key=lot)[:some], key=lot)


def read(out: Path) -> dict[str, dict[str, Any]]:
    """The last result of each mutant, by its name."""
    rows = map(json.loads, out.read_text().splitlines()) if out.exists() else []
    return {row["mutant"]: row for row in rows}


def summary(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield "| package | mutants | killed | share |"
    yield "|---|---|---|---|"
    package = [row["mutant"].partition("/")[2].rpartition("/")[0] for row in rows]
    for name in (*sorted(set(package)), "all"):
        killed = [row["is_killed"] for row, its in zip(rows, package, strict=True) if name in (its, "all")]
        yield f"| {name} | {len(killed)} | {sum(killed)} | {100 * sum(killed) / len(killed):.0f} % |"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kernels", type=float, default=0.05, help="share of mutants in compiled code")
    parser.add_argument("--jobs", type=int, default=2, help="mutants tried at the same time")
    parser.add_argument("--also", nargs="*", default=[], help="folders of tests asked beside those of the packages")
    parser.add_argument("--again", action="store_true", help="try again what survived")
    parser.add_argument("--out", type=Path, default=Path("runs/mutants.jsonl"))
    asked = parser.parse_args()
    chosen, known = drawn(asked.count, asked.seed, asked.kernels), read(asked.out)
    left = [m for m in chosen if m.name not in known or (asked.again and not known[m.name]["is_killed"])]
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    lock = threading.Lock()
    with tempfile.TemporaryDirectory() as folder:
        copies = [Copy(Path(folder) / str(i)) for i in range(asked.jobs)]
        covered = copies[0].trace(asked.also) if left else {}

        def judge(mutant: Mutant) -> None:
            with lock:
                copy = copies.pop()
            row = copy.judge(mutant, covered)
            with lock:
                copies.append(copy)
                with asked.out.open("a") as out:
                    out.write(json.dumps(row) + "\n")

        with ThreadPoolExecutor(asked.jobs) as pool:
            list(pool.map(judge, left))
    known = read(asked.out)
    rows = [known[mutant.name] for mutant in chosen]
    for mutant, row in zip(chosen, rows, strict=True):
        if not row["is_killed"]:
            print(f"survived: {mutant.file}:{mutant.line}: {row['was']}  ->  {row['now']}")
    print("\n".join(summary(rows)))
    return 0

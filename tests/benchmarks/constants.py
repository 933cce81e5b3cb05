"""Every number that a scan passes, at half and at double: what the error becomes.

    python tests/benchmarks/constants.py --recordings FOLDER --work FOLDER [--only tracker,integrity] [--write docs/algorithms.md]

A number is changed in the source of a copy of the package, so that compiled code has it too; a key in the configuration. A share
near 1 is changed by what it lacks, a ratio by what it exceeds 1, a cosine by its angle. Poses are the same bytes where a number
acts nowhere. Results are kept in the work folder, and a second call goes on from there.

The error is the ATE, of simulated drives from the first pose, of recordings aligned. What changes no pose may change
covariances (NEES) or the checks of the monitor. Drives are short: a number that matters on none of them may matter elsewhere.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tables
from constant_drives import ROOT, RUNS, load

from lslam.core.config.config import load_config

# What a scan passes: files, and which runs tell of their numbers.
PATH: dict[str, tuple[str, ...]] = {
    "points": (
        "registration/*.py", "odometry/frontend/tracker.py", "odometry/frontend/segments.py",
        "odometry/frontend/scene_scale.py", "odometry/inertial/constant_velocity.py", "odometry/scan_outcome.py",
        "odometry/uncertainty.py", "odometry/frontend/windows.py", "odometry/icp.py",
        "registration/preprocessing/prepare.py", "registration/preprocessing/deskew.py", "registration/preprocessing/ground.py",
        "core/kernels/gauss_newton.py", "core/kernels/gaussians.py", "core/kernels/residuals.py", "core/kernels/ground.py",
        "core/kernels/linearisation.py", "core/kernels/voxel.py",
    ),
    "features": (
        "odometry/feature_*.py", "odometry/loam.py", "registration/preprocessing/features.py",
        "registration/kernels/curvature.py", "odometry/kernels/feature_grid.py", "odometry/kernels/feature_residuals.py",
        "odometry/kernels/lines.py",
    ),
    "imu": (
        "odometry/inertial/fusion.py", "odometry/inertial/gyroscope.py", "odometry/inertial/imu_estimate.py",
        "odometry/inertial/imu_cleaning.py", "odometry/inertial/initialise.py", "odometry/inertial/integrate.py",
    ),
    "checks": ("odometry/integrity/*.py", "core/types/scan_result.py"),
}  # fmt: skip
# Of other methods, of `localize`, of the whole recording, of what is off unless asked for, and what is no quantity: dimensions,
# indices, marks, bits, constants of nature.
NOT_OF_IT = {
    "registration/gaussian_map.py COVARIANCE_CELL_M", "registration/gaussian_map.py CELL_FACTOR",
    "registration/gaussian_map.py COVARIANCE_POINTS", "registration/voxel_target.py SPARSE_SHARE",
    "registration/policies.py NO_PLANES", "core/kernels/voxel.py OFFSET", "core/kernels/voxel.py MASK",
    "core/kernels/gaussians.py FREE", "core/kernels/gaussians.py EMPTY", "core/kernels/gaussians.py BLOB",
    "core/kernels/linearisation.py COUNT",
    "core/kernels/ground.py NO_HEIGHT", "odometry/kernels/lines.py NO_LINE", "registration/kernels/curvature.py EDGE",
    "registration/kernels/curvature.py LESS_EDGE", "registration/kernels/curvature.py NEITHER",
    "registration/kernels/curvature.py LESS_PLANE", "registration/kernels/curvature.py PLANE",
    "registration/preprocessing/features.py MAY_BE_EDGE", "registration/preprocessing/features.py MAY_BE_FLAT",
    "registration/preprocessing/features.py MAY_BE_PLANE", "registration/keyframe_submap.py",
    "odometry/integrity/alerts.py AXES", "registration/preprocessing/ground.py Z",
    "odometry/inertial/integrate.py PERFECT", "odometry/inertial/gyroscope.py MOUNTING",
    "registration/optimiser.py EVERYWHERE", "odometry/feature_solver.py NONE",
    "registration/preprocessing/prepare.py DENOISE_NEIGHBOURS", "registration/preprocessing/prepare.py DENOISE_DEVIATIONS",
    "registration/preprocessing/prepare.py NO_TIMES", "core/kernels/gaussians.py USED", "core/kernels/gaussians.py FREED",
    "core/kernels/gaussians.py HAND", "core/kernels/gaussians.py LIVE", "odometry/frontend/scene_scale.py USUAL_RANGE_M",
    "odometry/integrity/pair_registration.py _ROWS", "odometry/integrity/pair_registration.py _COLUMNS",
    "odometry/inertial/gyroscope.py MOUNTING_SIGMA", "odometry/inertial/gyroscope.py OFFSET_SIGMA",
    "odometry/inertial/gyroscope.py OFFSET_WALK", "odometry/inertial/imu_cleaning.py WHEEL_GAP_S",
    "odometry/inertial/initialise.py GIVEN_ACCEL_BIAS", "odometry/inertial/initialise.py GIVEN_GYRO_BIAS",
    "odometry/inertial/initialise.py GIVEN_SPEED", "odometry/inertial/initialise.py MOST_BIAS_ERROR_RAD_S",
    "odometry/feature_policies.py CONSTRAINED_SCANS", "odometry/inertial/imu_estimate.py PLACE_NOISE",
    "odometry/inertial/imu_estimate.py TURN_NOISE",
}  # fmt: skip
# Keys of sections that every scan passes, those that the scene's size decides aside.
KEYS = {
    "points": (
        "preprocess.range_max", "preprocess.least_line", "preprocess.source_points_min", "preprocess.source_points_max",
        "registration.sigma", "registration.kernel_max", "registration.max_iterations",
        "registration.start_scans", "registration.start_reach", "registration.min_overlap", "registration.min_agreement",
        "registration.max_jump_m", "registration.max_jump_deg", "registration.weak_share",
    ),
}  # fmt: skip
CONFIG = {"preprocess": "core/config/input.py", "registration": "core/config/odometry.py"}
COSINES = {"NEAR_Z"}
# Shares of which 1 is the whole, and ratios of which 1 is none.
LACK = {"FORGETTING_FACTOR", "LESS", "USUAL types", "ALIKE inertial", "KERNEL_DECAY", "COARSE_DECAY"}
EXCESS = {"CLEAR_RATIO", "MUCH_RATIO", "PILED_RATIO"}
FACTORS = {"half": 0.5, "double": 2.0}


@dataclass(frozen=True)
class Number:
    """A named number: file and name, or a key; `runs` tell of it."""

    file: str
    name: str
    runs: str

    @property
    def label(self) -> str:
        return f"{self.file} {self.name}"


def numbers() -> list[Number]:
    """All of the path of a scan, in the order of the files."""
    found = []
    for runs, patterns in PATH.items():
        for pattern in patterns:
            for path in sorted((ROOT / "lslam").glob(pattern)):
                file = path.relative_to(ROOT / "lslam").as_posix()
                if file not in NOT_OF_IT:
                    found += [Number(file, name, runs) for name in values_in(path.read_text(encoding="utf-8"))]
    found += [Number(CONFIG[key.split(".")[0]], key, runs) for runs, keys in KEYS.items() for key in keys]
    return [number for number in found if number.label not in NOT_OF_IT]


def values_in(source: str) -> dict[str, ast.expr]:
    """Names in capitals of a module and its classes, and the expressions of numbers that they are given."""
    found: dict[str, ast.expr] = {}

    def visit(body: Iterable[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{node.name}.")
            pairs: list[tuple[ast.expr, ast.expr]] = []
            if isinstance(node, ast.Assign) and len(node.targets) == 1:
                target, value = node.targets[0], node.value
                if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                    pairs = list(zip(target.elts, value.elts, strict=True))
                else:
                    pairs = [(target, value)]
            elif isinstance(node, ast.AnnAssign) and node.value is not None:
                pairs = [(node.target, node.value)]
            for target, value in pairs:
                if isinstance(target, ast.Name) and target.id.strip("_").isupper() and is_number(value):
                    found[prefix + target.id] = value

    visit(ast.parse(source).body, "")
    return found


def is_number(value: ast.expr) -> bool:
    """Whether an expression has numbers and nothing of ours: `0.1`, `np.deg2rad(3.0)`, `(2, 4)`."""
    nodes = list(ast.walk(value))
    names = {node.id for node in nodes if isinstance(node, ast.Name)}
    constants = [node.value for node in nodes if isinstance(node, ast.Constant)]
    return (
        names <= {"np", "float", "int", "math"} and bool(constants) and all(type(c) in (int, float) for c in constants)
    )


def changed(name: str, file: str, text: str, factor: float) -> str:
    """The expression of another value."""
    short = name.split(".")[-1]
    folder = Path(file).parent.name
    kinds = {short, f"{short} {folder}"}
    if kinds & COSINES:
        return f"float(np.cos({factor} * np.arccos({text})))"
    if kinds & LACK:
        return f"(1 - {factor} * (1 - {text}))"
    if kinds & EXCESS:
        return f"(1 + {factor} * ({text} - 1))"
    value = eval(text, {"np": np, "float": float, "int": int})
    if isinstance(value, int):
        return str(max(1, round(factor * value)) if value > 0 else round(factor * value))
    if isinstance(value, tuple):
        return repr(tuple(max(1, round(factor * v)) if isinstance(v, int) else factor * v for v in value))
    return f"({factor} * ({text}))"


def edited(source: str, number: Number, factor: float) -> str:
    """The source with another value of the number."""
    node = values_in(source)[number.name]
    text = ast.get_source_segment(source, node)
    assert text is not None
    lines = source.splitlines(keepends=True)
    begin = sum(map(len, lines[: node.lineno - 1])) + node.col_offset
    return source[:begin] + changed(number.name, number.file, text, factor) + source[begin + len(text) :]


def key_changed(key: str, factor: float) -> str:
    section, name = key.split(".")
    value = getattr(getattr(load_config(environ={}), section), name)
    if name in LACK:
        return f"{key}={1 - factor * (1 - value)}"
    return f"{key}={max(1, round(factor * value)) if isinstance(value, int) else factor * value}"


def run_with(package: Path, work: Path, runs: str, settings: list[str]) -> dict[str, Any]:
    """The runs of a kind by the package in this folder, in a process of its own."""
    environment = {
        **os.environ, "PYTHONPATH": str(package), "NUMBA_CACHE_DIR": str(work / "kernels"), "OMP_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1",
    }  # fmt: skip
    command = [sys.executable, str(Path(__file__).with_name("constant_drives.py")), runs, str(work), *settings]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=work, check=False)
    if done.returncode:
        return {"failed": done.stderr.strip().splitlines()[-1][:160]}
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def measure(work: Path, wanted: list[Number]) -> dict[str, Any]:
    """Results of every number at half and double, by label, and of the shipped values; kept in the work folder."""
    path, package = work / "results.json", work / "package"
    known: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    if package.exists():
        shutil.rmtree(package)
    shutil.copytree(ROOT / "lslam", package / "lslam", ignore=shutil.ignore_patterns("__pycache__"))
    for runs in RUNS:
        if f"shipped {runs}" not in known and any(n.runs == runs for n in wanted):
            run_with(package, work, runs, [])  # compiles
            known[f"shipped {runs}"] = run_with(package, work, runs, [])
            path.write_text(json.dumps(known))
    shipped_kernels = set((work / "kernels").iterdir())
    for number in wanted:
        kept = known.setdefault(number.label, {})
        for word, factor in FACTORS.items():
            if word in kept:
                continue
            if number.file.startswith("core/config/"):
                kept[word] = run_with(package, work, number.runs, [key_changed(number.name, factor)])
            else:
                file = package / "lslam" / number.file
                before, stat = file.read_text(encoding="utf-8"), file.stat()
                file.write_text(edited(before, number, factor), encoding="utf-8")
                kept[word] = run_with(package, work, number.runs, [])
                file.write_text(before, encoding="utf-8")
                if "/kernels/" in number.file:
                    for folder in set((work / "kernels").iterdir()) - shipped_kernels:
                        shutil.rmtree(folder)
                os.utime(file, ns=(stat.st_atime_ns, stat.st_mtime_ns))
            path.write_text(json.dumps(known))
            print(f"{number.label:55} {word:7} {effect(known[f'shipped {number.runs}'], kept[word])}", flush=True)
    return known


def effect(shipped: dict[str, Any], found: dict[str, Any]) -> str:
    """Ratio of the error to the shipped, median and range over the drives; else what else has changed; or none."""
    if "failed" in found:
        return "no run"
    pairs = [(run, found[key]) for key, run in shipped.items() if "failed" not in run and key in found]
    failed = sum("failed" in b for _, b in pairs)
    pairs = [(a, b) for a, b in pairs if "failed" not in b]
    words = []
    if failed:
        words.append(f"{failed} without a result")
    moved = [(a, b) for a, b in pairs if a["poses"] != b["poses"]]
    if moved:
        ratios = [b["error"] / max(a["error"], 1e-9) for a, b in pairs]
        words.append(spread(ratios))
    ratios = [
        b["nees"] / a["nees"] for a, b in pairs if a["covariances"] != b["covariances"] and "nees" in a and "nees" in b
    ]
    if ratios and not moved:
        words.append(f"NEES {spread(ratios)}")
    checks, conclusive, problems = (
        [sum(run[key] for run in runs) for runs in zip(*pairs, strict=True)]
        for key in ("checked", "conclusive", "problems")
    )
    if not moved and any(a["checks"] != b["checks"] for a, b in pairs):
        words.append(f"{conclusive[1]} of {checks[1]} checks ({conclusive[0]} of {checks[0]})")
    if problems[1] != problems[0]:
        words.append(f"{problems[1] - problems[0]:+d} problems")
    ok = sum(b["ok"] for _, b in pairs) - sum(a["ok"] for a, _ in pairs)
    if ok:
        words.append(f"{ok:+d} scans")
    a, b = (sum(run["seconds"] for run in runs) for runs in zip(*pairs, strict=True))
    # On a busy machine less is noise.
    if moved and not 2 / 3 < b / a < 1.5:
        words.append(f"time {b / a:.1f}")
    return "; ".join(words) or "none"


def spread(ratios: list[float]) -> str:
    return f"{np.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--only", help="parts of labels, comma-separated")
    parser.add_argument("--list", action="store_true", help="names alone")
    parser.add_argument("--known", action="store_true", help="the table of what the work folder has, without more runs")
    tables.offer(parser, None)
    args = parser.parse_args()
    work = args.work.resolve()
    work.mkdir(parents=True, exist_ok=True)
    wanted = [n for n in numbers() if not args.only or any(part in n.label for part in args.only.split(","))]
    if args.list:
        print("\n".join(f"{n.runs:9} {n.label}" for n in wanted))
        print(len(wanted))
        return
    if args.known:
        known = json.loads((work / "results.json").read_text())
        wanted = [n for n in wanted if set(FACTORS) <= set(known.get(n.label, ()))]
    else:
        load(work, args.recordings, {name for n in wanted for name, _ in RUNS[n.runs]})
        known = measure(work, wanted)
    rows = [
        [f"`{n.name}`", f"`{n.file}`", *(effect(known[f"shipped {n.runs}"], known[n.label][word]) for word in FACTORS)]
        for n in wanted
    ]
    caption = (
        "What half and double of each number do: the ATE against that of the shipped value, median and range over the drives; "
        "where no pose changes, the NEES likewise, or the conclusive checks (those of the shipped value); none: the same bytes."
    )
    tables.table("constants", caption, ["name", "file", "half", "double"], rows, args.write)


if __name__ == "__main__":
    main()

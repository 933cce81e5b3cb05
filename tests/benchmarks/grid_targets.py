"""The rows of grid.py as one table, and what the methods should reach, each with the numbers that decide."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]
Key = tuple[str, int | None]
TIE_M = 0.01
RIVALS = ("kiss-icp", "small-gicp", "small-vgicp", "genz-icp")
# Nothing there has the edges and planes that LOAM lives on.
UNSTRUCTURED = ("corridor", "motorway")
ON_FOOT_OR_WING = ("walk", "closed", "open", "climbing", "small-eight", "large-eight")
# Girolimetto: rmse before optimisation, m (its ICP, LOAM and LOAM map).
THESIS = {
    "closed": (2.046, 1.574, 0.856), "open": (0.843, 0.844, 0.584), "climbing": (0.346, 1.948, 1.037),
    "small-eight": (0.681, 0.701, 0.407), "large-eight": (0.719, 2.156, 0.635),
}  # fmt: skip


class Grid:
    """Rows by case, seed and method."""

    def __init__(self, folder: Path) -> None:
        rows = [json.loads(p.read_text()) for p in sorted(folder.glob("*.json"))]
        self.rows: dict[tuple[Key, str], Row] = {((r["case"], r["seed"]), r["method"]): r for r in rows}
        self.keys: list[Key] = list(dict.fromkeys(key for key, _ in self.rows))
        self.methods: list[str] = list(dict.fromkeys(method for _, method in self.rows))

    def error(self, key: Key, method: str) -> float:
        """ATE in m, rotation RPE in deg on KITTI raw, whose reference knows attitudes best; inf when it failed."""
        row = self.rows.get((key, method))
        if row is None:
            return float("nan")
        if row["status"] in ("failed", "diverged"):
            return float("inf")
        return float(row["rot_rpe" if _is_by_rotation(key) else "ate"])

    def ms(self, key: Key, method: str) -> float:
        return float(self.rows.get((key, method), {}).get("ms", np.nan))

    def ratio(self, key: Key, method: str, other: str) -> float:
        """Of errors; 1 within the tie, nan where one of them is missing."""
        return _ratio(self.error(key, method), self.error(key, other), key)

    def plain(self) -> list[Key]:
        """Cases of the main comparison: no other lidar, and not the runs of presets only."""
        return [k for k in self.keys if ":" not in k[0] and all((k, m) in self.rows for m in ("icp", "kiss-icp"))]


def report(folder: Path) -> str:
    """All rows, then the targets."""
    grid = Grid(folder)
    if not grid.keys:
        return f"no rows in {folder}"
    return "\n".join([*_table(grid), "", "targets", *_targets(grid)])


def _table(grid: Grid) -> Iterator[str]:
    head = f"{'case':18} {'seed':>4} {'method':15} {'status':8} {'ATE m':>8} {'origin':>8} {'thesis':>7} {'rot RPE':>8}"
    yield f"{head} {'ms':>6} {'p95':>6} {'bridged':>7} {'weak':>5} {'of':>5}"
    for (case, seed), method in grid.rows:
        r = grid.rows[(case, seed), method]
        start = f"{case:18} {'-' if seed is None else seed!s:>4} {method:15} {r['status']:8}"
        if "ate" not in r:
            yield f"{start} {r.get('reason', '')}"
            continue
        yield (
            f"{start} {r['ate']:8.4f} {r['origin']:8.4f} {r['thesis_rmse']:7.3f} {r['rot_rpe']:8.3f} {r['ms']:6.1f} "
            f"{r['p95']:6.1f} {r['bridged']:7d} {r['degenerate']:5d} {r['n']:5d}"
        )


def _targets(grid: Grid) -> Iterator[str]:
    keys = grid.plain()
    best = {k: min((grid.error(k, m) for m in RIVALS if (k, m) in grid.rows), default=np.nan) for k in keys}
    ratios = {k: _ratio(grid.error(k, "icp"), best[k], k) for k in keys}
    if ratios:
        share = float(np.mean([r <= 1 for r in ratios.values()]))
        yield _said(
            "icp at least as accurate as the best peer", share >= 0.7, f"{100 * share:.0f} % of {len(keys)} (70)"
        )
        yield _all_within("icp never worse than 1.2 x the best peer", ratios, 1.2)
        yield from _times(grid, keys)
    for ours, theirs, most in (
        ("gicp", "small-gicp", 1.1), ("vgicp", "small-vgicp", 1.1), ("ndt", "kiss-icp", 1.2), ("icp-point", "kiss-icp", 1.2),
    ):  # fmt: skip
        yield _all_within(f"{ours} within {most} x {theirs}", {k: grid.ratio(k, ours, theirs) for k in keys}, most)
    structured = [k for k in keys if k[0].partition("@")[0] not in UNSTRUCTURED]
    yield _all_within("loam within 1.5 x kiss-icp", {k: grid.ratio(k, "loam", "kiss-icp") for k in structured}, 1.5)
    for fast, slow in (("loam", "kiss-icp"), ("floam", "loam")):
        yield _all_within(f"{fast} no slower than {slow}", {k: grid.ms(k, fast) / grid.ms(k, slow) for k in keys}, 1.0)
    yield from _divergence(grid)
    yield from _few_beams(grid)
    yield from _thesis(grid)


def _times(grid: Grid, keys: list[Key]) -> Iterator[str]:
    fastest = [grid.ms(k, "icp") / np.nanmin([grid.ms(k, m) for m in RIVALS]) for k in keys]
    median = float(np.nanmedian(fastest))
    yield _said("icp's time over the fastest peer's, median", median <= 0.4, f"{median:.2f} (0.4)")
    tails = {k: grid.rows[k, "icp"]["p95"] / grid.ms(k, "icp") for k in keys}
    yield _all_within("icp's p95 over its median", tails, 1.8)
    lost = {k: grid.rows[k, "icp"].get("lost_starts", 0) for k in keys}
    blind = sum(grid.rows[k, "icp"].get("blind_starts", 0) for k in keys)
    how = f"{sum(lost.values())} lost {_worst(lost)}; {blind} of them flagged as unobserved"
    yield _said("icp loses no start at every 3rd scan", not any(lost.values()), how)


def _divergence(grid: Grid) -> Iterator[str]:
    for method in ("loam-odom", "lego-loam"):
        drift = {
            k: r["origin"] / r["length"] if r["status"] == "done" else np.inf
            for (k, m), r in grid.rows.items()
            if m == method and k[0].partition("@")[0] not in ON_FOOT_OR_WING
        }
        yield _all_within(f"{method}: rmse from the same start over the length, on vehicles", drift, 0.1)
    failed = [f"{k[0]} {k[1]} {m}" for (k, m), r in grid.rows.items() if "climbing" in k[0] and r["status"] != "done"]
    yield _said("the climb does not fail", not failed, ", ".join(failed))


def _few_beams(grid: Grid) -> Iterator[str]:
    for lidar in ("vlp16", "os1-16"):
        ratios = {}
        for case, seed in grid.keys:
            name, _, its = case.partition(":")
            if its == lidar:
                few, many = grid.error((case, seed), "icp"), grid.error((f"{name}:hdl64", seed), "icp")
                ratios[case, seed] = _ratio(few, many, (case, seed))
        yield _all_within(f"icp with {lidar} within 2 x HDL-64E on the same path", ratios, 2.0)


def _thesis(grid: Grid) -> Iterator[str]:
    for column, preset in enumerate(("thesis-icp", "thesis-loam", "thesis-loam-map")):
        ratios = {}
        for (key, method), row in grid.rows.items():
            name = key[0].removesuffix("@full")
            if method == preset and name in THESIS:
                own = row["thesis_rmse"] if row["status"] == "done" else np.inf
                ratios[key] = own / THESIS[name][column]
        yield _all_within(f"{preset}: rmse over the thesis'", ratios, 1.0)


def _is_by_rotation(key: Key) -> bool:
    return key[0].startswith("kitti_raw")


def _ratio(a: float, b: float, key: Key) -> float:
    if np.isfinite(a) and not _is_by_rotation(key) and abs(a - b) < TIE_M:
        return 1.0
    return a / b if np.isfinite(b) else (np.nan if np.isnan(b) or np.isinf(a) else 0.0)


def _all_within(name: str, values: dict[Key, float], most: float) -> str:
    known = {k: v for k, v in values.items() if not np.isnan(v)}
    if not known:
        return f"  ?     {name}: no rows"
    over = [v for v in known.values() if v > most]
    return _said(name, not over, f"{len(over)} of {len(known)} over {most:g}; worst {_worst(known)}")


def _worst(values: dict[Key, float], count: int = 4) -> str:
    worst = sorted(values, key=lambda key: -values[key])[:count]
    return ", ".join(f"{k[0]}{'' if k[1] is None else f' {k[1]}'} {values[k]:.2f}" for k in worst)


def _said(name: str, is_met: bool, how: str) -> str:
    return f"  {'met ' if is_met else 'MISS'}  {name}: {how}"

"""Summary of a run on stdout."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lslam.core.printable import count_of, metres
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan_result import ScanResult, sum_stages
from lslam.evaluation.evaluate import shown_metrics
from lslam.maps.colour import ColourCounts
from lslam.reports.back_end import back_end_rows, before_and_after
from lslam.reports.facts import RunFacts, run_facts

if TYPE_CHECKING:
    from lslam.evaluation.metric import Evaluation

Grid = list[list[str]]


def localization_rows(record: RunRecord, evaluation: Evaluation | None) -> list[tuple[str, str]]:
    """Names and values on localisation for the summary; empty for a run without a prior map."""
    fixes = record.map_fixes
    if not fixes:
        return []
    held = [fix for fix in fixes if fix.is_binding]
    about = record.manifest.get("localization", {})
    start = about.get("start", {})
    shares = float(np.median([fix.inlier_share for fix in held]))
    moves = float(np.median([fix.innovation[0] for fix in held]))
    rows = [
        ("in the map", f"{about.get('map', '')}: it holds {len(held)} of {count_of(len(fixes), 'scan')}"),
        ("", f"{shares:.0%} of the points agree, odometry is corrected by {metres(moves)} m a scan (medians)"),
        ("start", f"found by {start.get('votes')} of {count_of(start.get('tried', 0), 'keyframe')} tried"),
    ]
    if evaluation is not None and evaluation.odometry is not None:
        rows.append(("", before_and_after(evaluation, evaluation.odometry, "localisation")))
    return rows


MOST_FAILURES = 5
FILES = (
    ("trajectory", "trajectory.tum"),
    ("in the map", "localization.csv"),
    ("map", "map.ply"),
    ("map", "map.pcd"),
    ("map", "map.las"),
    ("map", "map.laz"),
    ("evaluation", "evaluation.json"),
    ("report", "report.html"),
)


def summary(record: RunRecord, evaluation: Evaluation | None) -> str:
    """Lines of a name and a value, aligned, ending with a newline; every score with its recipe."""
    facts = run_facts(record)
    below = {_failure(failure) for failure in facts.failures[:MOST_FAILURES]}
    rows = [("status", facts.status), *(("", reason) for reason in facts.reasons if reason not in below)]
    rows += _scan_rows(facts)
    rows.append(("path", f"{facts.path_length:.1f} m in {facts.duration:.1f} s"))
    rows += imu_rows(record) + wheel_rows(record)
    rows += localization_rows(record, evaluation) + back_end_rows(record, evaluation)
    rows += refined_rows(record.manifest.get("refinement", {}))
    rows += _score_rows(record, evaluation)
    rows += _map_rows(record)
    rows += _time_rows(record, facts)
    if record.folder is not None:
        rows += [(name, str(record.folder / file)) for name, file in FILES if (record.folder / file).is_file()]
    lines = [f"{record.name}, {record.method}"] + [f"  {name:<12} {value}" for name, value in rows]
    return "\n".join(lines) + "\n"


def _scan_rows(facts: RunFacts) -> list[tuple[str, str]]:
    """Rows on scans: numbers by status, and the first failures."""
    parts = [f"{facts.registered} of {facts.scans} registered"]
    others = ((facts.standing, "standing"), (facts.bridged, "bridged"), (facts.skipped, "skipped"))
    parts += [f"{n} {word}" for n, word in others if n]
    if facts.degenerate:
        parts.append(f"{len(facts.degenerate)} degenerate")
    rows = [("scans", ", ".join(parts))]
    if facts.posed_by:
        rows.append(("posed by", facts.posed_by))
    shown = facts.failures[:MOST_FAILURES]
    rows += [("", _failure(failure)) for failure in shown]
    if len(facts.failures) > len(shown):
        rows.append(("", f"and {len(facts.failures) - len(shown)} more: see the report"))
    return rows


def imu_rows(record: RunRecord) -> list[tuple[str, str]]:
    """Names and values on the IMU's contribution; empty without an IMU."""
    imu = record.manifest.get("imu")
    if not imu:
        return []
    if imu.get("prior_error_m") is None:
        return [("imu", "used" if imu["used"] else "refused")]
    rows = [("imu", _prior_text(imu, "predicts"))]
    if imu.get("mean_iterations"):
        rows.append(("", f"{imu['mean_iterations']:.1f} iterations per scan; {_saving_text(imu)}"))
    if said := _calibration_text(imu):
        rows.append(("", said))
    return rows


def wheel_rows(record: RunRecord) -> list[tuple[str, str]]:
    """Names and values on the contribution of the wheels; empty without wheels."""
    wheels = record.manifest.get("wheels")
    if not wheels:
        return []
    if wheels["prior_error_m"] is None:
        return [
            ("wheels", f"{'' if wheels['used'] else 'not '}used; no scan with surfaces along the way told their scale")
        ]
    parts = [f"scale {wheels['scale']:.4f} ({wheels['scale_sigma']:.4f})"]
    parts += [f"slip in {count_of(wheels['scans_with_slip'], 'scan')}"] if wheels["scans_with_slip"] else []
    return [("wheels", _prior_text(wheels, "they predict")), ("", ", ".join(parts))]


def _prior_text(facts: dict[str, Any], predict: str) -> str:
    """Whether a sensor was used, and the errors of its motion prior."""
    used = "used" if facts["used"] else "refused on the way"
    own, steady = metres(facts["prior_error_m"]), metres(facts["constant_velocity_error_m"])
    return f"{used}; {predict} scans to {own} m, constant velocity to {steady} m (medians, turns at 10 m)"


def _calibration_text(imu: dict[str, Any]) -> str:
    """Estimated clock offset and mounting of the IMU, in words; empty where none was estimated.

    >>> _calibration_text({"time_offset_s": -0.0203, "time_offset_sigma_s": 0.0004})
    'IMU 20.3 ms late (0.4)'
    """
    parts = []
    if "time_offset_sigma_s" in imu:
        offset = 1e3 * imu["time_offset_s"]
        parts.append(
            f"{abs(offset):.1f} ms {'late' if offset < 0 else 'early'} ({1e3 * imu['time_offset_sigma_s']:.1f})"
        )
    if "mounting_deg" in imu:
        angle = sum(v * v for v in imu["mounting_deg"]) ** 0.5
        parts.append(f"turned by {angle:.1f} deg ({imu['mounting_sigma_deg']:.1f} about the least certain axis)")
    return "IMU " + ", ".join(parts) if parts else ""


def _saving_text(imu: dict[str, Any]) -> str:
    """Sentence comparing iterations and time with and without the IMU's prior, on a sample of the scans."""
    if not imu.get("compared_scans"):
        return "lslam compare --imu both tells what that saves"
    saved = imu["saved_ms_per_scan"]
    what = "saved" if saved >= 0 else "lost"
    return (
        f"on {count_of(imu['compared_scans'], 'scan')} {imu['compared_iterations']:.1f} of the "
        f"{imu['constant_velocity_iterations']:.1f} that constant velocity takes on the same map, "
        f"{abs(saved):.1f} ms per scan {what} with the IMU's own work counted"
    )


def _failure(failure: ScanResult) -> str:
    """Text about a scan that was not registered."""
    return f"scan {failure.index} {failure.status}: {failure.reason or 'reason not given'}"


def _score_rows(record: RunRecord, evaluation: Evaluation | None) -> list[tuple[str, str]]:
    """Rows with the errors against ground truth, or with the reason why there are none."""
    if evaluation is None:
        why = "ground truth could not be compared" if record.ground_truth is not None else "no ground truth is known"
        return [("errors", f"not stated: {why}")]
    return [row for metric in shown_metrics(evaluation) for row in metric.summary(evaluation)]


def refined_rows(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and value on what `--refine` did, by the `refinement` of a manifest; empty without it."""
    if not facts:
        return []
    if not facts["is_taken"]:
        return [("refined", f"no scan: {facts['why']}")]
    thickness = f"planes of the points kept out {facts['thickness_mm']} mm thick, {facts['thickness_before_mm']} before"
    moved = f"poses moved {facts['moved_rms_m']} m rms, {facts['moved_most_m']} m at most"
    return [("refined", f"{count_of(facts['scans'], 'scan')}: {thickness}; {moved}")]


def _map_rows(record: RunRecord) -> list[tuple[str, str]]:
    """Names and values on the map's colours, and on its entropy, which compares methods without ground truth."""
    score, colour = record.crispness, record.manifest.get("map_colour")
    rows = [] if colour is None else [("colour", str(ColourCounts(**colour)))]
    if score is None or score.entropy is None or score.plane_variance is None:
        return rows
    thickness = f"planes {metres(score.plane_variance**0.5)} m thick (root of the mean plane variance)"
    said = f"map entropy {score.entropy:.3f}, {thickness}, within {score.radius:g} m; lower is crisper"
    return [*rows, ("crispness", said)]


def _time_rows(record: RunRecord, facts: RunFacts) -> list[tuple[str, str]]:
    """Rows on time: per scan and stage, ms, real-time factor, and back end, s."""
    if facts.total is None:
        return [("time", "no stage was timed")]
    total = facts.total
    text = f"{1e3 * total.median:.1f} ms per scan (median), p95 {1e3 * total.p95:.1f}, max {1e3 * total.max:.1f}: "
    text += ", ".join(f"{name} {1e3 * stage.median:.1f}" for name, stage in facts.stages.items())
    rows = [("time", text)]
    if facts.real_time_factor:
        text = f"{facts.real_time_factor:.1f} times as fast as the sensor; {facts.over_limit} of {facts.scans} scans over the "
        rows.append(("real time", f"{text}limit of {1e3 * record.real_time_limit:.0f} ms"))
    if later := sum_stages(record.back_end_seconds.values()):
        each = ", ".join(f"{name} {s:.2f}" for name, s in later.items())
        rows.append(("back end", f"{sum(later.values()):.1f} s on {len(record.keyframe_scans)} keyframes: {each}"))
    return rows


def markdown(grid: Grid, names: int = 1) -> str:
    """Markdown table; the first `names` columns are aligned left, the others right."""
    head, *body = [[cell.strip().replace("|", "\\|") for cell in row] for row in grid]
    rule = ["---"] * names + ["---:"] * (len(head) - names)
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, rule, *body])


def csv_table(grid: Grid, _: int = 1) -> str:
    """CSV table for spreadsheets."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([[cell.strip() for cell in row] for row in grid])
    return out.getvalue().rstrip("\n")


def latex(grid: Grid, names: int = 1) -> str:
    """LaTeX tabular that needs no package."""
    head, *body = [" & ".join(_escape(cell) for cell in row) + r" \\" for row in grid]
    columns = "l" * names + "r" * (len(grid[0]) - names)
    return "\n".join(
        [rf"\begin{{tabular}}{{{columns}}}", r"\hline", head, r"\hline", *body, r"\hline", r"\end{tabular}"]
    )


def text_table(grid: Grid, names: int = 1) -> str:
    """Table of columns of equal width, two spaces between them."""
    widths = [max(len(cell) for cell in column) for column in zip(*grid, strict=True)]
    return "\n".join(
        "  ".join(
            f"{c:<{w}}" if k < names else f"{c:>{w}}" for k, (c, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in grid
    )


def _escape(cell: str) -> str:
    """Text of a cell with LaTeX's special characters escaped."""
    signs = {sign: f"\\{sign}" for sign in "&%$#_{}"} | {"\\": "\\textbackslash{}"}
    cell = cell.translate({ord(sign): word for sign, word in signs.items()})
    return cell.strip().replace("±", "$\\pm$")

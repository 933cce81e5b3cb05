"""Rows of a study of known truth, for reports to be written from."""

from __future__ import annotations

from dataclasses import replace

from lslam.core.types.study import StudyRow

SKIP, SHARE = "input.skip_frames", "preprocess.random_share"


def row(value: float, seed: int, method: str, uses_imu: bool = False, **more: object) -> StudyRow:
    """Error 0.5 m, 2 deg and 100 ms per scan in two stages at any value, total time 40 / value."""
    plain = StudyRow(
        f"{method}-{uses_imu}-{value}-{seed}", "skip", "open", seed, method, uses_imu, {SKIP: value}, status="done",
        thesis_rmse=0.5, metric="thesis_rmse", angular_rmse_deg=2.0, scans=100,
        stages_ms={"read": 5.0, "scan": 60.0, "map": 40.0}, total_time_s=40.0 / value, fallback_share=0.125,
    )  # fmt: skip
    return replace(plain, **more)  # type: ignore[arg-type]


def study_rows() -> list[StudyRow]:
    """Two methods over 8 values and 2 seeds, the first lost from 6 on; one run failed, one lies beside."""
    out = []
    for value in range(1, 9):
        for seed in (0, 1):
            lost = {"status": "diverged", "reason": "lost <the> motion"} if value > 5 else {}
            out += [row(value, seed, "icp", **lost), row(value, seed, "loam", uses_imu=True)]
    out.append(row(9, 0, "loam", uses_imu=True, status="crashed", reason="killed & gone_by 100%"))
    return [*out, row(1, 0, "kiss-icp", parameters={}, is_beside=True, thesis_rmse=0.25)]

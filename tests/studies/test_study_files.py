"""The studies that ship: Girolimetto's chapter 5.3, each as package data and as a copy to start from."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from lslam.core.config.study import Kind
from lslam.core.errors import UsageError
from lslam.studies.jobs import ExpandedStudy
from lslam.studies.options import OutputOptions, find_study, study_names
from lslam.studies.study_runs import Sweep, expand_study

ROOT = Path(__file__).resolve().parents[2]
# Points of each study x (without and with the IMU), beside ones aside.
RUNS = {
    "grid-step": 15 * 2, "inlier-distance": 10 * 4, "inlier-ratio": 10, "map-voxel": 15 * 2, "planar-points": 20 * 2,
    "share": 10 * 2, "share-skip": 4 * 4, "skip-frames": 20 * 2 * 2,
}  # fmt: skip


def expanded(name: str) -> ExpandedStudy:
    return expand_study(Sweep(find_study(name), OutputOptions(Path("out"))))


@pytest.mark.parametrize("name", RUNS)
def test_each_study_has_its_runs_on_the_open_flight_and_the_defaults_beside(name: str) -> None:
    found = expanded(name)
    studied = [job for job in found.jobs if not found.variants[job.method].is_beside]
    assert len(studied) == 3 * RUNS[name]
    assert len(found.jobs) > len(studied)
    assert len({job.digest for job in found.jobs}) == len(found.jobs)
    for job in found.jobs:
        assert job.scene is not None
        assert (job.scene.scenario, job.scene.columns, job.config.map.write) == ("open", None, False)
        assert bool(job.config.odometry.preset) is not found.variants[job.method].is_beside


def test_every_study_states_what_the_thesis_found() -> None:
    assert study_names() == tuple(sorted(RUNS))
    for name in study_names():
        study = find_study(name)
        assert study.summary.startswith("Girolimetto, 5.3.")
        assert study.finding
        assert all(finding.source.startswith("Girolimetto") for finding in study.finding)


def test_the_studies_have_an_example_of_every_kind_of_finding() -> None:
    used = {finding.kind for name in study_names() for finding in find_study(name).finding}
    assert used == set(get_args(Kind))


def test_copies_to_start_from_are_the_same() -> None:
    for name in study_names():
        shipped = ROOT / "lslam" / "studies" / "ready" / f"{name}.toml"
        assert (ROOT / "sample_data" / "studies" / f"{name}.toml").read_bytes() == shipped.read_bytes()


def test_a_name_that_is_nothing_is_answered_with_the_nearest() -> None:
    with pytest.raises(UsageError, match="did you mean 'skip-frames'"):
        find_study("skip-frame")

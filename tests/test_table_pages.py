"""The tables of a run are described with exactly the columns that are written, and its folder knows them."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pages import Page, page

from lslam.backend.manual import write_control
from lslam.core.types.building import KeyframeMatch, OsmMatches
from lslam.pipeline.merged_folder import COLUMNS
from lslam.pipeline.outputs import (
    imu_states_text,
    timing_text,
    write_localization,
    write_loops,
    write_osm_matches,
    write_scans,
)
from lslam.pipeline.run_folder import OURS

SECTION = page("docs/conventions.md").text.split("\n## Tables of a run\n")[1].split("\n## ")[0]
SECTIONS = {
    text.split("`")[1]: [name for row in Page("", text).rows() for name in re.findall(r"`([^`]+)`", row[0])]
    for text in SECTION.split("\n### ")[1:]
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """The columns of each table, of a run of no scans."""
    folder = tmp_path_factory.mktemp("tables")
    run: Any = SimpleNamespace(path=folder, write_text=lambda name, text: (folder / name).write_text(text))
    record: Any = SimpleNamespace(results=[], back_end_seconds={}, method="icp", map_fixes=[], georeference=None)
    nothing = np.zeros(0)
    write_scans(run, record)
    write_localization(run, record)
    write_control(folder / "control.csv", [])
    write_loops(folder / "loops.csv", [], [])
    write_osm_matches(folder / "osm_matches.csv", OsmMatches(nothing, (), nothing, nothing, (), ()), [], nothing)
    (folder / "timing.csv").write_text(timing_text([0], [0], ["STAGE"], np.ones((1, 1)), {0: {"STAGE": 1.0}}, {0: 1.0}))
    (folder / "sessions.csv").write_text(COLUMNS)
    found = {path.name: path.read_text().splitlines()[0].split(",") for path in folder.iterdir()}
    names = imu_states_text([]).strip().split(",")
    sigmas = [name for name in names if name.endswith("_sigma")]
    assert [name.removesuffix("_sigma") for name in sigmas] == [name for name in names[2:] if name not in sigmas]
    return found | {"imu_states.csv": [name for name in names if name not in sigmas] + ["NAME_sigma"]}


@pytest.mark.parametrize("name", SECTIONS)
def test_every_column_is_described_in_its_order(name: str, written: dict[str, list[str]]) -> None:
    assert SECTIONS[name] == written[name]


def test_every_table_is_described_and_goes_with_its_run(written: dict[str, list[str]]) -> None:
    assert set(SECTIONS) == set(written) == {name for name in OURS if name.endswith(".csv")}


def test_a_lengths_and_angles_unit_is_that_of_its_name() -> None:
    units = {"_m": "m", "_deg": "deg", "_s": "s", "_ns": "ns", "_norm": ""}
    for row in Page("", SECTION).rows():
        names, said = re.findall(r"`([^`]+)`", row[0]), row[1].split(",")
        if row[1] in ("0, 1", "unit"):
            continue
        for k, name in enumerate(names):
            ending = next((ending for ending in units if name.endswith(ending)), None)
            if ending is not None:
                assert said[min(k, len(said) - 1)].strip() == units[ending], name


def test_matches_name_the_scans_of_the_recording(tmp_path: Path) -> None:
    """As loops.csv does: of a part of it, numbers begin where the part does."""
    zero = np.zeros(3)
    match = KeyframeMatch(
        1, np.zeros((0, 2, 2)), np.zeros((0, 2)), zero, zero, zero, np.zeros((3, 3)), reason="no wall"
    )
    nothing = np.zeros(0)
    matches = OsmMatches(zero, (), nothing, nothing, (match,), ())
    write_osm_matches(tmp_path / "m.csv", matches, [300, 306], np.zeros((2, 3)))
    assert (tmp_path / "m.csv").read_text().splitlines()[1].startswith("1,306,,rejected,none,0,0,")

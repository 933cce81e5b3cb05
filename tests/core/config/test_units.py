"""Units of configuration keys: those that their names and the register of constants say, and none that is missed."""

from __future__ import annotations

import re

import pytest
from pages import page

from lslam.core.config.config import Config, unit_of

KEYS = {
    f"{section}.{key}": field.description or ""
    for section, inner in Config.model_fields.items()
    for key, field in inner.annotation.model_fields.items()  # type: ignore[union-attr]
}
OF_NAMES = {"_deg": "deg", "_m": "m", "_s": "s", "_percent": "%", "_deg_per_100m": "deg/100 m"}


@pytest.mark.parametrize(("ending", "unit"), OF_NAMES.items())
def test_a_unit_in_the_name_is_that_of_the_description(ending: str, unit: str) -> None:
    named = {key: unit_of(key) for key in KEYS if key.endswith(ending)}
    assert named
    assert named.pop("loops.drift_deg", "deg/100 m") == "deg/100 m"  # whose name leaves the way out
    assert set(named.values()) == {unit}


def test_the_register_of_constants_has_the_same_units() -> None:
    rows = [row for row in page("docs/algorithms.md").rows() if len(row) == 5 and row[0].strip("`") in KEYS]
    assert len(rows) > 55
    assert {row[0]: row[2] for row in rows} == {row[0]: unit_of(row[0].strip("`")) for row in rows}


def test_no_description_begins_with_a_unit_that_is_not_read() -> None:
    missed = [key for key, words in KEYS.items() if re.match(r"(%|m|m2|s|deg|rad|\w+/\w+)(\W|$)", words)]
    assert [key for key in missed if not unit_of(key)] == []
    assert unit_of("map.nothing") == unit_of("nothing.voxel") == unit_of("") == ""

"""buildings.geojson: what a run found reads back, maps and our own reader understand it, broken files are said to be broken."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from osm_builders import ORIGIN, square_at

from lslam.core.errors import InputError, OutputError
from lslam.core.types.building import Building, BuildingCorrection, CorrectedMap, Footprint
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.formats.osm_data import ATTRIBUTION
from lslam.osm.buildings_geojson import read_buildings_geojson, write_buildings_geojson

YES = {"building": "yes"}


def found() -> CorrectedMap:
    skew = Footprint(np.array([[0.0, 0], [12, 1], [11, 9], [3, 8]]))
    shed = Footprint(square_at(-20, 4, 6))
    court = Footprint(square_at(30, 0, 20), (square_at(35, 5, 8)[::-1],))
    buildings = (
        BuildingCorrection(
            Building("way/12", (skew,), 7.5, tags={"building": "house", "name": "Bäckerei"}),
            np.array([0.8, -1.2, 0.04]), np.diag([0.01, 0.02, 1e-4]), "seen", 7, 1,
        ),
        BuildingCorrection(
            Building("relation/5", (court, Footprint(square_at(60, 3, 5))), tags=YES),
            np.array([0.5, 0.2, 0.0]), np.eye(3), "unseen",
        ),
        BuildingCorrection(Building("way/-3", (shed,), tags=YES), np.zeros(3), np.eye(3), "absent", 0, 4),
    )  # fmt: skip
    new = np.array([[[0.0, 20], [8, 21]], [[5, 30], [5, 40]]])
    return CorrectedMap(ORIGIN, buildings, "two-level", np.array([0.5, 0.25]), new, ((0, 2),), ATTRIBUTION)


def test_everything_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "buildings.geojson"
    write_buildings_geojson(path, found())
    back, was = read_buildings_geojson(path), found()
    np.testing.assert_array_equal(back.origin, was.origin)
    assert (back.mode, back.overlaps, back.attribution) == (was.mode, was.overlaps, was.attribution)
    np.testing.assert_allclose(back.shift, was.shift)
    np.testing.assert_allclose(back.new_walls, was.new_walls, atol=0.012)
    for one, other in zip(back.buildings, was.buildings, strict=True):
        assert (one.status, one.used_matches, one.rejected_matches) == (
            other.status,
            other.used_matches,
            other.rejected_matches,
        )
        np.testing.assert_allclose(one.displacement, other.displacement, atol=1e-4)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-5)
        assert one.confidence == pytest.approx(other.confidence, abs=1e-4)
        mine, theirs = one.building, other.building
        assert (mine.osm_id, mine.height, mine.tags) == (theirs.osm_id, theirs.height, dict(theirs.tags))
        for a, b in zip(mine.footprints, theirs.footprints, strict=True):
            for ring, expected in zip(a.rings, b.rings, strict=True):
                np.testing.assert_allclose(ring, expected, atol=0.015)


def test_a_gis_sees_corrected_outlines_with_the_attribution(tmp_path: Path) -> None:
    path = tmp_path / "buildings.geojson"
    write_buildings_geojson(path, found())
    tree = json.loads(path.read_text())
    assert "OpenStreetMap contributors, ODbL 1.0" in tree["attribution"]
    assert [f["properties"]["status"] for f in tree["features"]] == ["seen", "unseen", "absent", "new", "new"]
    overlaps = {
        f["properties"]["@id"]: f["properties"]["overlaps"] for f in tree["features"] if "@id" in f["properties"]
    }
    for i, j in found().overlaps:
        one, other = (found().buildings[k].building.osm_id for k in (i, j))
        assert other in overlaps[one], "each names the other"
        assert one in overlaps[other]
    extract = read_buildings(path, ORIGIN)[1]
    assert [b.osm_id for b in extract.buildings] == ["way/12", "way/-3", "relation/5"]
    np.testing.assert_allclose(
        extract.buildings[0].footprints[0].outer, found().buildings[0].real_building.footprints[0].outer, atol=0.012
    )
    write_buildings_geojson(path, replace(found(), attribution=None))
    assert read_buildings_geojson(path).attribution is None


def test_confidence_is_the_share_of_draws_that_lie_near() -> None:
    covariance = np.array([[0.3, 0.1, 0], [0.1, 0.2, 0], [0, 0, 1e-3]])
    correction = BuildingCorrection(
        Building("way/1", (Footprint(square_at(0, 0, 5)),)), np.zeros(3), covariance, "seen"
    )
    _, axes = np.linalg.eigh(covariance[:2, :2])
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(2), covariance[:2, :2], 200_000) @ axes
    assert correction.confidence == pytest.approx((np.abs(draws) < 0.5).all(axis=1).mean(), abs=0.005)


@pytest.mark.parametrize(
    "text", ["", "{}", '{"schema": "other"}', '{"schema": "lslam-buildings-1", "features": 3}', "[1]"]
)
def test_other_files_are_errors_with_a_reason(tmp_path: Path, text: str) -> None:
    path = tmp_path / "buildings.geojson"
    path.write_text(text)
    with pytest.raises(InputError, match=r"buildings\.geojson is no buildings\.geojson of a run"):
        read_buildings_geojson(path)


def test_files_that_cannot_be_opened_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.geojson cannot be read"):
        read_buildings_geojson(tmp_path / "none.geojson")
    with pytest.raises(OutputError, match="cannot be written"):
        write_buildings_geojson(tmp_path / "none" / "buildings.geojson", found())

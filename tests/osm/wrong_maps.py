"""Every mode of the map on sample_data with maps that are wrong in a known way, under odometry that walks at random."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from building_errors import map_errors
from numpy.typing import NDArray

import lslam
from lslam.core.config.config import load_config
from lslam.core.geometry import geodesy, se2
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.formats.osm_files import write_osm
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.osm.buildings_geojson import read_buildings_geojson
from lslam.simulation.osm_extract import Change, Perturbation, osm_from_buildings, perturb

Floats = NDArray[np.float64]

DRIVE = Path(__file__).parents[2] / "sample_data" / "sequences" / "00"
MODES = ("prior", "rigid", "non-rigid", "two-level")
# m; of the map as a whole, of each of its houses, and of the start that is given.
SHIFT, DRAWN, OFF = (1.5, -1.0), 0.7, (0.6, -0.4)


@dataclass(frozen=True)
class Found:
    """Mean error of positions on the Earth, m; median error of the buildings seen, m; positions (N, 2), m, of one drift."""

    trajectory: float
    buildings: float
    places: Floats


def on(
    folder: Path,
    name: str,
    off: tuple[float, float] = (0.0, 0.0),
    radius: float = 0.3,
    drifts: Sequence[int] = (0,),
    more: Sequence[str] = (),
) -> dict[str, list[Found]]:
    """Every mode on one map, one run per drift, with `more` settings.

    off : m from the true start the run is said to begin, within `radius` m
    """
    world = tomllib.loads((DRIVE / "truth" / "world.toml").read_text())
    origin = np.array(world["origin_lat_lon_alt"])
    real = np.array(world["T_enu_world"]) @ read_trajectory(DRIVE / "truth" / "trajectory.tum").poses
    exact = read_buildings(DRIVE / "map.osm", origin)[1].buildings
    rng = np.random.default_rng(5)
    drawn = [tuple(rng.normal(0, DRAWN, 2).tolist()) if name == "houses" else (0.0, 0.0) for _ in exact]
    changes = tuple(Change(b.osm_id, shift_m=shift) for b, shift in zip(exact, drawn, strict=True))
    wrong = Perturbation(SHIFT if name == "shifted" else (0.0, 0.0), changes, ())
    write_osm(folder / "map.osm", osm_from_buildings(perturb(exact, wrong), origin, None))
    truth = map_errors(exact, wrong)
    start = real[0, :3, 3] + [*off, 0.0]
    settings = [
        "loops.use=false", "map.write=false", "report.html=false", "debug.drift=true", "debug.drift_kind=random-walk",
        f"osm.extract={folder / 'map.osm'}", f"osm.origin={geodesy.from_local(start[None], origin)[0].tolist()}",
        f"osm.heading_deg={90 - np.degrees(se2.of_se3(real[0])[2])}", f"osm.start_radius={radius}",
        "osm.hold_start=true", *more,
    ]  # fmt: skip

    def run(mode: str, drift: int) -> Found:
        out = folder / f"{mode}-{drift}"
        config = load_config(settings=[*settings, f"osm.mode={mode}", f"debug.drift_seed={drift}"])
        lslam.run(str(DRIVE), config, out=out)
        corrected = read_buildings_geojson(out / "buildings.geojson")
        poses = read_trajectory(out / "trajectory.tum").poses
        places = geodesy.to_local(geodesy.from_local(poses[:, :3, 3], corrected.origin), origin)[:, :2]
        away = [
            np.linalg.norm(c.displacement[:2] - truth[c.building.osm_id][:2])
            for c in corrected.buildings
            if c.status == "seen"
        ]
        assert len(away) > 10
        assert json.loads((out / "manifest.json").read_text())["status"] != "failed"
        return Found(
            float(np.linalg.norm(places - real[: len(places), :2, 3], axis=1).mean()), float(np.median(away)), places
        )

    return {mode: [run(mode, drift) for drift in drifts] for mode in MODES}

"""`lslam simulate`: a drive through a generated or mapped town, with exact ground truth, in KITTI's layout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import console, options

if TYPE_CHECKING:
    from lslam.core.arrays import Floats
    from lslam.simulation.city import City
    from lslam.simulation.scenarios import SimulatedDrive
    from lslam.simulation.scene_mesh import RayScene


@click.command(epilog="Example: lslam simulate block --out town && lslam run town")
@click.argument("scenario", required=False)
@options.path("--out", "DIR", "Folder to write; must not exist.")
@options.integer("--seed", "N", "Seed of the town, the drive and the noise.", default=0, show_default=True)
@options.option("--lidar", "NAME", "The sensor; see --list.")
@options.integer("--scans", "--count", "count", "N", "Number of scans [default: one lap, or the whole street].")
@options.real("--speed", "M/S", "Cruising speed; bends may need less.")
@click.option(
    "--distorted/--compensated",
    "motion_in_scans",
    default=None,
    help="Cast the rays while the sensor moves, with per-point times, or all from one pose [default: the scenario's].",
)
@options.path(
    "--path",
    "path_file",
    "FILE",
    "Drive along way-points (.toml, .csv, .geojson) or a trajectory's shape [SCENARIO then is residential].",
)
@options.path(
    "--osm",
    "FILE",
    "Build the city of an OpenStreetMap extract (.osm or Overpass JSON) and drive along --path, else its streets.",
)
@options.option(
    "--origin",
    "LAT,LON[,H]",
    "Where x = y = 0 of the city lies [default: the extract's middle, or a GeoJSON path's first point].",
)
@options.settings("KEY=VALUE", "Set one key of the scenario, for example world.relief=1; repeatable.")
@options.path("--plan", "FILE.png", "Draw the scene from above with a metric grid, a scale and a legend.")
@click.option("--imu/--no-imu", default=True, show_default=True, help="Record an ICM-20948 at 100 Hz.")
@options.option("--imu-model", "NAME", "Another IMU; see --list.", default="icm20948", show_default=True)
@options.real("--gnss-rate", "HZ", "Satellite fixes, 1 to 10; 0: none.", default=1.0, show_default=True)
@options.option("--gnss-outage", "FROM TO", "Seconds without fixes; repeatable.", type=(float, float), multiple=True)
@click.option(
    "--wheels/--no-wheels", default=True, show_default=True, help="Record speed and yaw rate of a car's wheels."
)
@options.integer("--visit", "N", "Drive there again, N-th time: other traffic and noise, the same town.", default=0)
@options.flag("--reverse", "Drive in the opposite direction, on the other lane.")
@options.real("--from", "shift", "M", "Begin so far along the line.", default=0.0)
@options.real("--static-start", "S", "Stay at the start for S seconds first.", default=0.0)
@options.flag("--labels", "with_labels", "Write the class of every point, as SemanticKITTI has it.")
@options.flag("--camera", "with_camera", "Record a camera that looks ahead, one image a scan.")
@options.flag("--overwrite", "Replace sequences/00 and poses/00.txt in an existing folder.")
@options.flag("--resume", "Continue an interrupted simulation.")
@options.flag("--show", "Print SCENARIO with all its keys as TOML.")
@options.flag("--list", "show_list", "List scenarios and sensors.")
@options.as_json
@options.verbosity
def command(scenario: str | None, out: Path | None, plan: Path | None, osm: Path | None, **given: Any) -> None:
    """Simulate a drive or a flight with exact ground truth; SCENARIO is a name of --list, or a .toml file.

    With --plan the scene is drawn, and recorded only with --out as well. With --osm and without --path the whole extract is
    drawn. Further LiDARs of a vehicle are the scenario's `lidars`, see `lslam simulate two-lidars --show`.
    """
    as_json, path_file, settings = given["as_json"], given["path_file"], given["settings"]
    if given["show_list"]:
        _print_list(as_json)
        return
    if scenario is None and (path_file is not None or osm is not None):
        scenario = "residential"
    if given["show"] and scenario is not None:
        _print_scenario(scenario, settings, as_json)
        return
    if scenario is None or (out is None and plan is None):
        missing = "SCENARIO" if scenario is None else "--out DIR"
        raise click.UsageError(f"{missing} is missing; for example: lslam simulate block --out town")
    if given["overwrite"] and given["resume"]:
        raise click.UsageError("--overwrite begins anew and --resume goes on: give one of them")
    if plan is not None and plan.suffix.lower() != ".png":
        raise click.UsageError(f"--plan {plan}: the scene is drawn as PNG, name a file FILE.png")
    console.setup_logging(given["verbose"], given["quiet"])
    from lslam.simulation import check_target

    if out is not None:
        check_target(out, given["overwrite"], given["resume"])
    example = "LAT,LON or LAT,LON,HEIGHT, for example 49.0112,8.4229"
    origin = None if given["origin"] is None else options.numbers("--origin", given["origin"], (2, 3), example)
    from lslam.simulation.routes import Visit
    from lslam.simulation.scenarios import simulate
    from lslam.simulation.sensors import GnssModel, WheelModel

    if plan is not None and out is None and osm is not None and path_file is None:
        _print([_draw_map(scenario, given["seed"], settings, osm, origin, plan)], as_json)
        return
    drive = simulate(
        scenario,
        **{name: given[name] for name in ("seed", "lidar", "count", "speed", "settings", "static_start")},
        motion_compensated=None if given["motion_in_scans"] is None else not given["motion_in_scans"],
        way_points=path_file,
        osm=osm,
        origin=origin,
        imu=given["imu_model"] if given["imu"] else None,
        gnss=GnssModel(given["gnss_rate"], outages=given["gnss_outage"]) if given["gnss_rate"] else None,
        wheels=WheelModel() if given["wheels"] else None,
        visit=Visit(given["visit"], given["reverse"], given["shift"]),
    )
    results = []
    if plan is not None:
        results.append(_write_plan(plan, drive.scene, drive.city, drive.city_poses[:, :3, 3]))
    if out is not None:
        how = {name: given[name] for name in ("overwrite", "resume", "with_labels", "with_camera")}
        results.append(record_drive(drive, out, **how))
    _print(results, as_json)


@dataclass(frozen=True)
class SimulationFile:
    """One thing that was written: a line for people, and the same as values by key for programs."""

    text: str
    values: dict[str, Any]


def _print(results: list[SimulationFile], as_json: bool) -> None:
    """Print what was written, as lines or as one JSON object."""
    if as_json:
        console.show_json({key: value for one in results for key, value in one.values.items()})
    else:
        console.show("".join(f"{one.text}\n" for one in results))


def _draw_map(
    scenario: str, seed: int, settings: tuple[str, ...], osm: Path, origin: list[float] | None, plan: Path
) -> SimulationFile:
    """Draw the whole extract, with the street of the drive when there is one."""
    from lslam.simulation.built_scenario import whole_map
    from lslam.simulation.osm_place import read_extract
    from lslam.simulation.scenario_files import find_scenario
    from lslam.simulation.scenarios import checked_origin
    from lslam.simulation.scene_mesh import RayScene

    extract = read_extract(osm, None if origin is None else checked_origin(origin))
    city, line = whole_map(find_scenario(scenario, settings), seed, extract)
    return _write_plan(plan, RayScene(city.mesh), city, line)


def _write_plan(path: Path, scene: RayScene, city: City, line: Floats) -> SimulationFile:
    """Draw the plan of the world with the path to `path`."""
    from lslam.reports.plans import write_plan
    from lslam.simulation.plan import plan_of

    plan = plan_of(scene, city, line)
    write_plan(path, plan)
    width, depth = plan.high - plan.low
    text = f"{path}: {width:.0f} x {depth:.0f} m, a line every 10 m"
    return SimulationFile(text, {"plan": str(path), "plan_size_m": [float(width), float(depth)]})


def record_drive(
    drive: SimulatedDrive,
    out: Path,
    overwrite: bool,
    resume: bool = False,
    with_labels: bool = False,
    with_camera: bool = False,
) -> SimulationFile:
    """Record the drive in `out` with a progress bar, until a signal comes; arguments as of the command."""
    from lslam.core.stopping import handle_signals
    from lslam.simulation.record import record

    with handle_signals() as stop, console.progress("simulating", len(drive) * (1 + with_camera)) as advance:

        def on_scan(index: int) -> None:
            advance()
            stop.is_gentle = index + 1 < len(drive)  # a started scan is completed, so that --resume finds whole scans
            stop.check()

        def on_image(index: int) -> None:
            advance()
            stop.check()

        command, images = options.command_line(), on_image if with_camera else None
        recording = record(drive, out, overwrite, on_scan, resume, command, with_labels, images)
    assert drive.ground_truth is not None
    length = float(drive.ground_truth.path_lengths[-1])
    points, size = recording.points / len(drive), recording.size
    values = {"sequence": str(recording.sequence), "scans": len(drive), "path_length_m": length}
    text = (
        f"{recording.sequence}: {len(drive)} scans, {length:.1f} m, {points:.0f} points per scan, {size / 1e6:.1f} MB"
    )
    return SimulationFile(text, {**values, "points_per_scan": points, "bytes": size})


def _print_scenario(name: str, settings: tuple[str, ...], as_json: bool) -> None:
    """Print the scenario as TOML."""
    from lslam.simulation.scenario_files import find_scenario, scenario_text

    text = scenario_text(find_scenario(name, settings))
    if as_json:
        console.show_json({"scenario": name, "toml": text})
    else:
        console.show(text)


def _print_list(as_json: bool) -> None:
    """Print scenarios, LiDARs and IMUs."""
    from lslam.simulation.imu import IMUS
    from lslam.simulation.lidar_models import LIDARS
    from lslam.simulation.scenario_files import find_scenario, scenario_names

    scenarios = {name: find_scenario(name).summary for name in scenario_names()}
    if as_json:
        console.show_json({"scenarios": scenarios, "lidars": list(LIDARS), "imus": list(IMUS)})
        return
    lidars = {n: f"{lidar.rings} x {lidar.columns} rays, {lidar.range_max:g} m" for n, lidar in LIDARS.items()}
    imus = {n: f"{imu.rate_hz:g} Hz, {'without errors' if n == 'ideal' else 'MEMS'}" for n, imu in IMUS.items()}
    for kind, texts in (("scenario", scenarios), ("lidar", lidars), ("imu", imus)):
        console.show("".join(f"{kind:<9} {name:<16}  {text}\n" for name, text in texts.items()))

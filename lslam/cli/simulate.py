"""`lslam simulate`: a drive through a generated or mapped town, with exact ground truth, in KITTI's layout."""

from __future__ import annotations

import json
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import console, options

if TYPE_CHECKING:
    from lslam.simulation.plan import ScenePlan
    from lslam.simulation.scenarios import SimulatedDrive


@click.command(epilog="Example: lslam simulate block --out town && lslam run town")
@click.argument("scenario", required=False)
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder to write; must not exist.")
@click.option(
    "--seed", type=int, default=0, show_default=True, metavar="N", help="Seed of the town, the drive and the noise."
)
@click.option("--lidar", metavar="NAME", help="The sensor; see --list.")
@click.option(
    "--scans",
    "--count",
    "count",
    type=int,
    metavar="N",
    help="Number of scans [default: one lap, or the whole street].",
)
@click.option("--speed", type=float, metavar="M/S", help="Cruising speed; bends may need less.")
@click.option(
    "--distorted/--compensated",
    "distorted",
    default=None,
    help="Cast the rays while the sensor moves, with per-point times, or all from one pose [default: the scenario's].",
)
@click.option(
    "--path",
    "path_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Drive along way-points (.toml, .csv, .geojson) or a trajectory's shape [SCENARIO then is residential].",
)
@click.option(
    "--osm",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Build the city of an OpenStreetMap extract (.osm or Overpass JSON) and drive along --path, else its streets.",
)
@click.option(
    "--origin",
    metavar="LAT,LON[,H]",
    help="Where x = y = 0 of the city lies [default: the extract's middle, or a GeoJSON path's first point].",
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Set one key of the scenario, for example world.relief=1; repeatable.",
)
@click.option(
    "--plan",
    type=click.Path(path_type=Path),
    metavar="FILE.png",
    help="Draw the scene from above with a metric grid, a scale and a legend.",
)
@click.option("--imu/--no-imu", default=True, show_default=True, help="Record an ICM-20948 at 100 Hz.")
@click.option("--imu-model", metavar="NAME", default="icm20948", show_default=True, help="Another IMU; see --list.")
@click.option(
    "--gnss-rate", type=float, default=1.0, show_default=True, metavar="HZ", help="Satellite fixes, 1 to 10; 0: none."
)
@click.option(
    "--gnss-outage", type=(float, float), multiple=True, metavar="FROM TO", help="Seconds without fixes; repeatable."
)
@click.option(
    "--wheels/--no-wheels", default=True, show_default=True, help="Record speed and yaw rate of a car's wheels."
)
@click.option(
    "--visit",
    type=int,
    default=0,
    metavar="N",
    help="Drive there again, N-th time: other traffic and noise, the same town.",
)
@click.option("--reverse", is_flag=True, help="Drive in the opposite direction, on the other lane.")
@click.option("--from", "shift", type=float, default=0.0, metavar="M", help="Begin so far along the line.")
@click.option("--static-start", type=float, default=0.0, metavar="S", help="Stay at the start for S seconds first.")
@click.option("--labels", "has_labels", is_flag=True, help="Write the class of every point, as SemanticKITTI has it.")
@click.option("--camera", "is_filmed", is_flag=True, help="Record a camera that looks ahead, one image a scan.")
@click.option("--overwrite", is_flag=True, help="Replace sequences/00 and poses/00.txt in an existing folder.")
@click.option("--resume", is_flag=True, help="Continue an interrupted simulation.")
@click.option("--show", is_flag=True, help="Print SCENARIO with all its keys as TOML.")
@click.option("--list", "show_list", is_flag=True, help="List scenarios and sensors.")
@options.as_json
@options.verbosity
def command(
    scenario: str | None,
    out: Path | None,
    seed: int,
    lidar: str | None,
    count: int | None,
    speed: float | None,
    distorted: bool | None,
    path_file: Path | None,
    osm: Path | None,
    origin: str | None,
    settings: tuple[str, ...],
    plan: Path | None,
    imu: bool,
    imu_model: str,
    gnss_rate: float,
    gnss_outage: tuple[tuple[float, float], ...],
    wheels: bool,
    visit: int,
    reverse: bool,
    shift: float,
    static_start: float,
    has_labels: bool,
    is_filmed: bool,
    overwrite: bool,
    resume: bool,
    show: bool,
    show_list: bool,
    as_json: bool,
    verbose: bool,
    quiet: bool,
) -> None:
    """Simulate a drive or a flight with exact ground truth; SCENARIO is a name of --list, or a .toml file.

    With --plan the scene is drawn, and recorded only with --out as well. With --osm and without --path the whole extract is
    drawn. Further LiDARs of a vehicle are the scenario's `lidars`, see `lslam simulate two-lidars --show`.
    """
    if show_list:
        _print_list(as_json)
        return
    if scenario is None and (path_file is not None or osm is not None):
        scenario = "residential"
    if show and scenario is not None:
        _print_scenario(scenario, settings, as_json)
        return
    if scenario is None or (out is None and plan is None):
        missing = "SCENARIO" if scenario is None else "--out DIR"
        raise click.UsageError(f"{missing} is missing; for example: lslam simulate block --out town")
    if overwrite and resume:
        raise click.UsageError("--overwrite begins anew and --resume goes on: give one of them")
    if plan is not None and plan.suffix.lower() != ".png":
        raise click.UsageError(f"--plan {plan}: the scene is drawn as PNG, name a file FILE.png")
    console.setup_logging(verbose, quiet)
    from lslam.simulation import check_target

    if out is not None:
        check_target(out, overwrite, resume)
    at = None if origin is None else _numbers(origin)
    from lslam.simulation.routes import Visit
    from lslam.simulation.scenarios import simulate
    from lslam.simulation.sensors import GnssModel, WheelModel

    if plan is not None and out is None and osm is not None and path_file is None:
        _print([_draw_map(scenario, seed, settings, osm, at, plan)], as_json)
        return
    drive = simulate(
        scenario,
        seed=seed,
        lidar=lidar,
        count=count,
        speed=speed,
        motion_compensated=None if distorted is None else not distorted,
        settings=settings,
        way_points=path_file,
        osm=osm,
        origin=at,
        imu=imu_model if imu else None,
        gnss=GnssModel(gnss_rate, outages=gnss_outage) if gnss_rate else None,
        wheels=WheelModel() if wheels else None,
        static_start=static_start,
        visit=Visit(visit, reverse, shift),
    )
    written = []
    if plan is not None:
        written.append(_draw(drive, plan))
    if out is not None:
        written.append(record_drive(drive, out, overwrite, resume, has_labels, is_filmed))
    _print(written, as_json)


@dataclass(frozen=True)
class Written:
    """One thing that was written: a line for people, and the same as values by key for programs."""

    text: str
    values: dict[str, Any]


def _print(written: list[Written], as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps({key: value for one in written for key, value in one.values.items()}))
    else:
        click.echo("\n".join(one.text for one in written))


def _numbers(origin: str) -> list[float]:
    try:
        return [float(part) for part in origin.split(",")]
    except ValueError:
        raise click.UsageError(
            f"--origin {origin}: expected LAT,LON or LAT,LON,HEIGHT, for example 49.0112,8.4229"
        ) from None


def _draw(drive: SimulatedDrive, plan: Path) -> Written:
    from lslam.simulation.plan import plan_of

    return _write_plan(plan, plan_of(drive.scene, drive.city, drive.city_poses[:, :3, 3]))


def _draw_map(
    scenario: str, seed: int, settings: tuple[str, ...], osm: Path, origin: list[float] | None, plan: Path
) -> Written:
    """Draw the whole extract, with the street of the drive when there is one."""
    from lslam.simulation.built_scenario import whole_map
    from lslam.simulation.osm_place import read_extract
    from lslam.simulation.plan import plan_of
    from lslam.simulation.scenario_files import find_scenario
    from lslam.simulation.scenarios import checked_origin
    from lslam.simulation.scene_mesh import RayScene

    extract = read_extract(osm, None if origin is None else checked_origin(origin))
    city, line = whole_map(find_scenario(scenario, settings), seed, extract)
    return _write_plan(plan, plan_of(RayScene(city.mesh), city, line))


def _write_plan(path: Path, plan: ScenePlan) -> Written:
    from lslam.reports.plans import write_plan

    write_plan(path, plan)
    width, depth = plan.high - plan.low
    text = f"{path}: {width:.0f} x {depth:.0f} m, a line every 10 m"
    return Written(text, {"plan": str(path), "plan_size_m": [float(width), float(depth)]})


def record_drive(
    drive: SimulatedDrive,
    out: Path,
    overwrite: bool,
    resume: bool = False,
    has_labels: bool = False,
    is_filmed: bool = False,
) -> Written:
    """Record the drive in `out` with a progress bar, until a signal comes; arguments as of the command."""
    from lslam.core.stopping import handle_signals
    from lslam.simulation.record import record

    with handle_signals() as stop, console.progress("simulating", len(drive) * (1 + is_filmed)) as advance:

        def on_scan(index: int) -> None:
            advance()
            stop.is_gentle = index + 1 < len(drive)  # a started scan is completed, so that --resume finds whole scans
            stop.check()

        def on_image(index: int) -> None:
            advance()
            stop.check()

        command = shlex.join(["lslam", *sys.argv[1:]])
        done = record(drive, out, overwrite, on_scan, resume, command, has_labels, on_image if is_filmed else None)
    assert drive.ground_truth is not None
    length = float(drive.ground_truth.path_lengths[-1])
    return Written(
        f"{done.sequence}: {len(drive)} scans, {length:.1f} m, {done.points / len(drive):.0f} points per scan, "
        f"{done.size / 1e6:.1f} MB",
        {
            "sequence": str(done.sequence),
            "scans": len(drive),
            "path_length_m": length,
            "points_per_scan": done.points / len(drive),
            "bytes": done.size,
        },
    )


def _print_scenario(name: str, settings: tuple[str, ...], as_json: bool) -> None:
    from lslam.simulation.scenario_files import find_scenario, scenario_text

    text = scenario_text(find_scenario(name, settings))
    click.echo(json.dumps({"scenario": name, "toml": text}) + "\n" if as_json else text, nl=False)


def _print_list(as_json: bool) -> None:
    from lslam.simulation.imu import IMUS
    from lslam.simulation.lidar_models import LIDARS
    from lslam.simulation.scenario_files import find_scenario, scenario_names

    if as_json:
        names = {name: find_scenario(name).summary for name in scenario_names()}
        click.echo(json.dumps({"scenarios": names, "lidars": list(LIDARS), "imus": list(IMUS)}))
        return
    for name in scenario_names():
        click.echo(f"scenario  {name:<16}  {find_scenario(name).summary}")
    for name, model in LIDARS.items():
        click.echo(f"lidar     {name:<16}  {model.rings} x {model.columns} rays, {model.range_max:g} m")
    for name, imu in IMUS.items():
        click.echo(f"imu       {name:<16}  {imu.rate_hz:g} Hz, {'without errors' if name == 'ideal' else 'MEMS'}")

"""`lslam simulate`: a drive through a generated town, with exact ground truth, in KITTI's layout."""

from __future__ import annotations

from pathlib import Path

import click

from lslam.cli import console, options


@click.command(epilog="Example: lslam simulate block --out town && lslam run town")
@click.argument("scenario", required=False)
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="Folder to write; must not exist.")
@click.option(
    "--seed", type=int, default=0, show_default=True, metavar="N", help="Of the town, the drive and the noise."
)
@click.option("--lidar", metavar="NAME", help="The sensor; see --list.")
@click.option("--count", type=int, metavar="N", help="Number of scans [default: one lap, or the whole street].")
@click.option("--speed", type=float, metavar="M/S", help="Cruising speed; bends may need less.")
@click.option("--distorted", is_flag=True, help="Fire the rays while the sensor moves, with times per point.")
@click.option("--imu/--no-imu", default=True, show_default=True, help="Record an ICM-20948 at 100 Hz.")
@click.option("--imu-model", metavar="NAME", default="icm20948", show_default=True, help="Another IMU; see --list.")
@click.option(
    "--gnss-rate", type=float, default=1.0, show_default=True, metavar="HZ", help="Satellite fixes, 1 to 10; 0: none."
)
@click.option(
    "--gnss-outage", type=(float, float), multiple=True, metavar="FROM TO", help="Seconds without fixes; repeatable."
)
@click.option("--static-start", type=float, default=0.0, metavar="S", help="Stand still for S seconds first.")
@click.option("--overwrite", is_flag=True, help="Replace sequences/00 and poses/00.txt in an existing folder.")
@click.option("--list", "show_list", is_flag=True, help="List scenarios and sensors.")
@options.verbosity
def command(
    scenario: str | None,
    out: Path | None,
    seed: int,
    lidar: str | None,
    count: int | None,
    speed: float | None,
    distorted: bool,
    imu: bool,
    imu_model: str,
    gnss_rate: float,
    gnss_outage: tuple[tuple[float, float], ...],
    static_start: float,
    overwrite: bool,
    show_list: bool,
    verbose: bool,
    quiet: bool,
) -> None:
    """Simulate a drive with exact ground truth: SCENARIO is block or street."""
    if show_list:
        _print_list()
        return
    if scenario is None or out is None:
        missing = "SCENARIO" if scenario is None else "--out DIR"
        raise click.UsageError(f"{missing} is missing; for example: lslam simulate block --out town")
    console.setup_logging(verbose, quiet)
    from lslam.simulation.gnss import GnssModel
    from lslam.simulation.record import check_target, record
    from lslam.simulation.scenarios import simulate

    check_target(out, overwrite)
    drive = simulate(
        scenario,
        seed=seed,
        lidar=lidar,
        count=count,
        speed=speed,
        motion_compensated=not distorted,
        imu=imu_model if imu else None,
        gnss=GnssModel(gnss_rate, outages=gnss_outage) if gnss_rate else None,
        static_start=static_start,
    )
    with console.progress("simulating", len(drive)) as advance:
        done = record(drive, out, overwrite, on_scan=lambda _: advance())
    assert drive.ground_truth is not None
    click.echo(
        f"{done.sequence}: {len(drive)} scans, {drive.ground_truth.path_lengths[-1]:.1f} m, "
        f"{done.points / len(drive):.0f} points per scan, {done.size / 1e6:.1f} MB"
    )


def _print_list() -> None:
    from lslam.simulation.imu import IMUS
    from lslam.simulation.lidar_models import LIDARS
    from lslam.simulation.scenario_files import scenario_named, scenario_names

    for name in scenario_names():
        click.echo(f"scenario  {name:<11}  {scenario_named(name).summary}")
    for name, model in LIDARS.items():
        click.echo(f"lidar     {name:<11}  {model.rings} x {model.columns} rays, {model.range_max:g} m")
    for name, imu in IMUS.items():
        click.echo(f"imu       {name:<11}  {imu.rate_hz:g} Hz, {'without errors' if name == 'ideal' else 'MEMS'}")

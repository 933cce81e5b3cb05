"""Options that several commands share, written once."""

from __future__ import annotations

import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from lslam.core.errors import ConfigError, InputError, UsageError, nearest
from lslam.io.remote import RemotePath, as_path

if TYPE_CHECKING:
    from lslam.core.config.input import ScanRange
    from lslam.core.types.gnss import OutputCrs
    from lslam.studies.jobs import Engine
    from lslam.studies.output import OutputOptions

F = TypeVar("F", bound=Callable[..., Any])


class Place(click.Path):
    """Parameter type: a path, or a URL of storage."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Path of the value, as by `as_path`."""
        if isinstance(value, str) and "://" in value:
            return as_path(value)
        return super().convert(value, param, ctx)


# Of several commands.
data_root = click.option(
    "--data-root",
    type=click.Path(path_type=Path),
    envvar="LSLAM_DATA",
    metavar="DIR",
    help="Where names like seq07 are looked up [env: LSLAM_DATA].",
)
preset = click.option("--preset", metavar="NAME|FILE", help="Configuration to start from, see `lslam config presets`.")
as_json = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout.")
metrics = click.option(
    "--metrics", multiple=True, metavar="WORD", help="Show more metrics: thesis for those of the theses."
)
set_in_all_runs = click.option(
    "--set", "settings", multiple=True, metavar="SECTION.KEY=VALUE", help="Set one key in all runs; repeatable."
)
refine = click.option(
    "--refine", is_flag=True, help="Correct all scans at once for the planes they saw, where that makes them thinner."
)
fixes_as_factors = click.option(
    "--gnss", "gnss", flag_value="graph", default=None, help="Satellite fixes are factors of the pose graph."
)
fixes_at_the_end = click.option(
    "--georeference", "gnss", flag_value="fit", help="Satellite fixes only georeference the result."
)
truth = click.option(
    "--gt", type=click.Path(path_type=Path), metavar="FILE", help="Ground truth instead of the sequence's own."
)
moved_sequence = click.option(
    "--sequence", type=click.Path(path_type=Path), metavar="PATH", help="Sequence of the raw scans, when it has moved."
)
replaced = click.option("--overwrite", is_flag=True, help="Replace an earlier run in the folder.")
method = click.option("--method", metavar="NAME", help="Odometry method, see `lslam methods` [default: icp].")
poses = click.option(
    "--poses",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Trajectory of another program instead of odometry.",
)
imu = click.option("--imu/--no-imu", default=None, help="Predict and deskew with the IMU [default: no].")
wheels = click.option(
    "--wheels",
    metavar="TOPIC|FILE",
    help="Predict with speeds of wheels: a topic of the bag (Odometry, TwistStamped), or a CSV file beside the scans.",
)
resumed = click.option(
    "--resume", is_flag=True, help="Go on with a run that was killed or interrupted; needs its --out."
)
threads = click.option(
    "--threads", type=int, metavar="N", help="0: as many as there are cores; 1: one. Results stay the same."
)
dry_run = click.option("--dry-run", is_flag=True, help="Resolve everything, write nothing.")


def verbosity(function: F) -> F:
    """Decorator that adds --verbose, --quiet and --progress."""
    function = click.option(
        "--progress",
        type=click.Choice(("text", "json")),
        default="text",
        expose_value=False,  # `main` has seen it
        help="json: each event a JSON object on a line of stderr, for scripts.",
    )(function)
    function = click.option("-v", "--verbose", is_flag=True, help="Log debugging messages on stderr.")(function)
    return click.option("-q", "--quiet", is_flag=True, help="Only warnings and errors on stderr.")(function)


def scan_range(function: F) -> F:
    """Decorator that adds --start, --count and --skip-frames."""
    for name, text in (
        ("--skip-frames", "Use every N-th scan."),
        ("--count", "Number of scans used."),
        ("--start", "First scan used."),
    ):
        function = click.option(name, type=int, metavar="N", help=text)(function)
    return function


def scan_ranges(function: F) -> F:
    """Decorator that adds --start, --count and --skip-frames, of all sequences or of one."""
    for name, text in (
        ("--skip-frames", "Use every N-th scan"),
        ("--count", "Number of scans used"),
        ("--start", "First scan used"),
    ):
        function = click.option(
            name, multiple=True, metavar="[SEQUENCE=]N", help=f"{text}, of one SEQUENCE or of all; repeatable."
        )(function)
    return function


def ranges_of(given: dict[str, Any], words: Iterable[str]) -> tuple[list[str], dict[str, ScanRange]]:
    """Ranges of scans set by the options of `scan_ranges`: settings for all sequences, and for single `words`.

    Raises UsageError for words that are no numbers or name no sequence, ConfigError for a number out of range.
    """
    from pydantic import ValidationError

    from lslam.core.config.config import explain
    from lslam.core.config.input import AS_CONFIGURED, ScanRange

    words = list(words)
    common: dict[str, int] = {}
    own: dict[str, ScanRange] = {}
    for key in ScanRange.model_fields:
        for text in given[key]:
            flag = f"--{key.replace('_', '-')} {text}"
            word, equals, number = text.rpartition("=")
            if not number.removeprefix("-").isdecimal():
                raise UsageError(f"{flag}: a whole number, or SEQUENCE=N for one of the sequences")
            if equals and word not in words:
                raise UsageError(f"{flag}: no sequence {word!r} is named; {nearest(word, words)}")
            if not equals:
                common[key] = int(number)
                continue
            try:
                own[word] = ScanRange(**(own.get(word, AS_CONFIGURED).own | {key: int(number)}))
            except ValidationError as error:
                raise ConfigError(explain(error, flag)) from None
    return [f"input.{key}={number}" for key, number in common.items()], own


def reading(function: F) -> F:
    """Decorator that adds --lidar-topic, --lidar-frame, --imu-topic, --gnss-topic, --point-times and --extrinsics."""
    function = click.option(
        "--extrinsics", metavar="T|FILE", help="The IMU in the LiDAR's frame: 12, 16 or 7 numbers, or a file with them."
    )(function)
    function = click.option(
        "--point-times",
        type=click.Choice(("auto", "field", "columns", "order", "azimuth", "none")),
        help="What tells when each point was measured.  [default: auto]",
    )(function)
    function = click.option(
        "--lidar-frame",
        metavar="NAME|all",
        help="Of a bag: which LiDAR of a topic that several share; all merges them.",
    )(function)
    for name, text in (("gnss", "satellite fixes"), ("imu", "the IMU")):
        function = click.option(f"--{name}-topic", metavar="TOPIC", help=f"Of a bag: the topic of {text}.")(function)
    return click.option(
        "--lidar-topic",
        multiple=True,
        metavar="TOPIC",
        callback=lambda context, option, topics: ",".join(topics) or None,
        help="Of a bag: the topic of the scans; several LiDARs are merged into the sweeps of the first.",
    )(function)


def reading_of(given: dict[str, Any]) -> dict[str, Any]:
    """Arguments of `open_sequence` from the options of `reading`."""
    names = ("lidar_topic", "lidar_frame", "imu_topic", "gnss_topic", "point_times", "extrinsics")
    return {name: given[name] for name in names}


def manual(function: F) -> F:
    """Decorator that adds --loops-file and --control."""
    for name, text in (
        ("--control", "CSV of control points, surveyed positions that hold the poses: scan,x,y,z,sigma,crs."),
        (
            "--loops-file",
            "CSV of pairs of scans that are loops, or must not be: scan_a,scan_b,verdict (known, forbidden).",
        ),
    ):
        function = click.option(name, type=click.Path(path_type=Path), metavar="FILE", help=text)(function)
    return function


def manual_settings(loops: Path | None, control: Path | None) -> dict[str, str | None]:
    """Configuration keys of these files, as absolute paths, so that the run's copy of the configuration is valid anywhere."""
    return {
        key: None if path is None else json.dumps(str(path.absolute()), ensure_ascii=False)
        for key, path in (("loops.file", loops), ("graph.control", control))
    }


def configuration(function: F) -> F:
    """Decorator that adds --config and --set."""
    function = click.option(
        "--set",
        "settings",
        multiple=True,
        metavar="SECTION.KEY=VALUE",
        help="Set one configuration key; repeatable.",
    )(function)
    return click.option(
        "--config",
        "config_file",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help="Configuration, TOML.",
    )(function)


def with_preset(settings: Iterable[str], preset: str | None) -> list[str]:
    """Settings of --set, overridden by the flag --preset."""
    return [*settings, *([] if preset is None else [f"odometry.preset={json.dumps(preset)}"])]


def coordinates(function: F) -> F:
    """Decorator that adds --crs and --geoid."""
    for name, metavar, text in (
        ("--geoid", "GRID", "Heights above this geoid (.gtx, .tif) in place of the ellipsoid."),
        ("--crs", "EPSG:N[+M]", "Coordinates of georeferenced maps, +M of heights [default: control points', UTM]."),
    ):
        function = click.option(name, metavar=metavar, help=text)(function)
    return function


def crs_settings(crs: str | None, geoid: str | None) -> dict[str, str | None]:
    """Configuration keys of these flags. Raises UsageError for an invalid code."""
    from lslam.core.geometry.geodesy import parse_crs

    epsg, height_epsg = (None, None) if crs is None else parse_crs(f"EPSG:{crs}" if crs[:1].isdecimal() else crs)
    path = None if geoid is None else grid_file(geoid)
    return {
        "gnss.crs": None if epsg is None else str(epsg),
        "gnss.height_crs": None if height_epsg is None else str(height_epsg),
        "gnss.geoid": None if path is None else json.dumps(path, ensure_ascii=False),
    }


def grid_file(geoid: str) -> str:
    """Absolute path of an existing grid file; other names are those of PROJ's own grids."""
    path = Path(geoid).expanduser()
    return str(path.absolute()) if path.exists() else geoid


def output_crs(given: dict[str, Any]) -> OutputCrs | None:
    """Coordinates that --crs and --geoid ask for; None without them. Raises UsageError for what is no code."""
    from lslam.core.geometry.geodesy import parse_crs
    from lslam.core.types.gnss import OutputCrs

    epsg, height_epsg = (None, None) if given["crs"] is None else parse_crs(given["crs"])
    geoid = "" if given["geoid"] is None else grid_file(given["geoid"])
    return OutputCrs(epsg, height_epsg, geoid) if epsg or geoid else None


def studied(function: F) -> F:
    """Decorator that adds --out, --resume, --overwrite and --scenes."""
    for name, metavar, text in (
        ("--scenes", "DIR", "Keep simulations here, for others of the same scenarios [default: simulated/ in --out]."),
        ("--out", "DIR", "Folder of all runs and results [default: runs/NAME-TIME]."),
    ):
        function = click.option(name, type=Place(path_type=Path), metavar=metavar, help=text)(function)
    for name, text in (
        ("--overwrite", "Run everything anew in an existing folder."),
        ("--resume", "Keep finished runs of the same input and configuration, go on with the others."),
    ):
        function = click.option(name, is_flag=True, help=text)(function)
    return function


def output_of(given: dict[str, Any], name: str) -> OutputOptions:
    """Output options of a study, from the options of `studied`."""
    from lslam.studies.output import OutputOptions

    out = given["out"] or Path("runs") / time.strftime(f"{name}-%Y%m%d-%H%M%S")
    if name != "batch" and isinstance(out, RemotePath):
        raise UsageError(
            f"--out {out}: the results of this command are files of this machine; run and batch write to storage"
        )
    command = shlex.join(["lslam", *sys.argv[1:]])
    return OutputOptions(out, given["overwrite"], given["resume"], given["scenes"], given["data_root"], command)


def engine(function: F) -> F:
    """Decorator that adds --jobs, --scheduler and --cluster."""
    for name, kind, metavar, text in (
        ("--cluster", str, "local:N", "Make the runs with N workers of Dask on this machine."),
        (
            "--scheduler",
            str,
            "tcp://HOST:PORT",
            "Make the runs on the Dask cluster of this scheduler; needs the extra `cluster`.",
        ),
        ("--jobs", int, "N", "Runs at once on this machine [default: one per core]."),
    ):
        function = click.option(name, type=kind, metavar=metavar, help=text)(function)
    return function


def check_engine(given: dict[str, Any]) -> None:
    """Raise UsageError when options of `engine` contradict each other."""
    if sum(given[name] is not None for name in ("jobs", "scheduler", "cluster")) > 1:
        raise UsageError("--jobs, --scheduler and --cluster are three ways to make the runs: give one of them")
    if given["jobs"] is not None and given["jobs"] < 1:
        raise UsageError(f"--jobs {given['jobs']}: at least one run at a time")


@contextmanager
def engine_of(given: dict[str, Any], title: str, is_persistent: bool = True) -> Iterator[Engine]:
    """Engine chosen by the options of `engine`, after `check_engine`.

    is_persistent : whether workers keep sequences from one run to the next, and delete keyframes
    """
    from lslam.studies.jobs import Local

    jobs, scheduler, cluster = given["jobs"], given["scheduler"], given["cluster"]
    if scheduler is None and cluster is None:
        yield Local(jobs or os.cpu_count() or 1, is_persistent, title)
        return
    from lslam.studies.cluster import connected

    with connected(scheduler, cluster, title, is_persistent=is_persistent) as engine:
        yield engine


def seeds_of(text: str) -> tuple[int, ...]:
    """Seeds in --seeds, also of a range `100-104`. Raises UsageError for anything but numbers."""
    seeds: list[int] = []
    try:
        for part in filter(str.strip, text.split(",")):
            first, dash, last = part.strip().partition("-")
            seeds += range(int(first), int(last) + 1) if dash and first else [int(part)]
    except ValueError:
        raise UsageError(f"--seeds {text}: whole numbers with commas between them, or 100-104") from None
    return tuple(seeds)


def require_there(*paths: Path | None) -> None:
    """Raise InputError for a path that does not exist, before the modules that read it are imported."""
    for path in paths:
        if path is not None and not os.path.lexists(path):
            raise InputError(f"{path} does not exist")


def metrics_of(texts: Iterable[str]) -> list[str]:
    """Words of --metrics, separated by commas or in several options."""
    return [word for text in texts for word in text.split(",") if word]


def numbers(flag: str, text: str, counts: tuple[int, ...], example: str) -> list[float]:
    """The comma-separated numbers of a flag; raises UsageError unless their number is among `counts`."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in counts:
        raise click.UsageError(f"{flag} {text}: expected {example}")
    return values


def place(flag: str, text: str) -> list[float]:
    """Latitude, longitude (deg) and perhaps height (m) of a flag; raises UsageError when they are out of range."""
    at = numbers(flag, text, (2, 3), "LAT,LON, for example 49.0112,8.4229")
    if not (abs(at[0]) <= 90 and abs(at[1]) <= 180):
        raise click.UsageError(f"{flag} {text} is no place on the Earth: latitude first, in degrees")
    return at

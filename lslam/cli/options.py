"""Options that several commands share, written once."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from lslam.core.errors import ConfigError, InputError, UsageError, nearest
from lslam.io.remote import RemotePath, as_path

if TYPE_CHECKING:
    from lslam.core.config.input import ScanRange
    from lslam.core.types.gnss import OutputCrs
    from lslam.studies.jobs import Engine
    from lslam.studies.options import OutputOptions

F = TypeVar("F", bound=Callable[..., Any])


class Place(click.Path):
    """Parameter type: a path, or a URL of storage."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Path of the value, as by `as_path`."""
        if isinstance(value, str) and "://" in value:
            return as_path(value)
        return super().convert(value, param, ctx)


def option(*words: str, **more: Any) -> Callable[[F], F]:
    """Option by its names, the placeholder of its value, and its text; more : as of `click.option`."""
    *names, metavar, text = words
    return click.option(*names, metavar=metavar, help=text, **more)


path = partial(option, type=click.Path(path_type=Path))
integer = partial(option, type=int)
real = partial(option, type=float)


def flag(*words: str, **more: Any) -> Callable[[F], F]:
    """Option without a value by its names and its text."""
    *names, text = words
    return click.option(*names, is_flag=True, help=text, **more)


def group(*options: Callable[[F], F]) -> Callable[[F], F]:
    """Decorator of several options, listed by `--help` in this order."""

    def add(function: F) -> F:
        for one in reversed(options):
            function = one(function)
        return function

    return add


# Of several commands.
data_root = path("--data-root", "DIR", "Where names like seq07 are looked up [env: LSLAM_DATA].", envvar="LSLAM_DATA")
preset = option("--preset", "NAME|FILE", "Configuration to start from, see `lslam config presets`.")
as_json = flag("--json", "as_json", "Print one JSON object on stdout.")
metrics = option("--metrics", "WORD", "Show more metrics: thesis for those of the theses.", multiple=True)
settings = partial(option, "--set", "settings", multiple=True)
set_in_all_runs = settings("SECTION.KEY=VALUE", "Set one key in all runs; repeatable.")
refine = flag("--refine", "Correct all scans at once for the planes they saw, where that makes them thinner.")
fixes_as_factors = click.option(
    "--gnss", "gnss", flag_value="graph", default=None, help="Satellite fixes are factors of the pose graph."
)
fixes_at_the_end = click.option(
    "--georeference", "gnss", flag_value="fit", help="Satellite fixes only georeference the result."
)
truth = path("--gt", "FILE", "Ground truth instead of the sequence's own.")
new_sequence = path("--sequence", "PATH", "Sequence of the raw scans, when it has moved.")
overwrite = flag("--overwrite", "Replace an earlier run in the folder.")
method = option("--method", "NAME", "Odometry method, see `lslam methods` [default: icp].")
poses = path("--poses", "FILE", "Trajectory of another program instead of odometry.")
imu = click.option("--imu/--no-imu", default=None, help="Predict and deskew with the IMU [default: no].")
wheels = option(
    "--wheels",
    "TOPIC|FILE",
    "Predict with speeds of wheels: a topic of the bag (Odometry, TwistStamped), or a CSV file beside the scans.",
)
resume = flag("--resume", "Go on with a run that was killed or interrupted; needs its --out.")
threads = integer("--threads", "N", "0: as many as there are cores; 1: one. Results stay the same.")
dry_run = flag("--dry-run", "Resolve everything, write nothing.")

verbosity = group(
    flag("-q", "--quiet", "Only warnings and errors on stderr."),
    flag("-v", "--verbose", "Log debugging messages on stderr."),
    click.option(
        "--progress",
        type=click.Choice(("text", "json")),
        default="text",
        expose_value=False,  # `main` has seen it
        help="json: each event a JSON object on a line of stderr, for scripts.",
    ),
)
_RANGE = {"--start": "First scan used", "--count": "Number of scans used", "--skip-frames": "Use every N-th scan"}
scan_range = group(*(integer(name, "N", f"{text}.") for name, text in _RANGE.items()))
scan_ranges = group(
    *(
        option(name, "[SEQUENCE=]N", f"{text}, of one SEQUENCE or of all; repeatable.", multiple=True)
        for name, text in _RANGE.items()
    )
)
reading = group(
    option(
        "--lidar-topic",
        "TOPIC",
        "Of a bag: the topic of the scans; several LiDARs are merged into the sweeps of the first.",
        multiple=True,
        callback=lambda context, option, topics: ",".join(topics) or None,
    ),
    option("--imu-topic", "TOPIC", "Of a bag: the topic of the IMU."),
    option("--gnss-topic", "TOPIC", "Of a bag: the topic of satellite fixes."),
    option("--lidar-frame", "NAME|all", "Of a bag: which LiDAR of a topic that several share; all merges them."),
    click.option(
        "--point-times",
        type=click.Choice(("auto", "field", "columns", "order", "azimuth", "none")),
        help="What tells when each point was measured.  [default: auto]",
    ),
    option("--extrinsics", "T|FILE", "The IMU in the LiDAR's frame: 12, 16 or 7 numbers, or a file with them."),
)
manual = group(
    path(
        "--loops-file",
        "FILE",
        "CSV of pairs of scans that are loops, or must not be: scan_a,scan_b,verdict (known, forbidden).",
    ),
    path("--control", "FILE", "CSV of control points, surveyed positions that hold the poses: scan,x,y,z,sigma,crs."),
)
configuration = group(
    path("--config", "config_file", "FILE", "Configuration, TOML."),
    settings("SECTION.KEY=VALUE", "Set one configuration key; repeatable."),
)
coordinates = group(
    option("--crs", "EPSG:N[+M]", "Coordinates of georeferenced maps, +M of heights [default: control points', UTM]."),
    option("--geoid", "GRID", "Heights above this geoid (.gtx, .tif) in place of the ellipsoid."),
)
resume_or_overwrite = group(
    flag("--resume", "Keep finished runs of the same input and configuration, go on with the others."),
    flag("--overwrite", "Run everything anew in an existing folder."),
)
study_output = group(
    resume_or_overwrite,
    option("--out", "DIR", "Folder of all runs and results [default: runs/NAME-TIME].", type=Place(path_type=Path)),
    option(
        "--scenes",
        "DIR",
        "Keep simulations here, for others of the same scenarios [default: simulated/ in --out].",
        type=Place(path_type=Path),
    ),
)
engine = group(
    integer("--jobs", "N", "Runs at once on this machine [default: one per core]."),
    option(
        "--scheduler",
        "tcp://HOST:PORT",
        "Make the runs on the Dask cluster of this scheduler; needs the extra `cluster`.",
    ),
    option("--cluster", "local:N", "Make the runs with N workers of Dask on this machine."),
)


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


def reading_of(given: dict[str, Any]) -> dict[str, Any]:
    """Arguments of `open_sequence` from the options of `reading`."""
    names = ("lidar_topic", "lidar_frame", "imu_topic", "gnss_topic", "point_times", "extrinsics")
    return {name: given[name] for name in names}


def settings_of(flags: dict[str, Any], given: Iterable[str] = ()) -> list[str]:
    """Settings of --set, overridden by values of flags by configuration key; None is a flag that was not given."""
    return [*given, *(f"{key}={value}" for key, value in flags.items() if value is not None)]


def true_if(flag: bool) -> str | None:
    """Setting of a flag without a value; None where it was not given."""
    return "true" if flag else None


def quote(text: object) -> str | None:
    """Text as a setting; None stays."""
    return None if text is None else json.dumps(str(text), ensure_ascii=False)


def file_setting(path: str | Path | None) -> str | None:
    """Absolute path as a setting, so that the run's copy of the configuration is valid anywhere."""
    return None if path is None else quote(Path(path).expanduser().absolute())


def crs_settings(given: dict[str, Any]) -> dict[str, Any]:
    """Values of the options of `coordinates` by configuration key; a number alone is a code. Raises UsageError for none."""
    code = given["crs"]
    crs = output_crs({**given, "crs": f"EPSG:{code}" if code and code[0].isdecimal() else code})
    if crs is None:
        return {}
    return {"gnss.crs": crs.epsg, "gnss.height_crs": crs.height_epsg, "gnss.geoid": quote(crs.geoid or None)}


def output_crs(given: dict[str, Any]) -> OutputCrs | None:
    """Coordinates that --crs and --geoid ask for; None without them. Raises UsageError for what is no code."""
    crs, geoid = given["crs"], given["geoid"] or ""
    if crs is None and not geoid:
        return None
    from lslam.core.geometry.crs_names import parse_crs

    epsg, height_epsg = (None, None) if crs is None else parse_crs(crs)
    grid = Path(geoid).expanduser()
    if geoid and grid.exists():  # other names are those of PROJ's own grids
        geoid = str(grid.absolute())
    from lslam.core.types.gnss import OutputCrs

    return OutputCrs(epsg, height_epsg, geoid) if epsg or geoid else None


def command_line() -> str:
    """Command as it was typed."""
    return shlex.join(["lslam", *sys.argv[1:]])


def check_resume(given: dict[str, Any], needs_out: str = "") -> None:
    """Raise UsageError when --overwrite and --resume contradict each other.

    needs_out : what was interrupted, where --resume cannot find it without --out; empty where it can
    """
    if given["overwrite"] and given["resume"]:
        raise UsageError("--overwrite runs everything anew and --resume keeps finished parts: give one of them")
    if needs_out and given["resume"] and given["out"] is None:
        raise UsageError(f"--resume needs --out: the folder of the interrupted {needs_out}")


def typed_options() -> dict[str, str]:
    """Flags of the options that were given on the command line, by their names."""
    context = click.get_current_context()
    return {
        option.name: option.opts[0]
        for option in context.command.params
        if option.name is not None and context.get_parameter_source(option.name) is ParameterSource.COMMANDLINE
    }


def output_of(given: dict[str, Any], name: str) -> OutputOptions:
    """Output options of a study, from the options of `study_output`; raises UsageError for `--out` in object storage."""
    from lslam.studies.options import OutputOptions, folder_by_time

    out = given["out"] or folder_by_time(name)
    if name != "batch" and isinstance(out, RemotePath):
        raise UsageError(
            f"--out {out}: the results of this command are files of this machine; run and batch write to storage"
        )
    scenes = given.get("scenes")
    return OutputOptions(out, given["overwrite"], given["resume"], scenes, given["data_root"], command_line())


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
    from lslam.studies.cluster import connect

    with connect(scheduler, cluster, title, is_persistent=is_persistent) as engine:
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

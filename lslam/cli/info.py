"""`lslam info`: the contents and the faults of a sequence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path, PurePath
from typing import Any

import click

from lslam.cli import options
from lslam.cli.console import Stages, setup_logging, show, show_json, show_rows

_MOST_FILES = 8  # named


def bag_lines(bag: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Labels and values about the bag as a whole."""
    files = len(bag["files"])
    parts = [f"{files} file{'s' if files > 1 else ''}", _size(bag["size_bytes"]), f"{bag['messages']} messages"]
    if bag["duration_s"] is not None:
        begin = bag["start_utc"] or f"{bag['start_ns'] * 1e-9:.3f} s"
        parts.append(f"{bag['duration_s']:.2f} s from {begin}")
    yield "bag", ", ".join(parts)
    if files > 1:
        names = [PurePath(file).name for file in bag["files"]]
        yield "parts", ", ".join(names if files <= _MOST_FILES else [*names[: _MOST_FILES - 2], "...", names[-1]])


def topic_lines(bag: dict[str, Any]) -> Iterator[str]:
    """A line per topic: name, type, messages, rate, and purpose."""
    topics = bag["topics"]
    if not topics:
        yield "none"
        return
    name = max(len(topic["name"]) for topic in topics)
    kind = max(len(topic["type"] or "unknown type") for topic in topics)
    count = max(len(str(topic["messages"])) for topic in topics)
    for topic in topics:
        rate = "" if topic["rate_hz"] is None else f"{topic['rate_hz']:.1f} Hz"
        yield (
            f"{topic['name']:<{name}}  {topic['type'] or 'unknown type':<{kind}}  {topic['messages']:>{count}}  {rate:>10}  "
            f"{topic['used_for'] or '-'}"
        )


def _size(count: int) -> str:
    """Size in bytes as text.

    >>> _size(999), _size(1_250_000)
    ('999 bytes', '1.2 MB')
    """
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} bytes"


@click.command(epilog="\b\nExamples: lslam info sample_data\n          lslam info --machine")
@click.argument("sequence", required=False)
@options.flag("--machine", "Show what this machine has instead: cores, memory, kernels, grids, extras.")
@options.data_root
@options.option(
    "--scans",
    "N",
    "Number of scans whose points are examined, spread evenly.",
    type=click.IntRange(min=1),
    default=50,
    show_default=True,
)
@options.flag("--all", "all_scans", "Examine the points of every scan.")
@options.integer("--rows", "N", "Organised clouds: rows (rings).")
@options.integer("--cols", "N", "Organised clouds: columns.")
@options.flag("--quick", "Register no scans: the IMU's clock and axes, and the order of the points, are not checked.")
@options.flag("--cameras", "with_cameras", "Compare edges of the images with edges of depth: pixels and time.")
@options.option(
    "--imu-toml",
    "FILE",
    "Write the IMU's noise as a configuration for --config.",
    type=click.Path(path_type=Path, dir_okay=False),
)
@options.reading
@options.as_json
@options.verbosity
def command(sequence: str | None, as_json: bool, imu_toml: Path | None, **given: Any) -> None:
    """Show the contents and the faults of SEQUENCE: a folder, a bag, or a name under the data root.

    Of a bag all topics are listed, also where none has clouds. Each finding comes with advice.
    The first scans are registered, to compare their rotations with the IMU's.
    """
    setup_logging(given["verbose"], given["quiet"])
    if given["machine"] or sequence is None:
        _show_machine(sequence, given["machine"], as_json)
        return
    from lslam.core.errors import LslamError, OutputExistsError
    from lslam.io.readers import open_sequence

    if imu_toml is not None and imu_toml.exists():
        raise OutputExistsError(f"{imu_toml} exists already: name another file with --imu-toml")
    data_root = given["data_root"]
    reading = {**options.reading_of(given), "rows": given["rows"], "cols": given["cols"]}
    try:
        recording = open_sequence(sequence, data_root=data_root, **reading)
    except LslamError as error:
        _show_bag(sequence, data_root, str(error) if as_json else None)
        raise
    from lslam.pipeline.doctor.inspect import inspect

    with ExitStack() as stack:
        stages = Stages(stack)
        count = None if given["all_scans"] else given["scans"]
        facts = inspect(recording, count, given["quick"], given["with_cameras"], stages.begin, stages.step)
    if imu_toml is not None:
        _write_noise(imu_toml, facts)
    if as_json:
        show_json(facts, indent=1)
        return
    show_rows(_lines(facts), 18)
    if facts["bag"] is not None:
        _show_topics(facts["bag"])
    for title, key in (("notes", "notes"), ("findings", "problems")):
        if facts[key]:
            show(f"\n{title}\n" + "".join(f"  - {sentence}\n" for sentence in facts[key]))
    if not facts["problems"]:
        show("\nnothing wrong found\n")


def _show_machine(sequence: str | None, machine: bool, as_json: bool) -> None:
    """Print facts of the machine; raises click.UsageError unless just `machine` is chosen."""
    if sequence is not None or not machine:
        raise click.UsageError("SEQUENCE or --machine says what is looked at: give one of them")
    from lslam.cli.machine import machine_document, machine_rows

    document = machine_document()
    if as_json:
        show_json(document, indent=1)
    else:
        show_rows(machine_rows(document))


def _show_topics(bag: dict[str, Any]) -> None:
    """Print the topics of a bag."""
    show("\ntopics\n" + "".join(f"  {line}\n" for line in topic_lines(bag)))


def _show_bag(name: str, data_root: Path | None, error: str | None) -> None:
    """Show the content of a bag that is no sequence, as JSON with the `error` or as a page; nothing if there is no bag."""
    from lslam.core.errors import LslamError
    from lslam.io.readers import find_folder

    try:
        find_folder(name, data_root)
    except LslamError:
        return  # there is nothing: no need to import what would look into it
    from lslam.pipeline.doctor.inspect import bag_at

    bag = bag_at(name, data_root)
    if bag is None:
        return
    if error is not None:
        show_json({"path": name, "bag": bag, "error": error}, indent=1)
        return
    show_rows(bag_lines(bag), 18)
    show("".join(f"  - {sentence}\n" for sentence in bag["remarks"]))
    _show_topics(bag)


def _lines(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Rows (title, text) of the facts of a recording."""
    time, points = facts["time"], facts["points"]
    yield "sequence", f"{facts['name']}  ({facts['path']})"
    yield "format", facts["format"] + (f", sensor {facts['sensor']}" if facts["sensor"] else "")
    if facts["bag"] is not None:
        yield from bag_lines(facts["bag"])
    yield "scans", f"{facts['scans']} in {time['duration_s']:.2f} s, {time['rate_hz']:g} Hz"
    if time["period_s"]:
        low, middle, high = (f"{1e3 * time['period_s'][name]:.1f}" for name in ("min", "median", "max"))
        yield "period", f"{low} .. {middle} .. {high} ms, {len(time['gaps']) or 'no'} gaps"
    yield "scans looked at", _looked_at(points)
    if points["count"]:
        count = points["count"]
        yield "points per scan", f"{count['min']:,} .. {count['median']:,.0f} .. {count['max']:,}  (min, median, max)"
        yield "NaN, zero points", f"{points['share_nan']:.2%}, {points['share_zero']:.2%}"
    if points["range_m"]:
        r = points["range_m"]
        yield (
            "range",
            f"{r['min']:.2f} .. {r['max']:.2f} m, median {r['median']:.1f}, 5..95 %: {r['p5']:.1f} .. {r['p95']:.1f}",
        )
        low, high = points["elevation_deg"]
        yield "elevation", f"{low:.1f} .. {high:.1f} deg (98 % of the points)"
    yield "intensity", _limits(points["intensity"], "")
    yield "per-point times", _limits(points["per_point_times"], " s from the scan's stamp")
    by_rule = points["rings"] is None and facts["rings_rule"]
    yield "rings", f"by {facts['rings_rule']}" if by_rule else _limits(points["rings"], "")
    yield "compensated", {True: "yes", False: "no", None: "unknown"}[facts["motion_compensated"]]
    yield "extrinsics", ", ".join(key for key, T in facts["extrinsics"].items() if T is not None) or "none"
    yield "IMU", _imu(facts["imu"])
    if facts["imu"]:
        yield "IMU noise", _noise(facts["imu"]["noise"])
        yield "IMU and scans turn", _turns(facts["imu"]["turns"])
    for camera in facts.get("cameras", ()):
        from lslam.pipeline.doctor.examine_cameras import sentence_of

        yield "camera", sentence_of(camera)
    yield "GNSS", _gnss(facts["gnss"])
    yield "ground truth", _ground_truth(facts["ground_truth"])


def _looked_at(points: dict[str, Any]) -> str:
    """Number of scans read, with those unreadable or empty."""
    extra = [
        f"{points[key]} {word}"
        for key, word in (("scans_unreadable", "unreadable"), ("scans_empty", "empty"))
        if points[key]
    ]
    return f"{points['scans_read'] + points['scans_unreadable']}" + (f" ({', '.join(extra)})" if extra else "")


def _limits(limits: list[float] | None, unit: str) -> str:
    """Text of the smallest and largest value."""
    return "none" if limits is None else f"{limits[0]:.6g} .. {limits[1]:.6g}{unit}"


def _imu(imu: dict[str, Any] | None) -> str:
    """Text on the IMU: samples, rate, mean specific force and its unit, tilt, rotation rate."""
    if imu is None:
        return "none"
    rate = f"{imu['rate_hz']:.1f} Hz, " if imu["rate_hz"] else ""
    unit = imu["gravity_unit"] or "of unknown unit"
    up = "" if imu["tilt_deg"] is None else f", {imu['tilt_deg']:.0f} deg from the LiDAR's z"
    return (
        f"{imu['samples']} samples, {rate}mean specific force {imu['gravity_norm']:.3f} {unit}{up}, "
        f"turning {imu['gyro_median_deg_s']:.1f} deg/s (median)"
    )


def _noise(noise: dict[str, Any] | None) -> str:
    """Text on the noise and bias instability of the IMU, and how they were estimated."""
    if noise is None:
        return "unknown"
    how = f"Allan deviation over {noise['standing_s']:.0f} s of standing"
    parts = [
        f"{noise['accel_density']:.3g} m/s2/sqrt(Hz), {noise['gyro_density']:.3g} rad/s/sqrt(Hz) by "
        + (how if noise["method"] == "allan" else "differences of readings, shaking included")
    ]
    if noise["accel_instability"] is not None:
        parts.append(f"bias instability {noise['accel_instability']:.3g} m/s2, {noise['gyro_instability']:.3g} rad/s")
    return "; ".join(parts)


def _write_noise(path: Path, facts: dict[str, Any]) -> None:
    """Write the estimated IMU noise as TOML. Raises InputError without an estimate."""
    from lslam.core.errors import InputError
    from lslam.io.formats.atomic import atomic_write
    from lslam.pipeline.doctor.examine_imu import imu_toml

    noise = (facts["imu"] or {}).get("noise")
    if noise is None:
        what = "it has no IMU" if facts["imu"] is None else "its IMU is too short or of unknown unit"
        raise InputError(f"--imu-toml {path}: nothing to write, {what}: {facts['path']}")
    with atomic_write(path) as stream:
        stream.write(imu_toml(noise, facts["name"]).encode())


def _turns(turns: dict[str, Any] | None) -> str:
    """Text on the agreement of rotation between IMU and scans: correlation, time offset and sigma, ms."""
    if turns is None:
        return "not compared"
    if turns["correlation"] is None:
        return "they do not agree" if turns["is_judged"] else f"too few in the first {turns['scans']} scans to compare"
    axes = ", ".join("-" if c is None else f"{c:.2f}" for c in turns["correlation_xyz"] or [])
    sigma = "unknown" if turns["time_offset_sigma_s"] is None else f"{1e3 * turns['time_offset_sigma_s']:.1f}"
    return (
        f"correlation {turns['correlation']:.3f} (x, y, z: {axes}) over {turns['scans']} scans, stamps off by "
        f"{1e3 * turns['time_offset_s']:+.1f} ms (sigma {sigma})"
    )


def _gnss(gnss: dict[str, Any] | None) -> str:
    """Text on the satellite fixes: number, rate, first position, sigma, m."""
    if gnss is None:
        return "none"
    lat, lon, alt = gnss["first"]
    sigma = gnss["sigma_m"]
    accuracy = f", sigma {sigma['median']:.2f} m median, {sigma['max']:.2f} m worst" if sigma else ", accuracy unknown"
    rate = f", {gnss['rate_hz']:.1f} Hz" if gnss["rate_hz"] else ""
    north, east = gnss["hemisphere"]
    return (
        f"{gnss['fixes']} fixes{rate}, map origin {abs(lat):.7f} {north}, {abs(lon):.7f} {east}, {alt:.1f} m{accuracy}"
    )


def _ground_truth(truth: dict[str, Any] | None) -> str:
    """Text on the ground truth: poses, frame, path length and extent, m."""
    if truth is None:
        return "none"
    x, y, z = truth["extent_m"]
    return (
        f"{truth['poses']} {truth['frame']} poses ({truth['source']}), path {truth['path_length_m']:.2f} m, "
        f"extent {x:.1f} x {y:.1f} x {z:.1f} m"
    )

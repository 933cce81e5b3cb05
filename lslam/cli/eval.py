"""`lslam eval`: score estimated trajectories against ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from lslam.cli import options
from lslam.core.errors import UsageError, nearest
from lslam.evaluation import ALIGNMENTS, check_words, parse_delta
from lslam.io.formats.trajectory_files import FORMATS

if TYPE_CHECKING:
    from lslam.core.config.outputs import EvalConfig
    from lslam.core.types.sequence import Calibration
    from lslam.core.types.trajectory import Trajectory
    from lslam.evaluation.metric import Evaluation
    from lslam.evaluation.timing import Timing

EPILOG = """\b
Examples:
  lslam eval runs/seq07-icp poses/07.txt
  lslam eval ours.tum theirs.tum gt.csv --align se3 --delta 1scan --delta 100m/all
  lslam eval runs/seq07-icp poses/07.txt --metrics thesis --frame base_link
  lslam eval runs/seq07-icp poses/07.txt --fail-ate 1.0 --fail-drift 0.6
"""


@click.command(epilog=EPILOG)
@click.argument("estimates", metavar="EST...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.argument("truth", metavar="GT", type=click.Path(path_type=Path))
@options.option("--align", "A[,A]", "ATE alignments: none, origin, se3, sim3, posyaw  [se3,origin].", multiple=True)
@options.option(
    "--delta", "D", "RPE distance: 1scan, 10m, 2s, with /consecutive or /all  [1scan, 10m/all].", multiple=True
)
@options.real("--max-diff", "S", "Largest difference of stamps in a pair  [0.01].")
@options.option("--time-offset", "S|auto", "Seconds added to the estimate's stamps, or found by correlating motion.")
@options.option("--T-est-gt", "transform", "T", "Truth's body in the estimate's: 12, 16 or 7 numbers, or a file.")
@options.path("--calib", "FILE", "KITTI calibration or sequence.toml: extrinsics.")
@options.option("--frame", "NAME", "Score the poses of another frame of the robot, as base_link  [lidar].")
@options.path("--times", "FILE", "Stamps of KITTI files, one per line.")
@click.option(
    "--format", "file_format", type=click.Choice(list(FORMATS)), help="Format of the estimates; detected by default."
)
@click.option("--gt-format", type=click.Choice(list(FORMATS)), help="Format of the ground truth; detected by default.")
@options.path("--timing", "timing_file", "CSV", "timing.csv of the one estimate.")
@options.metrics
@options.as_json
@click.option("--table", type=click.Choice(["text", "md", "csv", "tex"]), default="text", help="Style of the table.")
@options.path("--plot", "FILE", "Draw a .png, .svg or .pdf.")
@options.real("--fail-ate", "M", "Exit 4 when the first ATE's rmse is larger.")
@options.real("--fail-rpe", "M", "Exit 4 when the first RPE's translational rmse is larger.")
@options.real("--fail-drift", "PERCENT", "Exit 4 when the KITTI drift is larger.")
@options.configuration
@options.verbosity
def command(
    estimates: tuple[Path, ...], truth: Path, as_json: bool, table: str, plot: Path | None, **given: Any
) -> None:
    """Score estimated trajectories (files or run folders) against ground truth.

    Formats are detected: KITTI, TUM, EuRoC, CSV with named columns. Every number is printed with its recipe.
    """
    from lslam.cli.console import setup_logging

    setup_logging(given["verbose"], given["quiet"])
    if plot is not None:
        from lslam.reports.picture import check_plot_path

        check_plot_path(plot)
    flags = _flags(given)
    if given["timing_file"] is not None and len(estimates) > 1:
        raise UsageError("--timing belongs to one estimate; with several, put timing.csv beside each")
    options.require_there(*estimates, truth, given["calib"], given["times"], given["timing_file"])
    config = _config(given, flags)
    from lslam.reports import picture
    from lslam.reports.evaluations import render, to_json

    evaluations = _evaluate_all(estimates, truth, config, given)
    timings = [_timing(path, given["timing_file"]) for path in estimates]
    if as_json:
        click.echo(to_json(evaluations, timings))
    else:
        click.echo(render(evaluations, timings, table))
    if plot is not None:
        picture.write_plot(plot, evaluations)
    _hold_gates(evaluations, given)


def _flags(given: dict[str, Any]) -> dict[str, Any]:
    """Values of the flags by key of section `eval`; raises UsageError for unknown words."""
    align = [name for text in given["align"] for name in text.split(",") if name]
    for name in align:
        if name not in ALIGNMENTS:
            raise UsageError(f"--align {name}: {nearest(name, ALIGNMENTS)}")
    deltas = [part for text in given["delta"] for part in text.split(",") if part]
    offset = given["time_offset"]
    if offset is not None and offset != "auto":
        try:
            offset = float(offset)
        except ValueError:
            raise UsageError(f"--time-offset {offset}: seconds, or auto") from None
    words = options.metrics_of(given["metrics"])
    for delta in deltas:
        parse_delta(delta)
    check_words(words)
    flags = {"metrics": words, "align": align, "delta": deltas, "max_diff": given["max_diff"], "time_offset": offset}
    flags["frame"] = given["frame"]
    return {key: value for key, value in flags.items() if value not in (None, [])}


def _config(given: dict[str, Any], flags: dict[str, Any]) -> EvalConfig:
    """Section `eval` of the configuration, overridden by the flags. Raises UsageError for an invalid value."""
    from pydantic import ValidationError

    from lslam.core.config import load_config
    from lslam.core.config.outputs import EvalConfig

    values = load_config(given["config_file"], given["settings"]).eval.model_dump() | flags
    for delta in values["delta"]:
        parse_delta(delta)
    check_words(values["metrics"])
    try:
        return EvalConfig.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(f"{first['loc'][0]} = {first['input']!r}: {first['msg']}") from None


def _evaluate_all(
    estimates: tuple[Path, ...], truth: Path, config: EvalConfig, given: dict[str, Any]
) -> list[Evaluation]:
    """Evaluate each trajectory against the truth; a run folder has its own calibration where the truth lacks one."""
    from lslam.core.errors import InputError
    from lslam.evaluation.evaluate import evaluate
    from lslam.io.formats.kitti_layout import read_transform
    from lslam.io.formats.trajectory_files import read_trajectory

    ground_truth = read_trajectory(truth, given["gt_format"], given["times"])
    T_est_gt = None if given["transform"] is None else read_transform(given["transform"])
    calibration = _calibration(truth, given["calib"])
    evaluations = []
    for path in estimates:
        if config.frame not in calibration.poses_in_lidar() and given["calib"] is None and path.is_dir():
            from lslam.pipeline.again import open_again
            from lslam.pipeline.rebuild import read_run

            calibration = open_again(read_run(path)).calibration
        estimate: Trajectory = read_trajectory(path, given["file_format"], given["times"])
        result = evaluate(estimate, ground_truth, config, T_est_gt=T_est_gt, calibration=calibration)
        for name, error in result.ate.items():
            if given["align"] and not error.available:
                raise InputError(f"--align {name}: {error.note} for {path} against {truth}; use --align origin")
        evaluations.append(result)
    return evaluations


def _calibration(truth: Path, calib: Path | None) -> Calibration:
    """The calibration of --calib, or what lies at KITTI's place for this ground truth."""
    from lslam.core.types.sequence import Calibration
    from lslam.io.formats import kitti_layout
    from lslam.io.formats.sequence_toml import FILE_NAME, SequenceInfo, read_sequence_toml
    from lslam.io.readers.sidecars import calibration_over

    if calib is not None:
        if calib.suffix == ".toml":
            return calibration_over(read_sequence_toml(calib), Calibration())
        return Calibration(T_cam0_lidar=kitti_layout.read_cam0_lidar(calib))
    above = truth.resolve().parent
    for folder in (above, above.parent / "sequences" / truth.stem):
        tr, toml = folder / "calib.txt", folder / FILE_NAME
        if tr.is_file() or toml.is_file():
            T_cam0_lidar = kitti_layout.read_odometry_calib(tr) if tr.is_file() else None
            info = read_sequence_toml(toml) if toml.is_file() else SequenceInfo()
            return calibration_over(info, Calibration(T_cam0_lidar))
    return Calibration()


def _timing(estimate: Path, file: Path | None) -> Timing | None:
    """The timing of --timing, or of timing.csv beside the estimate; None without one."""
    from lslam.evaluation.timing import read_timing

    if file is not None:
        return read_timing(file)
    beside = (estimate if estimate.is_dir() else estimate.parent) / "timing.csv"
    return read_timing(beside) if beside.is_file() else None


def _hold_gates(evaluations: list[Evaluation], given: dict[str, Any]) -> None:
    """Raise GateError with every number above its gate; a number that is not available fails its gate."""
    from lslam.core.errors import GateError
    from lslam.evaluation.evaluate import METRICS

    failures = []
    for e in evaluations:
        for metric in METRICS:
            gate = given.get(f"fail_{metric.gate_option}")
            if gate is None:
                continue
            name, value, unit = metric.gate_value(e)
            if value is None or not value <= gate:
                number = "n/a" if value is None else f"{value:.4g} {unit}"
                failures.append(
                    f"{name} of {e.estimate} is {number}, --fail-{metric.gate_option} allows {gate:g} {unit}"
                )
    if failures:
        raise GateError("; ".join(failures))

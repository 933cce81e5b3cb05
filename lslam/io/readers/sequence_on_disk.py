"""Base class of the sequences of all readers, and detection of the unit of their coordinates."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import islice
from math import inf, isnan, log, nan
from pathlib import Path
from typing import TypeVar

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError
from lslam.core.types.camera import Camera
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Calibration, Scans, Sequence, SequenceView, StatedTimes, no_shared_time, readable
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.point_cloud import LABEL_NAMES, PointCloud
from lslam.io.formats.point_files import LABELS, read_labels
from lslam.io.formats.sequence_toml import LENGTHS
from lslam.io.readers.point_clock import PointClock
from lslam.io.readers.point_times import TimeRule

# Scans of a sensor that drives or is carried have smaller medians in metres.
_LONG_RANGE_M = 60.0
# What is usual, m: the sensor's height, the thickness of surfaces, and, which says less, the median range.
_HEIGHT_M, _NOISE_M, _RANGE_M, _RANGE_WEIGHT = 1.5, 0.01, 8.0, 0.5
# By how much the best unit has to be nearer to what is usual than the next one, as a logarithm.
_MARGIN = 2.0
_MIN_POINTS = 100
_PATCHES, _PATCH_POINTS, _MOST_POINTS = 200, 12, 60_000
# What no LiDAR and no recording has: steps of coordinates, and surfaces thinner or thicker.
_COARSEST_M, _THINNEST_M, _THICKEST_M = 0.1, 0.002, 0.3

T = TypeVar("T", bound="SequenceOnDisk")
# Scans of which one has labels, or the recording has none: the first that can be read.
_LOOKED_AT = 5


@dataclass(kw_only=True)
class SequenceOnDisk(Scans):
    """A `Sequence`. See `lslam.core.types.sequence` for the attributes every sequence has.

    rings : number of beams, sensor : its name; None where nobody states them
    stated_times : what is stated about the times of points; has_assumed_extrinsics : nothing says where the IMU sits
    clock : how per-point times are read, None when there are none or they are not to be used
    unit_m : of coordinates, None where nobody states it
    open_cameras : finds its cameras, which nobody pays for who does not ask
    """

    name: str
    path: Path
    kind: str
    stamps_ns: Longs
    rate_hz: float
    motion_compensated: bool | None = None
    calibration: Calibration = field(default_factory=Calibration)
    ground_truth: Trajectory | None = None
    imu: ImuStream | None = None
    gnss: GnssStream | None = None
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    stated_times: StatedTimes = field(default_factory=StatedTimes)
    rings: int | None = None
    sensor: str | None = None
    has_assumed_extrinsics: bool = False
    clock: PointClock | None = None
    unit_m: float | None = None
    open_cameras: Callable[[], list[Camera]] = list

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def cameras(self) -> list[Camera]:
        """Cameras of the recording. Raises InputError where one has no calibration, stamps or images."""
        return self.open_cameras()

    @property
    def time_rule(self) -> TimeRule | None:
        """How per-point times are meant; None where `clock` is."""
        return None if self.clock is None else self.clock.rule

    def scan(self, index: int) -> Scan:
        """Read scan `index`; a file or message without points gives an empty scan.

        Raises InputError naming the file, or bag, topic and message, when it is damaged, IndexError beyond the end.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"scan {index} of {len(self)}")
        return self._read(index)

    def streams_apart(self) -> list[str]:
        """Warnings about IMU data and fixes that lie entirely before or after the scans."""
        own, streams = self.stamps_ns, {"IMU": self.imu, "GNSS": self.gnss}
        stamps = {name: stream.stamps_ns for name, stream in streams.items() if stream is not None}
        return [no_shared_time(name) for name, its in stamps.items() if its[0] > own[-1] or its[-1] < own[0]]

    @abstractmethod
    def _read(self, index: int) -> Scan:
        """Scan `index`, which exists."""


def in_metres(cloud: PointCloud, unit_m: float | None) -> PointCloud:
    """Cloud with its points converted to m."""
    return cloud if unit_m in (None, 1.0) else replace(cloud, points=cloud.points * np.float32(unit_m))


def settle_unit(sequence: T) -> T:
    """Sequence with its unit detected if not stated. The decision is added to the notes, doubts to the problems."""
    if sequence.unit_m is not None:
        name = next(name for name, length in LENGTHS.items() if length == sequence.unit_m)
        sequence.notes.append(f"points in {name}, as stated")
        return sequence
    some: list[Floats] = []
    last = len(sequence) - 1
    for _, scan in readable(sorted({0, len(sequence) // 2, last}) if last >= 0 else (), sequence.scan):
        points = scan.points[np.isfinite(scan.points).all(1) & (scan.points != 0).any(1)].astype(np.float64)
        some += [points] if len(points) >= _MIN_POINTS else []
        if some and float(np.median(np.linalg.norm(some[0], axis=1))) < _LONG_RANGE_M:
            return sequence
    if some:
        unit, sentence = find_unit(some)
        sequence.unit_m = None if unit is None else LENGTHS[unit]
        (sequence.problems if unit is None else sequence.notes).append(sentence)
    return sequence


def find_unit(scans: list[Floats]) -> tuple[str | None, str]:
    """Most plausible length unit, of `LENGTHS`, of the scans (N, 3), None if unclear; and a sentence with the evidence."""
    reach = float(np.median([np.median(np.linalg.norm(points, axis=1)) for points in scans]))
    height = _median([_ground(points) for points in scans])
    noise = _median([_noise(points) for points in scans])
    step = max(_step(points) for points in scans)
    evidence = [
        (reach, _RANGE_M, _RANGE_WEIGHT, f"half of the points lie beyond {reach:.4g}"),
        (height, _HEIGHT_M, 1.0, f"the ground {height:.4g} below the sensor"),
        (noise, _NOISE_M, 1.0, f"surfaces are {noise:.2g} thick"),
    ]
    evidence = [row for row in evidence if not isnan(row[0])]
    costs = {}
    for name, length in LENGTHS.items():
        thickness_m = noise * length
        is_impossible = step * length > _COARSEST_M or thickness_m <= _THINNEST_M or thickness_m >= _THICKEST_M
        apart = [
            weight * abs(log(max(value * length, _THINNEST_M) / usual_m)) for value, usual_m, weight, _ in evidence
        ]
        costs[name] = inf if is_impossible else sum(apart)
    best, second, *_ = sorted(costs, key=lambda name: costs[name])
    sentences = [row[-1] for row in evidence] + ([f"coordinates lie in steps of {step:g}"] if step else [])
    why = f"{', '.join(sentences)}; point_unit in sequence.toml states another unit"
    if costs[best] < inf and costs[second] - costs[best] >= _MARGIN and (not isnan(noise) or step >= 1):
        return best, f"points in {best}, found: {why}"
    return None, f"points are taken to be in m, though {why}"


def _median(values: list[float]) -> float:
    """Median without NaN; NaN if nothing is left."""
    numbers = [value for value in values if not isnan(value)]
    return float(np.median(numbers)) if numbers else nan


def _ground(points: Floats) -> float:
    """Height of the sensor above the most frequent level below it, in the unit of points (N, 3); NaN if few lie below."""
    level = np.hypot(points[:, 0], points[:, 1])
    below = -points[points[:, 2] < -0.05 * level, 2]
    if len(below) < _MIN_POINTS:
        return nan
    counts, edges = np.histogram(below, 40, (0.0, float(np.percentile(below, 99))))
    k = int(np.argmax(counts))
    return float(edges[k] + edges[k + 1]) / 2


def _noise(points: Floats) -> float:
    """Noise of surfaces in points (N, 3): thickness of the flattest patches, as large as a tenth of their range; or NaN."""
    from scipy.spatial import cKDTree

    points = points[:_MOST_POINTS]
    r = np.linalg.norm(points, axis=1)
    tree = cKDTree(points)
    thickness = []
    for k in np.linspace(0, len(points) - 1, _PATCHES).astype(int):
        patch = points[tree.query_ball_point(points[k], 0.1 * r[k])]
        if len(patch) >= _PATCH_POINTS:
            spread = np.linalg.svd(patch - patch.mean(0), compute_uv=False) / len(patch) ** 0.5
            if spread[1] > 0.2 * spread[0]:
                thickness.append(float(spread[2]))
    return float(np.percentile(thickness, 25)) if len(thickness) >= _PATCHES // 10 else nan


def _step(points: Floats) -> float:
    """Quantisation step of the coordinates, 0 if there is none above a thousandth."""
    for step in (1.0, 0.5, 0.1, 0.01, 0.001):
        if np.abs(points / step - np.round(points / step)).max() < 1e-3:
            return step
    return 0.0


class LabelledSequence(SequenceView):
    """A sequence whose scans get labels from files if their points have none; all else is unchanged."""

    def __init__(self, whole: Sequence, folder: Path, scans: list[Path]) -> None:
        super().__init__(whole, notes=[*whole.notes, f"labels of points from {folder}"])
        self._files = [folder / f"{scan.stem}.label" for scan in scans]

    def scan(self, index: int) -> Scan:
        """Scan `index` with its labels; missing or mismatched ones are in its `fault`. Raises InputError as the sequence."""
        scan = self.whole.scan(index)
        if scan.labels is not None or not len(scan):
            return scan
        try:
            return replace(scan, labels=read_labels(self._files[index], len(scan)))
        except InputError as error:
            return replace(scan, fault="; ".join(filter(None, (scan.fault, str(error)))))


def add_labels(sequence: Sequence) -> Sequence:
    """Sequence with point labels from files beside its scans, if there are any."""
    files: list[Path] = getattr(sequence, "files", [])
    folder = sequence.path / LABELS
    # Where LiDARs are merged, or some scans chosen, the files are of other scans.
    is_whole = len(files) == len(sequence) and not hasattr(sequence, "further_lidars")
    return LabelledSequence(sequence, folder, files) if is_whole and folder.is_dir() else sequence


def with_labels(sequence: Sequence, key: str) -> Sequence:
    """Sequence with point labels. Raises InputError where it has none, naming the `key` that needs them."""
    whole = add_labels(sequence)
    scans = [scan for _, scan in islice(readable(range(len(whole)), whole.scan), _LOOKED_AT)]
    if scans and all(scan.labels is None for scan in scans):
        why = f" ({scans[0].fault})" if whole is not sequence else ""
        raise InputError(
            f"{sequence.path}: {key} needs labels of points, and its first scans have none{why}; they are read from "
            f"{LABELS}/*.label beside the scans and from fields {', '.join(LABEL_NAMES[:3])} and the like"
        )
    return whole

"""The clouds of keyframes, compressed on disk, so that memory does not grow with the length of the run.

Submaps are clouds of neighbouring keyframes in one frame; they and the mounting tell the up direction.
"""

from __future__ import annotations

import io
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Points
from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import InputError, OutputError, cause
from lslam.core.geometry import se3
from lslam.core.kernels import voxel as voxels
from lslam.core.kernels.transform import transform
from lslam.core.types.state import Stateful
from lslam.core.types.trajectory import Keyframe
from lslam.io.formats.bag_chunks import zstd
from lslam.io.formats.state_files import pack_npz, read_npz, write_npz
from lslam.registration.preprocessing.ground import Z, find_up, world_up_of
from lslam.registration.preprocessing.prepare import NO_TIMES

Labels = NDArray[np.uint16]
INDEX = "index.npz"
CACHE_CLOUDS = 32
# Of zstd: at a higher level clouds are hardly smaller, and take longer.
PACKING_LEVEL = 1
# Ends the names of arrays whose bytes are a frame of zstd.
ZST = ".zst"


class KeyframeStore(Stateful):
    """Keyframes in order; their clouds in a folder, the last used ones in memory.

    The folder holds `index.npz`, everything but the clouds, once `save` was called, and `000000.npz`, `000001.npz`, ...
    for the clouds. A folder that has an index is opened with what it holds. Several threads may ask for points.

    folder : created when the first cloud is added; None keeps the packed clouds in memory
    cache_size : clouds in memory

    Raises InputError for an index or a cloud that is damaged or missing, OutputError for what cannot be written.

    >>> store = KeyframeStore()
    >>> store.add(Keyframe(0, 0, 0, np.eye(4)), np.ones((2, 3), np.float32))
    >>> len(store), store.points(0).tolist()
    (1, [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    """

    def __init__(self, folder: Path | None = None, cache_size: int = CACHE_CLOUDS) -> None:
        self.folder = folder
        self.keyframes: list[Keyframe] = []
        # The number by which the cloud of each was added.
        self._files: list[int] = []
        self._memory: dict[int, bytes] = {}
        self._cached = cache_size
        self._recent: OrderedDict[int, tuple[Points, Labels | None]] = OrderedDict()
        self._lock = threading.Lock()
        if folder is not None and (folder / INDEX).exists():
            self.restore(read_npz(folder / INDEX))

    def __len__(self) -> int:
        """How many keyframes there are."""
        return len(self.keyframes)

    def add(self, keyframe: Keyframe, points: Points, labels: Labels | None = None) -> None:
        """Append the next keyframe with its cloud (N, 3), m, in the LiDAR frame at its scan's stamp; written to disk at once.

        labels : (N,) classes of its points, or None. Raises ValueError unless `keyframe.number` is the next number.
        """
        if keyframe.number != len(self):
            raise ValueError(f"keyframe {keyframe.number} cannot follow {len(self) - 1}")
        cloud = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
        # Byte by byte and axis by axis: what is alike lies side by side, and zstd takes it down to half.
        planes = np.ascontiguousarray(cloud.T).view(np.uint8).reshape(3, len(cloud), 4).transpose(2, 0, 1)
        arrays: dict[str, NDArray[Any]] = {"planes": planes} if labels is None else {"planes": planes, "labels": labels}
        packed = _pack(arrays)
        if self.folder is None:
            stream = io.BytesIO()
            pack_npz(stream, packed, 0)
            self._memory[keyframe.number] = stream.getvalue()
        else:
            _make(self.folder)
            write_npz(self._path(keyframe.number), packed, 0)
        self.keyframes.append(keyframe)
        self._files.append(keyframe.number)
        self._keep(keyframe.number, cloud, labels)

    def points(self, number: int) -> Points:
        """Cloud (N, 3), m, of keyframe `number`, as it was added; not to be written to."""
        return self._load(number)[0]

    def labels(self, number: int) -> Labels | None:
        """Classes (N,) of the points of keyframe `number`, as they were added; not to be written to."""
        return self._load(number)[1]

    def _load(self, number: int) -> tuple[Points, Labels | None]:
        """Points and labels (None without) of keyframe `number`, from the cache or file; raises InputError if damaged."""
        file = self._files[number]
        with self._lock:
            if file in self._recent:
                self._recent.move_to_end(file)
                return self._recent[file]
        source = io.BytesIO(self._memory[file]) if self.folder is None else self._path(file)
        name = str(source) if isinstance(source, Path) else "a keyframe"
        arrays = _unpack(read_npz(source), name)
        planes, labels = arrays.get("planes", np.zeros(0, np.uint8)), arrays.get("labels")
        if (
            planes.ndim != 3
            or planes.shape[:2] != (4, 3)
            or planes.dtype != np.uint8
            or (labels is not None and labels.shape != planes.shape[2:])
        ):
            raise InputError(f"{name} holds no cloud of a keyframe")
        values = np.empty((*planes.shape[1:], 4), np.uint8)
        for k, plane in enumerate(planes):
            values[..., k] = plane
        return self._keep(file, np.ascontiguousarray(values.view(np.float32)[..., 0].T), labels)

    def keep(self, keyframes: Sequence[Keyframe]) -> None:
        """Restrict the store to these of its keyframes, numbered anew from 0; the files of all clouds remain."""
        self._files = [self._files[k.number] for k in keyframes]
        self.keyframes = [replace(k, number=number) for number, k in enumerate(keyframes)]

    def clear(self) -> None:
        """Remove all keyframes from the store and its folder, those of an earlier run too."""
        self.keyframes, self._files, self._memory = [], [], {}
        with self._lock:
            self._recent.clear()
        for file in [] if self.folder is None else self.folder.glob("*.npz"):
            file.unlink(missing_ok=True)

    def save(self) -> None:
        """Write the index, so that the folder can be opened again; no keyframes leave no folder."""
        if self.folder is not None and self.keyframes:
            write_npz(self.folder / INDEX, self.state())

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything but the clouds, as arrays."""
        return {**keyframe_arrays(self.keyframes), "files": np.array(self._files, np.int64)}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Replace the keyframes by those of `state`; raises InputError when one of their clouds is missing."""
        keyframes = keyframes_of(state)
        files = [int(file) for file in state.get("files", np.arange(len(keyframes)))]
        if len(files) != len(keyframes):
            raise InputError("an index of keyframes is damaged: it does not list a file for each")
        for number, file in enumerate(files):
            if self.folder is None or not self._path(file).is_file():
                raise InputError(f"{self.folder}: the cloud of keyframe {number} is missing")
        with self._lock:
            self._recent.clear()
        self.keyframes, self._files = keyframes, files

    @property
    def size(self) -> int:
        """Bytes of all clouds, compressed."""
        if self.folder is None:
            return sum(len(data) for data in self._memory.values())
        return sum(self._path(file).stat().st_size for file in self._files)

    def _path(self, file: int) -> Path:
        """File of a cloud by its number."""
        assert self.folder is not None
        return self.folder / f"{file:06d}.npz"

    def _keep(self, file: int, cloud: Points, labels: Labels | None) -> tuple[Points, Labels | None]:
        """Put the cloud of `file`, now read-only, into the cache, and return cloud and labels.

        The least recently used clouds are dropped.
        """
        cloud.flags.writeable = False
        with self._lock:
            self._recent[file] = cloud, labels
            self._recent.move_to_end(file)
            while len(self._recent) > self._cached:
                self._recent.popitem(last=False)
        return cloud, labels


class PartOfStore(KeyframeStore):
    """Some of another store's keyframes, numbered from 0; whole : the keyframes as the other store numbers them."""

    def __init__(self, store: KeyframeStore, numbers: Sequence[int]) -> None:
        super().__init__()
        self._store, self.whole = store, [store.keyframes[n] for n in numbers]
        self.keyframes = [replace(k, number=number) for number, k in enumerate(self.whole)]

    def points(self, number: int) -> Points:
        """Cloud (N, 3), m, LiDAR frame, of keyframe `number` of the part."""
        return self._store.points(self.whole[number].number)

    def labels(self, number: int) -> Labels | None:
        """Classes (N,) of the points of keyframe `number` of the part; None where they are unknown."""
        return self._store.labels(self.whole[number].number)


def _pack(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.uint8]]:
    """The bytes of the arrays as frames of zstd, which packs seven times and unpacks three times as fast as deflate."""
    compress = zstd().compress
    return {
        f"{name}{ZST}": np.frombuffer(compress(array.tobytes(), PACKING_LEVEL), np.uint8)
        for name, array in arrays.items()
    }


def _unpack(arrays: dict[str, NDArray[Any]], name: str) -> dict[str, NDArray[Any]]:
    """The arrays of the file `name` with planes and labels decompressed. Raises InputError where they are damaged."""
    planes, labels = f"planes{ZST}", f"labels{ZST}"
    try:
        if planes in arrays:
            arrays["planes"] = np.frombuffer(zstd().decompress(arrays[planes].tobytes()), np.uint8).reshape(4, 3, -1)
        if labels in arrays:
            arrays["labels"] = np.frombuffer(zstd().decompress(arrays[labels].tobytes()), np.uint16)
    except (zstd().ZstdError, ValueError) as error:
        raise InputError(f"{name} is damaged: {error}") from None
    return arrays


def keyframe_arrays(keyframes: Sequence[Keyframe]) -> dict[str, NDArray[Any]]:
    """Arrays of keyframes: scans, stamps_ns, poses (K, 4, 4), covariances (NaN if missing), distances, m."""
    none = np.full((6, 6), np.nan)
    return {
        "scans": np.array([k.scan for k in keyframes], np.int64),
        "stamps_ns": np.array([k.stamp_ns for k in keyframes], np.int64),
        "poses": np.array([k.T_world_lidar for k in keyframes], np.float64).reshape(-1, 4, 4),
        "covariances": np.array(
            [none if k.covariance is None else k.covariance for k in keyframes], np.float64
        ).reshape(-1, 6, 6),
        "distances": np.array([k.distance for k in keyframes], np.float64),
    }


def keyframes_of(state: Mapping[str, NDArray[Any]]) -> list[Keyframe]:
    """The keyframes of `keyframe_arrays`; raises InputError when they are not."""
    try:
        columns = [state[name] for name in ("scans", "stamps_ns", "poses", "covariances", "distances")]
        return [
            Keyframe(number, int(scan), int(stamp), pose, None if np.isnan(C).any() else C, float(distance))
            for number, (scan, stamp, pose, C, distance) in enumerate(zip(*columns, strict=True))
        ]
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"an index of keyframes is damaged: {error}") from None


def _make(folder: Path) -> None:
    """Make the folder; raises OutputError where that is impossible."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder} cannot be written: {cause(error)}") from None


def neighbours(count: int, number: int, size: int) -> range:
    """Numbers of the `size` keyframes about `number` out of `count`; fewer where the run begins or ends.

    >>> neighbours(10, 4, 5), neighbours(10, 0, 5), neighbours(10, 9, 4)
    (range(2, 7), range(0, 3), range(7, 10))
    """
    return range(max(number - size // 2, 0), min(number + (size + 1) // 2, count))


def submap(
    store: KeyframeStore,
    poses: Floats,
    number: int,
    size: int,
    voxel: float | None = None,
    T_world_frame: Floats | None = None,
) -> NDArray[np.float32]:
    """Points (M, 3), m, of `size` keyframes about keyframe `number`, in its LiDAR frame or in that of `T_world_frame` (4, 4).

    poses : (K, 4, 4) T_world_lidar of all keyframes, odometry's or optimised ones
    voxel : m, one averaged point per voxel remains; None keeps all
    """
    frame = poses[number] if T_world_frame is None else T_world_frame
    clouds = {k: store.points(k) for k in neighbours(len(store), number, size)}
    points = np.empty((sum(map(len, clouds.values())), 3), np.float32)
    first = 0
    for k, cloud in clouds.items():
        transform(cloud, se3.relative(frame, poses[k]), points[first : first + len(cloud)])
        first += len(cloud)
    return points if voxel is None else voxels.means(points, NO_TIMES, voxel)[0]


def submap_labels(store: KeyframeStore, number: int, size: int) -> NDArray[np.uint16]:
    """Classes (M,) of the points of `submap` where all are left; 0, unlabeled, of keyframes whose classes are unknown."""
    parts = []
    for k in neighbours(len(store), number, size):
        labels = store.labels(k)
        parts.append(np.zeros(len(store.points(k)), np.uint16) if labels is None else labels)
    return np.concatenate(parts)


# Keyframes in whose clouds the ground is looked for: rings of a sensor on its side cross it in a line, those of 20 m cover it.
GROUND_KEYFRAMES = 10


def mounted_up(store: KeyframeStore, poses: Floats, config: PreprocessConfig) -> Floats:
    """(3,) unit vector up in the world of the poses (K, 4, 4), T_world_lidar of all keyframes.

    By `preprocess.up`, or else by the ground about the first keyframes: z unless it is more than 45 deg off.
    """
    if config.up is not None or not len(store):
        return world_up_of(config, poses[0]) if len(poses) else Z
    middle = min(GROUND_KEYFRAMES, len(store)) // 2
    frame = np.eye(4)
    frame[:3, 3] = poses[middle, :3, 3]
    return find_up(submap(store, poses, middle, GROUND_KEYFRAMES, T_world_frame=frame)).direction

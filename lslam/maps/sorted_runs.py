"""Tables of int64 rows larger than memory: hashed by key, and sorted runs on disk, merged by ranges of keys."""

from __future__ import annotations

import tempfile
from bisect import bisect_left
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Ints, Longs
from lslam.core.errors import InputError, OutputError, cause, output_errors
from lslam.core.stopping import checking
from lslam.core.types.state import State

Rows = NDArray[np.int64]
Combine = Callable[[Rows], Rows]

# Rows brought together at a time, about: 12 MB of them, and four times that while they are sorted and added up.
PART = 1 << 18
_SAMPLE = 4096


def rows_folder(beside: Path | None, folder: Path | None) -> tuple[Path, tempfile.TemporaryDirectory[str] | None]:
    """Folder for rows: `folder`, or a temporary one in `beside` and its owner; OutputError if it cannot be written."""
    try:
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            return folder, None
        owner = tempfile.TemporaryDirectory(prefix=".lslam-map-", dir=beside, ignore_cleanup_errors=True)
    except OSError as error:
        place = folder or beside or tempfile.gettempdir()
        raise OutputError(f"{place} cannot be written: {cause(error)}") from None
    return Path(owner.name), owner


class SortedRuns:
    """Runs of rows (n, k), int64, each sorted by its first column, in files of a temporary folder.

    beside : the folder the temporary one is made in; None: the system's
    folder : one that stays instead, and the runs in it with it, for `restore`
    Raises OutputError: the folder or a file in it cannot be written.
    """

    def __init__(self, beside: Path | None = None, folder: Path | None = None) -> None:
        self._folder, self._owner = rows_folder(beside, folder)
        self._runs: list[StoredRows] = []

    def __len__(self) -> int:
        return len(self._runs)

    def add(self, rows: Rows) -> None:
        """Store sorted rows (n, k) as one run."""
        stored = self._rows_file(f"run-{len(self._runs)}", rows.shape[1])
        stored.remove()  # what a process that was killed may have left
        stored.append(rows)
        self._runs.append(stored)

    def state(self) -> State:
        """Numbers of rows and columns of each run, by which `restore` finds them in the folder."""
        return {"runs": [(len(run), run.columns) for run in self._runs]}

    def restore(self, state: State) -> None:
        """Take over the runs in the folder. Raises InputError when they are missing."""
        self._runs = []
        for k, (count, columns) in enumerate(state["runs"]):
            stored = self._rows_file(f"run-{k}", columns)
            stored.find(count)
            self._runs.append(stored)

    def _rows_file(self, name: str, columns: int) -> StoredRows:
        """A new file for rows in the folder."""
        return StoredRows(self._folder / name, columns, self._owner)

    def merge(self, combine: Combine) -> StoredRows:
        """Merge all runs into one table, sorted by key. The runs are deleted, unless their folder is kept.

        combine : given rows sorted by key, those of one key in the order of the runs, gives one row per key
        """
        columns = min(run.columns for run in self._runs)
        whole = self._rows_file("all", columns)
        whole.remove()
        cuts = self._cuts()
        begins = [0] * len(self._runs)
        for cut in checking([*cuts, None]):
            parts = []
            for k, run in enumerate(self._runs):
                end = len(run) if cut is None else run.first_not_below(cut)
                parts.append(run.read(begins[k], end)[:, :columns])
                begins[k] = end
            rows = np.concatenate(parts)
            if len(rows):
                whole.append(combine(rows[np.argsort(rows[:, 0], kind="stable")]))
        for run in self._runs if self._owner is not None else ():
            run.remove()
        self._runs = []
        return whole

    def _cuts(self) -> list[int]:
        """Keys that split all rows into parts of about `PART` rows, from every 4096th key of each run."""
        keys = np.sort(np.concatenate([run.keys[::_SAMPLE] for run in self._runs]))
        step = max(PART // _SAMPLE, 1)
        return [int(key) for key in np.unique(keys[step::step])]


class StoredRows:
    """Rows in a file, with their keys in a second one for searching; owner : of the folder, which stays as long as it is held."""

    def __init__(self, path: Path, columns: int, owner: object) -> None:
        self.columns = columns
        self._path, self._count = path, 0
        self._owner = owner  # the folder stays for as long as somebody reads from it

    def __len__(self) -> int:
        return self._count

    @property
    def keys(self) -> Longs:
        """(n,) first column, mapped from the file."""
        return np.memmap(self._path.with_suffix(".keys"), np.int64, "r") if self._count else np.zeros(0, np.int64)

    def append(self, rows: Rows) -> None:
        """Write rows behind the existing ones."""
        path = self._path
        with output_errors(path), path.open("ab") as stream, path.with_suffix(".keys").open("ab") as keys:
            stream.write(np.ascontiguousarray(rows).data)
            keys.write(np.ascontiguousarray(rows[:, 0]).data)
        self._count += len(rows)

    def read(self, begin: int, end: int) -> Rows:
        """Rows from `begin` to before `end`. Raises OutputError when the file cannot be read back."""
        try:
            flat = np.fromfile(
                self._path, np.int64, max(end - begin, 0) * self.columns, offset=8 * self.columns * begin
            )
        except OSError as error:
            raise OutputError(f"{self._path} cannot be read back: {cause(error)}") from None
        return flat.reshape(-1, self.columns)

    def first_not_below(self, key: int) -> int:
        """Number of rows with a smaller key: the index of the first row not below it."""
        return bisect_left(self.keys, key)

    def find(self, count: int) -> None:
        """Take over `count` rows of an existing file. Raises InputError when there are fewer."""
        for path, columns in ((self._path, self.columns), (self._path.with_suffix(".keys"), 1)):
            if not path.is_file() or path.stat().st_size < 8 * columns * count:
                raise InputError(f"{path} does not hold the {count} rows that it should")
        self._count = count

    def remove(self) -> None:
        """Delete the files."""
        for path in (self._path, self._path.with_suffix(".keys")):
            path.unlink(missing_ok=True)
        self._count = 0


class KeyedRows:
    """Rows (n, k), int64, one for each key, which is their first column: in memory, and in sorted runs where they are many.

    Kernels find and enter them by a hash: `rows` (R, k), of which `used` are taken, and `slots` (S,) with the row of each.

    columns : k; room : rows that there is room for at first
    beside, folder : as of `SortedRuns`
    """

    def __init__(self, columns: int, room: int, beside: Path | None, folder: Path | None) -> None:
        self._places = beside, folder
        self._runs: SortedRuns | None = None
        self.rows: Rows = np.empty((0, columns), np.int64)
        self.slots: Ints = np.empty(0, np.int32)
        self.used = 0
        self.reserve(room)

    def reserve(self, count: int) -> None:
        """Ensure room for `count` rows; the slots stay at most two thirds full."""
        from lslam.maps.kernels.cells import enter

        if count > len(self.rows):
            # The system provides memory only for rows that are written.
            wider = np.empty((max(count, len(self.rows) * 3 // 2), self.rows.shape[1]), np.int64)
            wider[: self.used] = self.rows[: self.used]
            self.rows = wider
        # Kernels fill rows to the last one.
        if len(self.rows) * 3 > len(self.slots) * 2:
            self.slots = np.full(1 << int(np.ceil(np.log2(len(self.rows) * 2))), -1, np.int32)
            enter(self.slots, self.rows, self.used)

    def set_columns(self, columns: int) -> None:
        """Keep the first `columns` columns; while no row is taken there may be more."""
        wider = np.empty((len(self.rows), columns), np.int64)
        if self.used:
            wider[: self.used] = self.rows[: self.used, :columns]
        self.rows = wider

    def spill(self) -> None:
        """Move the rows in memory to the disk, as one run. Raises OutputError when they cannot be written."""
        if self._runs is None:
            self._runs = SortedRuns(*self._places)
        self._runs.add(self._take())

    def result(self, combine: Combine) -> Rows | StoredRows:
        """All rows, sorted by key; memory is emptied. Those of one key are combined as by `SortedRuns.merge`."""
        if self._runs is None:
            return self._take()
        self.spill()
        stored, self._runs = self._runs.merge(combine), None
        return stored

    def state(self) -> State | None:
        """State of the runs for `restore`, after all rows were moved to the disk; None without any."""
        if self.used:
            self.spill()
        return None if self._runs is None else self._runs.state()

    def restore(self, state: State | None) -> None:
        """Take over the runs in the folder. Raises InputError when they are missing."""
        if state is not None:
            self._runs = SortedRuns(*self._places)
            self._runs.restore(state)

    def _take(self) -> Rows:
        """Sorted rows in memory, which is emptied."""
        rows = self.rows[: self.used]
        rows = rows[np.argsort(rows[:, 0])]
        self.rows, self.used = np.empty_like(self.rows), 0
        self.slots[:] = -1
        return rows

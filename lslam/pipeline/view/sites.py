"""`lslam view`: a run on its server, and those that its corrections lead to; its page, and its map in tiles."""

from __future__ import annotations

import json
import logging
import os
import shutil
import tempfile
import threading
from collections.abc import Sequence
from contextvars import copy_context
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from lslam.core.arrays import Floats
from lslam.core.errors import (
    InputError,
    InterruptedRunError,
    LslamError,
    OutputError,
    UsageError,
    input_errors,
)
from lslam.core.geometry import se3
from lslam.core.kernels.cache import cache_folder
from lslam.core.types.cloud import thin_out
from lslam.core.types.trajectory import Trajectory
from lslam.core.untrusted import parse_json
from lslam.io.formats.point_files import MapCloud
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.maps.octree import points_of, write_octree
from lslam.pipeline.merge_runs import sessions_of
from lslam.pipeline.rebuild import read_run
from lslam.pipeline.resume import listing_digest
from lslam.pipeline.run_folder import SESSIONS, require_odometry
from lslam.pipeline.stored_map import map_of
from lslam.pipeline.view.corrections import Corrections, GraphJob
from lslam.pipeline.view.server import Answer, RunServer, Site
from lslam.reports.page_data import pack
from lslam.reports.png import usual_range
from lslam.reports.shell import RUN, policy, script_of

log = logging.getLogger("lslam")
REPORT, TRAJECTORY = "report.html", "trajectory.tum"
TALKS = "connect-src 'self'"
SERVED = '<script type="application/json" id="served">{}</script>\n'  # tells the page's script
MERGE_REFUSAL = "is a merge, whose loops cannot be corrected: correct its runs with lslam view, and merge them again"
# Of the nodes and of their index; raise VERSION when either means something else. Octrees that are kept, the last used ones.
NODES, TREE, VERSION, MOST_OCTREES = "nodes.bin", "tree.json", 1, 8
SAMPLE = 400_000  # points whose intensities give the range that is shown


class ViewedSites:
    """The runs of a server, the first one first; `stop` ends their threads and processes."""

    def __init__(self, server: RunServer) -> None:
        self._server = server
        self._tiles: list[MapTiles] = []
        self._job: GraphJob | None = None
        self._of: Corrections | None = None
        self._page = ""
        self._lock = threading.Lock()

    def add(self, folder: Path) -> int:
        """Serve a run, or a merge of several. Returns its number. Raises InputError for what is none."""
        number, gets, why_not = len(self._server.sites), dict[str, Any](), ""
        posts: dict[str, Any] = dict.fromkeys(("api/edits", "api/graph"), partial(_refuse, folder))
        if (names := sessions_of(folder)) is not None:
            tracks = [read_trajectory(folder / SESSIONS / f"{name}.tum", "tum").positions for name in names]
        else:
            corrections = Corrections(folder)
            tracks = [corrections.run.trajectory.positions]
            if old := corrections.run.config.localize.map:
                why_not = f"the page shows the old map, {old}, where it differs from the drive"
            gets = {
                "api/edits": corrections.edits,
                "api/pair": corrections.pair,
                "api/graph": lambda words: self._state(number),
            }
            posts = {
                "api/edits": corrections.save,
                "api/graph": lambda document: self._begin(corrections, number),
                "api/stop": lambda document: self._end(number),
            }
        tiles = MapTiles(folder.resolve(), tracks, why_not)
        self._tiles.append(tiles)
        gets["tiles/tree.json"] = tiles.tree
        self._server.sites.append(Site(folder, lambda: page_of(folder), gets, posts, tiles.node))
        tiles.start()
        return number

    def stop(self) -> None:
        """End the child and the tiles that are being built."""
        with self._lock:
            if self._job is not None:
                self._job.stop()
        for tiles in self._tiles:
            tiles.stop()

    def _begin(self, corrections: Corrections, number: int) -> dict[str, Any]:
        """Start `lslam graph`. Raises UsageError while one is at work, or without corrections."""
        with self._lock:
            if self._job is not None and self._job.is_running:
                raise UsageError(f"lslam graph is at work on {self._job.out.name}: wait, or stop it")
            require_odometry(corrections.folder)
            self._job = GraphJob(corrections.folder, corrections.arguments())
            self._of, self._page = corrections, ""
        return self._state(number)

    def _end(self, number: int) -> dict[str, Any]:
        """Stop a running `lslam graph`. Returns the state."""
        if self._job is not None:
            self._job.stop()
        return self._state(number)

    def _state(self, number: int) -> dict[str, Any]:
        """State of the running `lslam graph`; when done, also the page of the new run and how much its poses changed."""
        with self._lock:
            if self._job is None or self._of is None:
                return {"state": "none"}
            state = self._job.state()
            if state["state"] != "done":
                return state
            self._page = self._page or f"{self.add(self._job.out)}/"
            page = self._page if number == 0 else f"../{self._page}"
            return {
                **state,
                "page": page,
                **change_between(self._of.run.trajectory, read_run(self._job.out).trajectory),
            }


def change_between(old: Trajectory, new: Trajectory) -> dict[str, Any]:
    """The new positions, with the first pose where the old one is, and how far they moved, m."""
    T = old.poses[0] @ se3.inverse(new.poses[0])
    positions = se3.apply(T, new.positions)
    shared, mine, other = np.intersect1d(old.stamps_ns, new.stamps_ns, return_indices=True)
    moved = np.linalg.norm(positions[other] - old.positions[mine], axis=1) if len(shared) else np.zeros(1)
    return {"positions": pack(positions, "<f4"), "most_m": float(moved.max()), "mean_m": float(moved.mean())}


def page_of(folder: Path) -> Answer:
    """Answer with the report of a run; one of another version is sandboxed, so that its script has no access here.

    Raises InputError when it cannot be read.
    """
    with input_errors(folder / REPORT):
        text = (folder / REPORT).read_text(encoding="utf-8")
    if not is_ours(text):
        return _page(text, "sandbox allow-scripts allow-downloads")
    own = policy(script_of(RUN))
    text = text.replace(own, f"{own}; {TALKS}", 1)
    text = text.replace("<main>", SERVED + "<main>", 1)
    return _page(text, f"{own}; {TALKS}")


def is_ours(text: str) -> bool:
    """Whether a page has the script of this version."""
    return policy(script_of(RUN)) in text


def require_page(folder: Path) -> None:
    """Raise InputError where nothing can be shown; say so where the page is of another version, or cannot be corrected."""
    is_merge = sessions_of(folder) is not None
    if not (is_merge or (folder / TRAJECTORY).is_file()):
        raise InputError(
            f"{folder} has no {TRAJECTORY}: the run ended before it had a pose, so there is nothing to show"
        )
    way = "lslam merge" if is_merge else f"lslam graph {folder}"
    if not (folder / REPORT).is_file():
        raise InputError(f"{folder} has no {REPORT}: make one with {way}")
    with input_errors(folder / REPORT):
        text = (folder / REPORT).read_text(encoding="utf-8", errors="replace")
    if not is_ours(text):
        log.warning(
            "%s is of another version of lslam: it is shown without tiles and corrections; %s makes a new one",
            folder / REPORT,
            way,
        )
    elif is_merge:
        log.info("%s %s", folder, MERGE_REFUSAL)


def _refuse(folder: Path, document: Any) -> None:
    """Raise UsageError: a merge cannot be corrected on its page."""
    raise UsageError(f"{folder} {MERGE_REFUSAL}")


def _page(text: str, rules: str) -> Answer:
    """Answer with a page and its content security policy."""
    return Answer("text/html; charset=utf-8", text.encode(), headers=(("Content-Security-Policy", rules),))


class MapTiles:
    """The octree of a run's map. `start` finds or builds it in a thread, `stop` ends that; `why_not` says why there is none.

    tracks : (N, 3) m, positions of each trajectory; a point of a tile knows the nearest pose of one, or the nearest of several
    """

    def __init__(self, run: Path, tracks: Sequence[Floats], why_not: str = "") -> None:
        self._run, self._tracks = run, tracks
        self._tree: dict[str, Any] = {}
        self._folder = Path()
        self._said: dict[str, Any] = {"error": why_not} if why_not else {"share": 0.0}
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=copy_context().run, args=(self._build,), name="lslam-tiles", daemon=True)

    def start(self) -> None:
        """Find or build the octree in a thread, unless `why_not` says that there can be none."""
        if "error" not in self._said:
            self._thread.start()

    def stop(self) -> None:
        """Stop the thread and delete the unfinished octree."""
        self._is_over.set()
        if self._thread.is_alive():
            self._thread.join()

    def tree(self, words: object = None) -> dict[str, Any]:
        """The index, its nodes with their numbers of points alone; `share` while it is built, `error` where it cannot be."""
        if not self._tree:
            return self._said
        return {**self._tree, "nodes": {name: count for name, (_, count) in self._tree["nodes"].items()}}

    def node(self, name: str) -> bytes | None:
        """A node as `write_octree` has it, then the nearest pose, or trajectory, of each point, uint32; None without points."""
        begin, count = self._tree.get("nodes", {}).get(name, (0, 0))
        if not count:
            return None
        size = 6 + sum(self._tree["columns"].values())
        with (self._folder / NODES).open("rb") as stream:
            stream.seek(begin)
            data = stream.read(count * size)
        points = points_of(name, data[: 6 * count], self._tree)
        nearest = self._nearest.query(points)[1]
        if len(self._tracks) > 1:
            nearest = np.searchsorted(np.cumsum([len(track) for track in self._tracks]), nearest, side="right")
        return data + nearest.astype("<u4").tobytes()

    @cached_property
    def _nearest(self) -> cKDTree:
        return cKDTree(np.nan_to_num(np.concatenate(self._tracks), nan=1e12))

    def _build(self) -> None:
        """Find the octree in the cache or build it; failures are logged and reported in the state."""
        try:
            stored = map_of(self._run)
            base = cache_folder("octrees")
            if base is None:
                raise OutputError("tiles need a folder: name one of your own in XDG_CACHE_HOME")
            folder = base / f"{VERSION}-{listing_digest(stored.path)}"
            if not (folder / TREE).is_file():
                self._write(folder, stored.cloud(("class",)))
            tree = parse_json((folder / TREE).read_text(encoding="utf-8"))
            os.utime(folder)
            _forget(base, folder)
            self._folder, self._tree = folder, tree
        except InterruptedRunError:
            return
        except (LslamError, OSError, ValueError) as error:
            log.warning("no tiles: %s", error)
            self._said = {"error": str(error)}

    def _write(self, folder: Path, cloud: MapCloud) -> None:
        """Write the octree of the cloud into `folder`, by way of a temporary folder."""
        sample = thin_out(cloud, SAMPLE).intensity
        shades = usual_range(np.zeros(0) if sample is None else sample.astype(np.float64))
        with tempfile.TemporaryDirectory(prefix="part-", dir=folder.parent) as place:
            with (Path(place) / NODES).open("wb") as stream:
                tree = write_octree(stream, Path(place), cloud, shades, self._on_share)
            (Path(place) / TREE).write_text(json.dumps(tree), encoding="utf-8")
            folder.mkdir(exist_ok=True)
            for name in (NODES, TREE):  # the index last: with it the octree is there
                os.replace(Path(place) / name, folder / name)

    def _on_share(self, share: float) -> None:
        """Report the share of the octree that is written, 0 to 1. Raises InterruptedRunError after `stop`."""
        if self._is_over.is_set():
            raise InterruptedRunError("interrupted while tiles were built")
        self._said = {"share": share}


def _forget(base: Path, own: Path) -> None:
    """Remove octrees that have not been used for longest, and what killed processes left."""
    folders = sorted((path for path in base.iterdir() if path.is_dir()), key=lambda path: -path.stat().st_mtime)
    for path in [path for path in folders if path != own][MOST_OCTREES - 1 :]:
        shutil.rmtree(path, ignore_errors=True)

"""`lslam view`: a run on its server, and those that its corrections lead to."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.errors import UsageError
from lslam.core.geometry import se3
from lslam.core.types.trajectory import Trajectory
from lslam.pipeline.rebuild import read_run
from lslam.pipeline.run_folder import require_odometry
from lslam.pipeline.view.corrections import Corrections
from lslam.pipeline.view.graph_job import GraphJob
from lslam.pipeline.view.page import page_of
from lslam.pipeline.view.server import RunServer, Site
from lslam.pipeline.view.tiles import MapTiles
from lslam.reports.page_data import pack


class ViewedSites:
    """The runs of a server, the one that was named first; `stop` ends what works for them."""

    def __init__(self, server: RunServer) -> None:
        self._server = server
        self._tiles: list[MapTiles] = []
        self._job: GraphJob | None = None
        self._of: Corrections | None = None
        self._page = ""
        self._lock = threading.Lock()

    def add(self, folder: Path) -> int:
        """Serve a run. Returns its number. Raises InputError for what is none."""
        corrections, number = Corrections(folder), len(self._server.sites)
        tiles = MapTiles(folder.resolve(), corrections.run.trajectory.positions)
        self._tiles.append(tiles)
        self._server.sites.append(
            Site(
                folder,
                lambda: page_of(folder),
                gets={
                    "api/edits": corrections.edits,
                    "api/pair": corrections.pair,
                    "api/graph": lambda words: self._state(number),
                    "tiles/tree.json": tiles.tree,
                },
                posts={
                    "api/edits": corrections.save,
                    "api/graph": lambda document: self._begin(corrections, number),
                    "api/stop": lambda document: self._end(number),
                },
                node=tiles.node,
            )
        )
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
        if self._job is not None:
            self._job.stop()
        return self._state(number)

    def _state(self, number: int) -> dict[str, Any]:
        """What the child does; once it is done what has changed, and the page of its run."""
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

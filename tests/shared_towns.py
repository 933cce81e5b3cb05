"""Towns of scenarios that are built once, and scans that a worker traces once, however many tests ask for them."""

from __future__ import annotations

import hashlib
import os
import pickle
import time
from collections import OrderedDict
from collections.abc import Callable
from itertools import count
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np

from lslam.core.types.scan import Scan
from lslam.simulation import built_scenario
from lslam.simulation.city import City
from lslam.simulation.curve import RouteCurve, Terrain
from lslam.simulation.scenario_files import Scenario
from lslam.simulation.scenarios import SimulatedDrive
from lslam.simulation.scene_mesh import RayScene, SceneMesh
from lslam.studies.worker import ScanStore

HELD = 5  # towns, of some 100 MB each with what rays need
HELD_BYTES = 300_000_000  # of scans
KEPT_S = 0.2  # that a town takes, from which on it is kept in a file, of some 10 MB


class Towns:
    """Stands in for the two steps of `simulate` that take long: the town round a street, and the scene of its mesh.

    A town is known by all that it is built of, to the byte, the state of the generator among it. Large ones lie in `folder`,
    where all workers look; None keeps them in memory alone.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder
        self._build = built_scenario._city
        self._held: OrderedDict[str, City] = OrderedDict()
        self._scenes: dict[str, RayScene] = {}

    def city(self, scenario: Scenario, street: RouteCurve, terrain: Terrain, rng: np.random.Generator) -> City:
        given = pickle.dumps((scenario.world, scenario.layout, street, terrain, rng.bit_generator.state))
        key = hashlib.sha256(given).hexdigest()
        if key not in self._held:
            self._held[key] = self._read(key) or self._built(key, scenario, street, terrain, rng)
        self._held.move_to_end(key)
        while len(self._held) > HELD:
            self._scenes.pop(self._held.popitem(last=False)[0], None)
        return self._held[key]

    def _read(self, key: str) -> City | None:
        """The town in its file, if it has one."""
        if self.folder is None or not (self.folder / key).exists():
            return None
        city: City = pickle.loads((self.folder / key).read_bytes())
        return city

    def _built(
        self, key: str, scenario: Scenario, street: RouteCurve, terrain: Terrain, rng: np.random.Generator
    ) -> City:
        """The town, written to its file when it took long."""
        begin = time.process_time()
        city = self._build(scenario, street, terrain, rng)
        if self.folder is not None and time.process_time() - begin > KEPT_S:
            part = self.folder / f"{key}.{os.getpid()}"
            part.write_bytes(pickle.dumps(city))
            part.replace(self.folder / key)
        return city

    def scene(self, mesh: SceneMesh) -> RayScene:
        """The one of a town that is held, else a new one."""
        for key, city in self._held.items():
            if city.mesh is mesh:
                if key not in self._scenes:
                    self._scenes[key] = RayScene(mesh)
                return self._scenes[key]
        return RayScene(mesh)


class TracedScans:
    """Stands in for `SimulatedDrive.scan`: what one drive has traced is kept, for the next run that it is given to."""

    def __init__(self, most_bytes: int = HELD_BYTES) -> None:
        self._store, self._numbers = ScanStore(most_bytes), count()
        self._drives: WeakKeyDictionary[SimulatedDrive, int] = WeakKeyDictionary()

    def once(self, trace: Callable[[SimulatedDrive, int], Scan]) -> Callable[[SimulatedDrive, int], Scan]:
        """As `trace`, but for the time that it takes."""

        def scan(drive: SimulatedDrive, index: int) -> Scan:
            if drive not in self._drives:
                self._drives[drive] = next(self._numbers)
            return self._store.get((self._drives[drive], index), lambda: trace(drive, index))

        return scan

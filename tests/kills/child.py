"""`lslam` as a user calls it, which beside that says on a pipe in which stage it is.

Nothing is imported sooner than without: the functions that begin a stage are wrapped when their module is loaded.
"""

from __future__ import annotations

import os
import runpy
import sys
from collections.abc import Callable
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

START, FOLDER, KERNELS, ODOMETRY, LOOPS, GRAPH, OSM, FILES, MAP, MAP_END, REPORT, END = STAGES = (
    "start", "folder", "kernels", "odometry", "loops", "graph", "osm", "files", "map", "map's end", "report", "end",
)  # fmt: skip
# What begins a stage: module -> name (of a class, behind a dot: of its method) -> stage.
MARKS = {
    "lslam.pipeline.run": {"run": FOLDER},
    "lslam.pipeline.stages": {
        "write_back_end": FILES, "make_map": MAP, "make_report": REPORT, "RunFolder.drop_checkpoint": END,
    },
    "lslam.pipeline.odometry_pass": {"_warm_up": KERNELS, "estimate": ODOMETRY},
    "lslam.pipeline.back_end_pass": {"find_loops": LOOPS, "run_back_end": GRAPH, "hold_by_buildings": OSM},
    "lslam.pipeline.map_pass": {"MapMaker.finish": MAP_END},
}  # fmt: skip


class Marker(MetaPathFinder):
    """Wraps the functions of `MARKS`; `tell` is called with the stage that begins."""

    def __init__(self, tell: Callable[[str], object]) -> None:
        self._tell = tell
        self._told = set[str]()

    def find_spec(self, name: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        """As Python finds it, with one more thing done once it is loaded."""
        spec = PathFinder.find_spec(name, path, target) if name in MARKS else None
        if spec is None or spec.loader is None:
            return None
        load = spec.loader.exec_module

        def load_and_mark(module: ModuleType) -> None:
            load(module)
            for names, stage in MARKS[name].items():
                *owners, last = names.split(".")
                owner: Any = module
                for part in owners:
                    owner = getattr(owner, part)
                setattr(owner, last, self._wrapped(getattr(owner, last), stage))

        spec.loader.exec_module = load_and_mark  # type: ignore[method-assign]
        return spec

    def _wrapped(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        def begun(*given: Any, **named: Any) -> Any:
            if stage != END or REPORT in self._told:  # a folder that is used anew is cleared in the same way
                self._told.add(stage)
                self._tell(stage)
            return function(*given, **named)

        return begun


if __name__ == "__main__":
    pipe, *words = sys.argv[1:]
    number = int(pipe)
    os.set_inheritable(number, False)
    sys.meta_path.insert(0, Marker(lambda stage: os.write(number, f"{stage}\n".encode())))
    sys.argv = ["lslam", *words]
    runpy.run_module("lslam", run_name="__main__", alter_sys=False)

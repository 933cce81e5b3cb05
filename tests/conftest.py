"""What tests of several rooms share: the real recordings, unpacked once per session, absent on most machines."""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import blas_kernels  # noqa: F401
import pytest
from compiled_once import compile_once
from hypothesis import settings
from shared_towns import Towns, TracedScans
from sought_starts import SoughtStarts

from lslam.core.errors import InputError
from lslam.core.extras import importing_open3d
from lslam.registration.policies import best_by_non_ground
from lslam.simulation.scenarios import SimulatedDrive

if TYPE_CHECKING:
    from made_once import MadeOnce

pytest_plugins = ["made_once", "perturbed_scans", "shared_odometry", "shared_starts", "tiers"]
compile_once()

# How long an example takes is the machine's affair.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

# The hundred processes that tests start would each compile what they import of lslam anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# What tests start away from here runs these sources, as their workers do, and not the lslam that is installed: numba keeps
# kernels by the files that they come from, and would compile them all once more. The one that is installed is test_run_machine's.
# Workers inherit both from the process that starts them.
GIVEN = os.environ.setdefault("PYTHONPATH_GIVEN", os.environ.get("PYTHONPATH", ""))
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(Path(__file__).resolve().parents[1]), GIVEN)))


# Collecting makes millions of objects that stay: a quarter of its time went into looking for those that do not.
COLLECTS_GARBAGE = gc.get_threshold()
gc.set_threshold(100_000)


def pytest_collection_finish() -> None:
    """From here on garbage is collected as usual, among what the tests make."""
    gc.freeze()
    gc.set_threshold(*COLLECTS_GARBAGE)


def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores: what waits for a process that it started, or for a lock, leaves one idle."""
    return (os.cpu_count() or 1) + 1


def pytest_sessionstart(session: pytest.Session) -> None:
    """Each worker imports the test modules from another one on, and finds compiled what the others have imported.

    In one order all of them would rewrite the same assertions at the same time: 25 s of a core, by each.
    """
    from tiers import is_passed_over

    worker = getattr(session.config, "workerinput", None)
    if worker is None:
        return
    folders = [Path(arg) for arg in session.config.args if Path(arg).is_dir()]
    modules = sorted({path.resolve() for folder in folders for path in folder.rglob("test_*.py")})
    # A room's own conftest.py is a module of the same name as this one, which pytest puts in its place when it comes there.
    here = Path(__file__).parent
    modules = [path for path in modules if path.parent == here or not (path.parent / "conftest.py").exists()]
    modules = [path for path in modules if not is_passed_over(path, session.config)]
    begin = int(worker["workerid"].removeprefix("gw")) * len(modules) // worker["workercount"]
    for path in modules[begin:] + modules[:begin]:
        sys.path.insert(0, str(path.parent))
        # Whatever is wrong with it, collecting says so.
        with contextlib.suppress(Exception, pytest.skip.Exception):
            import_module(path.stem)
        sys.path.remove(str(path.parent))


SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def recordings(made_once: MadeOnce) -> Callable[[str], Path]:
    """`recordings(name)` unpacks one recording and gives the folder it lies in; the test skips where there is none."""

    def unpack(name: str) -> Path:
        if not (SHARED / "unpack.py").is_file() or not any(SHARED.glob(f"{name}.*")):
            pytest.skip(f"recording {name} is not on this machine")
        call = [sys.executable, str(SHARED / "unpack.py"), str(made_once.folder), name]
        made_once(name, lambda: subprocess.run(call, check=True, capture_output=True))
        return made_once.folder

    return unpack


TOWNS, SCANS, STARTS = Towns(), TracedScans(), SoughtStarts()


@pytest.fixture(scope="module", autouse=True)
def shared_towns(request: pytest.FixtureRequest, made_once: MadeOnce) -> Iterator[None]:
    """Towns are built once, and a drive traces its scans once, for all tests but those of the simulator.

    A module's own `SHARES_TOWNS` says otherwise: what measures memory must not hold the scans that others may ask for.
    """
    TOWNS.folder = made_once.folder / "towns"
    TOWNS.folder.mkdir(parents=True, exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        if getattr(request.module, "SHARES_TOWNS", request.path.parent.name != "simulation"):
            patch.setattr("lslam.simulation.built_scenario._city", TOWNS.city)
            patch.setattr("lslam.simulation.scenarios.RayScene", TOWNS.scene)
            patch.setattr(SimulatedDrive, "scan", SCANS.once(SimulatedDrive.scan))
        yield


@pytest.fixture(scope="module", autouse=True)
def shared_starts(request: pytest.FixtureRequest, made_once: MadeOnce) -> Iterator[None]:
    """A first step is sought once, however many runs take it, for all tests but those of registration."""
    STARTS.folder = made_once.folder / "starts"
    STARTS.folder.mkdir(parents=True, exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        if request.path.parent.name != "registration":
            patch.setattr("lslam.registration.policies.best_by_non_ground", STARTS.best_by_non_ground)
        yield


@pytest.fixture
def starts_sought_anew(shared_starts: None) -> Iterator[None]:
    """Nothing of an earlier run is taken: for the repetition that must give the same bytes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lslam.registration.policies.best_by_non_ground", best_by_non_ground)
        yield


@pytest.fixture(scope="session")
def open3d() -> ModuleType:
    """Open3D; the test skips where a bare machine lacks the libGL, libEGL or libX11 that its wheel wants."""
    try:
        with importing_open3d():
            import open3d
    except InputError as error:
        pytest.skip(str(error))
    return open3d  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def forked_runs() -> Iterator[None]:
    """The processes of studies are forked by a server that has imported what a run needs, and loaded its kernels.

    To do it anew takes a process longer than a short run. That they are spawned is test_runner's.
    """
    context = get_context("forkserver")
    context.set_forkserver_preload(["warmed_server"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        ensure_running()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lslam.studies.runner.get_context", lambda _: context)
        yield

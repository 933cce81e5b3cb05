"""Methods by name, our own and those of other packages."""

from __future__ import annotations

import importlib.metadata
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from lslam.core.config.config import Config
from lslam.core.errors import UsageError
from lslam.odometry import METHODS, create_odometry, known_methods
from lslam.odometry.base import Traits
from lslam.registration.residuals import RESIDUALS

FAMILY = ("gicp", "vgicp", "ndt")


SAMPLE_POSES = Path(__file__).resolve().parents[2] / "sample_data" / "poses" / "00.txt"


def config(method: str) -> Config:
    poses = str(SAMPLE_POSES) if method == "poses" else ""
    return Config.model_validate({"odometry": {"method": method, "poses": poses}})


class Foreign(Traits):
    """What another package's factory returns."""

    def __init__(self, made_from: Config) -> None:
        self.made_from = made_from


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Two methods of another package, one of them under a name of ours; the groups that were asked for."""
    asked: list[str] = []

    def entry_points(group: str) -> list[EntryPoint]:
        asked.append(group)
        return [EntryPoint(name, f"{__name__}:Foreign", group) for name in ("their-icp", "icp")]

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    return asked


@pytest.mark.parametrize("name", sorted(METHODS))
def test_every_method_can_be_made_and_says_what_it_is(name: str, request: pytest.FixtureRequest) -> None:
    if name == "kiss-icp":
        pytest.importorskip("kiss_icp")
    if name == "open3d-gicp":
        request.getfixturevalue("open3d")
    method = create_odometry(config(name))
    assert all(callable(getattr(method, verb)) for verb in ("prepare", "register", "warm_up"))
    assert len(known_methods()[name]) > 10


@pytest.mark.parametrize(
    ("wrong", "hint"),
    [("ipc", "did you mean 'icp', 'lips' or 'gicp'?"), ("kis_icp", "did you mean 'kiss-icp'?"), ("zzz", "known: icp")],
)
def test_an_unknown_method_is_refused_with_the_nearest(wrong: str, hint: str) -> None:
    with pytest.raises(UsageError) as caught:
        create_odometry(config(wrong))
    assert repr(wrong) in str(caught.value)
    assert hint in str(caught.value)
    assert caught.value.exit_code == 2


def test_other_packages_add_methods_by_entry_point(foreign: list[str]) -> None:
    wanted = config("their-icp")
    made: Any = create_odometry(wanted)
    assert type(made).__name__ == "Foreign"
    assert made.made_from is wanted
    assert known_methods()["their-icp"] == f"from {__name__}:Foreign"
    assert set(foreign) == {"lslam.methods"}


def test_a_foreign_method_cannot_take_the_place_of_ours(foreign: list[str]) -> None:
    assert type(create_odometry(config("icp"))).__name__ == "Icp"
    assert "Gaussian voxels" in known_methods()["icp"]


def test_foreign_names_are_suggested_too(foreign: list[str]) -> None:
    with pytest.raises(UsageError, match="did you mean 'their-icp'"):
        create_odometry(config("their_icp"))


@pytest.mark.parametrize(("method", "residual"), [("icp", "plane"), ("icp-point", "point"), *((n, n) for n in FAMILY)])
def test_methods_named_after_their_residual_use_it(method: str, residual: str) -> None:
    made: Any = create_odometry(config(method))
    assert made.registration.target.kind is RESIDUALS[residual]
    same = Config.model_validate({"odometry": {"method": method}, "registration": {"residual": residual}})
    again: Any = create_odometry(same)
    assert again.registration.target.kind is RESIDUALS[residual]


@pytest.mark.parametrize("residual", ["point", "plane", *FAMILY])
def test_icp_takes_any_residual_and_the_others_none_but_their_own(residual: str) -> None:
    chosen = {"registration": {"residual": residual}}
    made: Any = create_odometry(Config.model_validate(chosen))
    assert made.registration.target.kind is RESIDUALS[residual]
    other = "ndt" if residual != "ndt" else "gicp"
    with pytest.raises(UsageError, match=f"--method icp --residual {residual}"):
        create_odometry(Config.model_validate({"odometry": {"method": other}, **chosen}))

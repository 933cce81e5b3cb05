"""The Python API on arrays and paths: what `import lslam` offers, and that its examples run."""

from __future__ import annotations

import doctest
import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import lslam
from lslam.core.config.config import Config
from lslam.core.errors import InputError, UsageError
from lslam.core.types.trajectory import Trajectory

SAMPLE = Path(__file__).resolve().parents[1] / "sample_data"


def few_scans(**sections: dict[str, object]) -> Config:
    return Config.model_validate({"input": {"count": 12}, "report": {"html": False}} | sections)


def test_importing_costs_next_to_nothing() -> None:
    heavy = "numba numpy scipy kiss_icp open3d gtsam pydantic matplotlib"
    code = f"import sys, lslam; print([m for m in {heavy.split()!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", lslam.__all__)
def test_every_name_is_there_and_documented(name: str) -> None:
    part = getattr(lslam, name)
    if name != "__version__":
        assert part.__doc__
        assert part.__name__ == {"Registration": "Registration"}.get(name, name)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'registration_'"):
        _ = lslam.registration_


def test_registration_on_arrays_follows_a_moving_sensor() -> None:
    rng = np.random.default_rng(0)

    def scan(x: float) -> NDArray[np.float64]:
        u = rng.uniform(-8, 8, (4, 6000))
        floor = np.column_stack([u[0], u[1], rng.normal(-1.5, 0.01, 6000)])
        walls = [np.column_stack([np.full(6000, w), u[2], u[3] / 4]) for w in (-8.0, 8.0)]
        sides = [np.column_stack([u[2], np.full(6000, w), u[3] / 4]) for w in (-8.0, 8.0)]
        return np.concatenate([floor, *walls, *sides]) - [x, 0.0, 0.0]

    registration = lslam.Registration()
    for k in range(6):
        result = registration.register(scan(0.4 * k))
        assert result.ok
        np.testing.assert_allclose(result.T_world_lidar[:3, 3], [0.4 * k, 0.0, 0.0], atol=0.01)


def test_open_run_and_evaluate_without_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    sequence = lslam.open_sequence(SAMPLE)
    assert sequence.scan(0).points.shape[1] == 3
    outcome = lslam.run(sequence, few_scans())
    assert list(tmp_path.iterdir()) == []
    assert len(outcome.trajectory) == 12
    assert outcome.trajectory.covariances is not None
    assert sequence.ground_truth is not None
    evaluation = lslam.evaluate(outcome.trajectory, sequence.ground_truth)
    assert evaluation.matched == 12
    translation = evaluation.ate["origin"].translation
    assert translation is not None
    assert translation.rmse < 0.03
    assert outcome.evaluation is not None
    assert outcome.evaluation.ate["origin"].translation == translation


@pytest.mark.usefixtures("starts_sought_anew")
def test_run_takes_a_path_and_gives_the_same_every_time() -> None:
    first, second = (lslam.run(str(SAMPLE), few_scans()).trajectory for _ in range(2))
    one_thread = lslam.run(SAMPLE, few_scans(input={"count": 12, "threads": 1})).trajectory
    for other in (second, one_thread):
        assert other.poses.tobytes() == first.poses.tobytes()
        assert np.asarray(other.covariances).tobytes() == np.asarray(first.covariances).tobytes()
    assert first.stamps_ns.tobytes() == second.stamps_ns.tobytes()


def test_another_ground_truth_can_be_given() -> None:
    sequence = lslam.open_sequence(SAMPLE)
    assert sequence.ground_truth is not None
    moved = Trajectory(sequence.ground_truth.stamps_ns, sequence.ground_truth.poses.copy())
    moved.poses[:, 0, 3] *= 1.5
    outcome = lslam.run(sequence, few_scans(), ground_truth=moved)
    assert outcome.evaluation is not None
    translation = outcome.evaluation.ate["origin"].translation
    assert translation is not None
    assert translation.rmse > 0.5


def test_errors_are_those_of_lslam(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere"):
        lslam.open_sequence(tmp_path / "nowhere")
    with pytest.raises(InputError, match="nowhere"):
        lslam.run(tmp_path / "nowhere")
    with pytest.raises(InputError, match="shape"):
        lslam.Registration().register(np.zeros((5, 2)))
    few = Trajectory(np.arange(2, dtype=np.int64), np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(InputError, match="3"):
        lslam.evaluate(few, few)


def test_an_unknown_method_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    config = few_scans(odometry={"method": "icpp"})
    with pytest.raises(UsageError, match="did you mean 'icp'"):
        lslam.run(SAMPLE, config, out=tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def modules_with_examples() -> list[str]:
    root = Path(lslam.__file__).parent
    found = [p for p in sorted(root.rglob("*.py")) if ">>> " in p.read_text(encoding="utf-8")]
    return [".".join(p.relative_to(root.parent).with_suffix("").parts).removesuffix(".__init__") for p in found]


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_in_docstrings_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder that has `sample_data`, as the README's reader has."""
    if name == "lslam":
        if not (SAMPLE / "sequences").is_dir():
            pytest.skip("sample_data is not here")
        os.symlink(SAMPLE, tmp_path / "sample_data")
    monkeypatch.chdir(tmp_path)
    failed, attempted = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert attempted > 0
    assert failed == 0


def test_a_sequence_is_indexed_from_both_ends_and_walked_through() -> None:
    sequence = lslam.open_sequence(SAMPLE)
    assert sequence[0].index == 0
    assert sequence[-1].index == len(sequence) - 1
    np.testing.assert_array_equal(sequence[3].points, sequence.scan(3).points)
    drive = lslam.simulate("block", count=3, lidar="vlp16")
    assert [scan.index for scan in drive] == [0, 1, 2]
    with pytest.raises(IndexError):
        _ = sequence[len(sequence)]


def test_an_outcome_has_the_map_the_errors_and_figures(tmp_path: Path) -> None:
    outcome = lslam.run(SAMPLE, few_scans(), out=tmp_path / "run")
    assert outcome.map is not None
    assert len(outcome.map) == outcome.record.manifest["map_points"]
    assert outcome.errors is not None
    assert outcome.evaluation is not None
    rmse = outcome.evaluation.ate["se3"].translation
    assert rmse is not None
    assert np.sqrt(np.mean(outcome.errors**2)) == pytest.approx(rmse.rmse)
    assert outcome.plot("map").axes
    with pytest.raises(UsageError, match="did you mean 'errors'"):
        outcome.plot("error")
    assert "<pre>block-0, icp" in outcome._repr_html_()
    bare = lslam.run(lslam.simulate("block", count=8, lidar="vlp16"), few_scans())
    assert bare.map is None
    with pytest.raises(InputError, match="has no map"):
        bare.plot("map")


@pytest.mark.usefixtures("forked_runs")
def test_a_comparison_from_python_has_all_runs(tmp_path: Path) -> None:
    words = ("input.count=6", "map.write=false", "report.html=false")
    compared = lslam.compare([SAMPLE], ["icp", "icp-point"], out=tmp_path / "out", settings=words)
    assert compared.comparison.methods == ("icp", "icp-point")
    assert len(compared.comparison.runs) == 2
    assert not compared.comparison.failed
    assert (compared.folder / "compare.html").is_file()
    assert compared.table("csv").count("\n") == 2
    with pytest.raises(UsageError, match="exists"):
        lslam.compare([SAMPLE], ["icp"], out=tmp_path / "out")


def test_completion_offers_the_api_and_settings_choose_the_method() -> None:
    assert {"run", "open_sequence", "evaluate", "load_config", "simulate", "compare", "Registration"} <= set(dir(lslam))
    assert all(hasattr(lslam, name) for name in dir(lslam))
    outcome = lslam.run(SAMPLE, lslam.load_config(settings=["odometry.method=gicp", "input.count=4"]))
    assert outcome.record.method == "gicp"

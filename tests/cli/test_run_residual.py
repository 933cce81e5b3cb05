"""`lslam run --residual` and the methods named after a residual, at the terminal."""

from __future__ import annotations

from pathlib import Path

import pytest
from calling import SAMPLE, assert_one_sentence, lslam, strict_json


def test_a_residual_by_flag_and_its_method_are_the_same(tmp_path: Path) -> None:
    files = []
    for k, words in enumerate((["--method", "ndt"], ["--residual", "ndt"], [])):
        out = tmp_path / str(k)
        done = lslam("run", SAMPLE, "--count", 12, *words, "--out", out, "--json", "-q")
        assert done.returncode == 0, done.stderr
        assert strict_json(done.stdout)["evaluation"]["ate"]["se3"]["rmse"] < 0.03
        files.append([x for x in (out / "trajectory.tum").read_text().splitlines() if not x.startswith("#")])
    assert files[0] == files[1] != files[2]


def test_the_configuration_of_a_run_can_be_run_again(tmp_path: Path) -> None:
    for name, words in (("a", ["--method", "gicp"]), ("b", ["--config", tmp_path / "a" / "config.toml"])):
        done = lslam("run", SAMPLE, "--count", 5, *words, "--out", tmp_path / name, "-q")
        assert done.returncode == 0, done.stderr
    a, b = ((tmp_path / name / "trajectory.tum").read_text() for name in "ab")
    assert a == b


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["--method", "gicp", "--residual", "ndt"], "--method icp --residual ndt"),
        (["--method", "gicp", "--set", "registration.residual=plane"], "--method icp --residual plane"),
        (["--method", "kiss-icp", "--residual", "ndt"], "does nothing with method kiss-icp"),
        (["--residual", "ntd"], "did you mean 'ndt'?"),
        (["--set", "registration.inlier_ratio=0"], "inlier_ratio"),
        (["--set", "registration.inlier_distance=-1"], "inlier_distance"),
        (["--set", "registration.target=scans"], "did you mean 'scan'?"),
    ],
)
def test_contradictions_are_refused_before_anything_is_written(tmp_path: Path, words: list[str], hint: str) -> None:
    done = lslam("run", SAMPLE, *words, "--out", tmp_path / "out")
    assert done.returncode == 2
    assert_one_sentence(done.stderr)
    assert hint in done.stderr
    assert not (tmp_path / "out").exists()


def test_methods_lists_the_family() -> None:
    listed = lslam("methods").stdout
    for name, word in {"icp-point": "point to point", "gicp": "Segal", "vgicp": "Koide", "ndt": "Magnusson"}.items():
        assert any(line.split()[0] == name and word in line for line in listed.splitlines())

"""g2o files: there and back, what gtsam makes of them, and broken ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from g2o_reader import read_g2o

from lslam.core.errors import InputError, OutputError
from lslam.core.geometry import noise, se3
from lslam.core.types.constraint import Constraint
from lslam.io.formats.trajectory_lines import write_g2o

RNG = np.random.default_rng(3)
POSES = se3.exp(RNG.normal(size=(5, 6)) * [9, 9, 1, 0.3, 0.3, 2])


def covariance() -> np.ndarray:
    half = RNG.normal(size=(6, 6)) * [[0.1], [0.1], [0.1], [0.01], [0.01], [0.01]]
    return half @ half.T + np.diag([1e-4] * 3 + [1e-6] * 3)


CONSTRAINTS = [Constraint(k, k + 1, se3.relative(POSES[k], POSES[k + 1]), covariance(), "odometry") for k in range(4)]
CONSTRAINTS.append(Constraint(0, 4, se3.relative(POSES[0], POSES[4]), covariance(), "loop"))


def test_there_and_back(tmp_path: Path) -> None:
    write_g2o(tmp_path / "graph.g2o", POSES, CONSTRAINTS)
    poses, constraints = read_g2o(tmp_path / "graph.g2o")
    np.testing.assert_allclose(poses, POSES, atol=1e-10)
    assert [(c.a, c.b, c.kind) for c in constraints] == [(c.a, c.b, c.kind) for c in CONSTRAINTS]
    for read, written in zip(constraints, CONSTRAINTS, strict=True):
        np.testing.assert_allclose(read.T_a_b, written.T_a_b, atol=1e-10)
        np.testing.assert_allclose(read.covariance, written.covariance, rtol=1e-5, atol=1e-10)


def test_gtsam_reads_the_same(tmp_path: Path) -> None:
    """Poses, and noise in its order; gtsam takes the information of quaternions as that of angles."""
    import gtsam

    write_g2o(tmp_path / "graph.g2o", POSES, CONSTRAINTS)
    factors, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    np.testing.assert_allclose(values.atPose3(3).matrix(), POSES[3], atol=1e-9)
    half = np.array([0.5, 0.5, 0.5, 1, 1, 1])
    body = noise.to_body(CONSTRAINTS[4].covariance, CONSTRAINTS[4].T_a_b) * np.outer(half, half)
    last = factors.at(factors.size() - 1)
    np.testing.assert_allclose(last.noiseModel().covariance(), body, rtol=1e-4, atol=1e-9)


def test_information_is_that_of_g2os_own_error(tmp_path: Path) -> None:
    """The vector part of the quaternion of a small turn is half its angle."""
    turned = Constraint(0, 1, np.eye(4), np.diag([1.0, 1, 1, 0.01, 0.01, 0.01]))
    write_g2o(tmp_path / "graph.g2o", POSES[:2], [turned])
    edge = (tmp_path / "graph.g2o").read_text().splitlines()[-1].split()
    diagonal = np.array(edge[10:], float)[[0, 6, 11, 15, 18, 20]]
    np.testing.assert_allclose(diagonal, [1, 1, 1, 400, 400, 400])


GOOD = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n"
EDGE = "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 " + " ".join(str(v) for v in np.eye(6)[np.triu_indices(6)])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (GOOD + "VERTEX_SE3:QUAT 2 1 0 0\n", "line 3"),
        (GOOD + "VERTEX_SE3:QUAT 2 1 0 0 0 0 0 0\n", "length 0"),
        (GOOD + EDGE.replace("0 1 1", "0 7 1", 1), "7"),
        (GOOD + EDGE.replace("1.0", "-1.0"), "line 3"),
        (GOOD + EDGE.replace("1.0", "nan", 1), "finite"),
    ],
)
def test_broken_files_are_named(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "bad.g2o").write_text(text)
    with pytest.raises(InputError, match=said) as caught:
        read_g2o(tmp_path / "bad.g2o")
    assert "bad.g2o" in str(caught.value)


def test_no_file_and_no_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.g2o"):
        read_g2o(tmp_path / "none.g2o")
    with pytest.raises(OutputError):
        write_g2o(tmp_path / "no" / "graph.g2o", POSES, [])


def test_other_lines_are_passed_over(tmp_path: Path) -> None:
    (tmp_path / "more.g2o").write_text("# made by hand\n\nPARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n" + GOOD + EDGE)
    poses, constraints = read_g2o(tmp_path / "more.g2o")
    assert poses.shape == (2, 4, 4)
    assert constraints[0].kind == "odometry"

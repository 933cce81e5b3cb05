"""Open3D's part of a map: strays out, a surface through the rest."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lslam.core.config import load_config
from lslam.core.errors import InputError
from lslam.core.types.cloud import ArrayCloud
from lslam.io.formats.ply_files import write_ply_mesh
from lslam.maps.mesh import Mesh, denoise, surface
from lslam.pipeline.check import check_config


@pytest.mark.usefixtures("open3d")
def test_strays_go_and_the_rest_keeps_its_intensity() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(0, 10, 4000), rng.normal(0, 0.01, 4000), rng.uniform(0, 3, 4000)])
    strays = rng.uniform([-8, 12, -8], [18, 38, 18], (30, 3))
    points = np.concatenate([strays, wall])
    cloud = ArrayCloud.of(points, np.arange(len(points)))
    kept = denoise(cloud, 10, 2.0)
    # Open3D's rule in SciPy: the point itself is one of its neighbours.
    mean = cKDTree(points).query(points, 10)[0].mean(1)
    expected = np.flatnonzero(mean < mean.mean() + 2 * mean.std(ddof=1))
    assert kept.intensity is not None
    assert kept.intensity.tolist() == expected.tolist()
    assert np.array_equal(kept.points, points[expected])
    assert kept.intensity.min() >= 30, "a stray was kept"
    assert len(denoise(ArrayCloud.of(points[:5]))) == 5


def hall() -> tuple[Mesh, np.ndarray]:
    """The inside of a sphere of 4 m with a hole in its roof, seen from its middle."""
    rng = np.random.default_rng(1)
    directions = rng.normal(0, 1, (12_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = 4.0 * directions[directions[:, 2] < 0.8]
    return surface(ArrayCloud.of(points), 0.2, np.zeros((1, 3))), points


def test_a_surface_lies_on_its_points_and_looks_at_the_sensor(tmp_path: Path, open3d: ModuleType) -> None:
    mesh, points = hall()
    assert len(mesh.triangles) > 2000
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert np.abs(np.median(radius) - 4.0) < 0.01
    assert np.percentile(np.abs(radius - 4.0), 95) < 0.05
    assert cKDTree(points).query(mesh.vertices)[0].max() <= 0.4, "a surface where nobody saw one"
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), -a)
    assert (inward > 0).mean() > 0.99
    write_ply_mesh(tmp_path / "mesh.ply", mesh.vertices, mesh.triangles, "a hall")
    back = open3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    np.testing.assert_allclose(np.asarray(back.vertices), mesh.vertices, atol=1e-6)
    assert np.array_equal(np.asarray(back.triangles), mesh.triangles)
    again, _ = hall()
    assert again.vertices.tobytes() == mesh.vertices.tobytes()
    assert again.triangles.tobytes() == mesh.triangles.tobytes()


@pytest.mark.usefixtures("open3d")
def test_a_handful_of_points_has_no_surface() -> None:
    with pytest.raises(InputError, match="a map of 3 points has no surface"):
        surface(ArrayCloud.of(np.eye(3)), 0.2, np.zeros((1, 3)))


@pytest.mark.parametrize("key", ["denoise", "mesh"])
def test_a_missing_open3d_is_said_before_the_work(monkeypatch: pytest.MonkeyPatch, key: str) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    check_config(load_config(None, [], {}))
    with pytest.raises(InputError, match=r"pip install .*\[open3d\]"):
        check_config(load_config(None, [f"map.{key}=true"], {}))

"""Lenses: pixels computed by hand, and rays that go back to their pixels."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.types.camera import Lens
from lslam.maps.kernels.views import project_all

SIZE, INTRINSICS = (640, 480), (400.0, 410.0, 319.5, 239.5)
LENSES = {
    "none": Lens("pinhole", SIZE, INTRINSICS),
    "plumb bob": Lens("pinhole", SIZE, INTRINSICS, (-0.2, 0.05, 0.001, -0.002, -0.01)),
    "rational": Lens("pinhole", SIZE, INTRINSICS, (0.3, 0.1, 0.001, 0.0005, 0.02, 0.6, 0.2, 0.01)),
    "fisheye": Lens("fisheye", SIZE, (220.0, 220.0, 319.5, 239.5), (-0.02, 0.004, -0.001, 0.0002)),
}


def pixels(lens: Lens, *points: tuple[float, float, float]) -> np.ndarray:
    out = np.empty((len(points), 2))
    project_all(np.array(points), lens.parameters, out)
    return out


def test_a_pinhole_divides_by_depth() -> None:
    (centre, aside) = pixels(LENSES["none"], (0, 0, 3), (1, -0.5, 2))
    assert centre.tolist() == [319.5, 239.5]
    assert aside.tolist() == [319.5 + 400 * 0.5, 239.5 - 410 * 0.25]


def test_brown_s_terms_are_those_of_the_book() -> None:
    # x = 0.5, y = 0.25: r2 = 0.3125; radial 1 + k1 r2 + k2 r2^2 + k3 r2^3.
    x, y, r2 = 0.5, 0.25, 0.3125
    radial = 1 - 0.2 * r2 + 0.05 * r2**2 - 0.01 * r2**3
    u = x * radial + 2 * 0.001 * x * y - 0.002 * (r2 + 2 * x * x)
    v = y * radial + 0.001 * (r2 + 2 * y * y) + 2 * -0.002 * x * y
    found = pixels(LENSES["plumb bob"], (1, 0.5, 2))[0]
    np.testing.assert_allclose(found, [400 * u + 319.5, 410 * v + 239.5], atol=1e-9)


def test_a_fisheye_without_coefficients_is_equidistant() -> None:
    lens = Lens("fisheye", SIZE, (200.0, 200.0, 0.0, 0.0))
    aside, behind = pixels(lens, (1, 0, 0), (1, 0, -1))
    np.testing.assert_allclose(aside, [200 * np.pi / 2, 0], atol=1e-9)
    np.testing.assert_allclose(behind, [200 * 3 * np.pi / 4, 0], atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_rays_lead_back_to_their_pixels(name: str) -> None:
    lens = LENSES[name]
    wanted = np.stack(np.meshgrid(np.linspace(0, 639, 9), np.linspace(0, 479, 7)), axis=-1).reshape(-1, 2)
    rays = lens.rays(wanted)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1)
    np.testing.assert_allclose(pixels(lens, *map(tuple, 7.0 * rays)), wanted, atol=1e-6)


def test_what_is_behind_or_folds_back_has_no_pixel() -> None:
    assert np.isnan(pixels(LENSES["none"], (0, 0, -1), (0, 0, 0))).all()
    # 1 - 0.2 r2 turns back at r2 = 1 / 0.6: beyond, the world would appear a second time.
    lens = Lens("pinhole", SIZE, INTRINSICS, (-0.2, 0.0, 0.0, 0.0))
    inside, outside = pixels(lens, (1.25, 0, 1), (1.35, 0, 1))
    assert np.isfinite(inside).all()
    assert np.isnan(outside).all()

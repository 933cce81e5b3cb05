"""Cameras of a recording: their lens, their place on the LiDAR, and their images, which are read one at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError

Image = NDArray[np.uint8]
# Number of distortion coefficients by model, in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6, of a fisheye k1 k2 k3 k4.
MODELS = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}
_WIDEST = 4.0  # tangent of half the field that a pinhole can have: 152 deg


@dataclass(frozen=True)
class Lens:
    """Projection of a camera, whose axes are x right, y down, z forward; (0, 0) is the middle of the first pixel.

    model : `pinhole`, with radial and tangential distortion (Brown 1966, the quotient of polynomials with k4 to k6), or
        `fisheye`, equidistant with a polynomial of the angle (Kannala and Brandt 2006)
    size : width, height; intrinsics : fx, fy, cx, cy, pixels; distortion : coefficients in OpenCV's order
    """

    model: str
    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, ...] = ()

    @cached_property
    def parameters(self) -> Floats:
        """(14,) for kernels: whether it is a fisheye, fx, fy, cx, cy, eight coefficients, and `limit`."""
        coefficients = np.zeros(8)
        coefficients[: len(self.distortion)] = self.distortion
        return np.array([float(self.model == "fisheye"), *self.intrinsics, *coefficients, self._limit(coefficients)])

    def _limit(self, k: Floats) -> float:
        """Largest angle, rad (for a pinhole its tangent), up to which distorted radii increase with the angle.

        Beyond it, the polynomial would fold the world back into the image.
        """
        r = np.linspace(0, np.pi if self.model == "fisheye" else _WIDEST, 4001)
        r2 = r**2
        if self.model == "fisheye":
            out = r * (1 + r2 * (k[0] + r2 * (k[1] + r2 * (k[2] + r2 * k[3]))))
        else:
            below = 1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7]))
            out = r * (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / below
        back = np.flatnonzero(~(np.diff(out) > 0))
        return float(r[back[0]] if len(back) else r[-1])

    def rays(self, pixels: NDArray[Any]) -> Floats:
        """Unit rays (N, 3) of the camera through `pixels` (N, 2): the inverse of the projection, by iteration."""
        fx, fy, cx, cy = self.intrinsics
        there = (np.asarray(pixels, np.float64) - [cx, cy]) / [fx, fy]
        k = self.parameters[5:13]
        if self.model == "fisheye":
            far = np.linalg.norm(there, axis=1)
            angle = far.copy()
            for _ in range(20):
                a2 = angle**2
                angle = far / (1 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
            flat = there * (np.sin(angle) / np.where(far > 0, far, 1))[:, None]
            return np.column_stack([flat, np.cos(angle)])
        xy = there.copy()
        for _ in range(40):
            x, y = xy.T
            r2 = x**2 + y**2
            radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[4]))) / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
            dx = 2 * k[2] * x * y + k[3] * (r2 + 2 * x**2)
            dy = k[2] * (r2 + 2 * y**2) + 2 * k[3] * x * y
            xy = (there - np.column_stack([dx, dy])) / radial[:, None]
        out = np.column_stack([xy, np.ones(len(xy))])
        return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


@dataclass(frozen=True)
class Camera:
    """A camera of a recording.

    T_lidar_camera : (4, 4); stamps_ns : (K,) increasing, the middle of each exposure by the clock of the scans
    load : reads image k, (height, width, 3) uint8 red, green, blue. Raises InputError naming what cannot be read
    """

    name: str
    lens: Lens
    T_lidar_camera: Floats
    stamps_ns: Longs
    load: Callable[[int], Image]

    def image(self, k: int) -> Image:
        """Read image k, (height, width, 3) uint8. Raises InputError if it is unreadable or its size is not the calibration's."""
        image = self.load(k)
        height, width = image.shape[:2]
        if (width, height) != self.lens.size:
            raise InputError(
                f"camera {self.name}: image {k} has {width} x {height} pixels, its calibration is for "
                f"{self.lens.size[0]} x {self.lens.size[1]}"
            )
        return image


def cameras_of(sequence: Any) -> list[Camera]:
    """Cameras of a sequence, some of whose images lie within the time of its scans.

    Raises InputError when it has none, when one has no calibration, and when no image shares the time of the scans.
    """
    cameras: list[Camera] = getattr(sequence, "cameras", list)()
    if not cameras:
        raise InputError(
            f"{sequence.path} has no images that lslam reads: a bag needs Image topics, KITTI image_2 or image_02, a folder "
            "[cameras.NAME] in sequence.toml"
        )
    begin, end = sequence.stamps_ns[0], sequence.stamps_ns[-1]
    if not any(np.any((camera.stamps_ns >= begin) & (camera.stamps_ns <= end)) for camera in cameras):
        first, last = min(c.stamps_ns[0] for c in cameras), max(c.stamps_ns[-1] for c in cameras)
        raise InputError(
            f"the images of {sequence.name} share no time with its scans: they run from {1e-9 * first:.3f} to "
            f"{1e-9 * last:.3f} s, the scans from {1e-9 * begin:.3f} to {1e-9 * end:.3f} s"
        )
    return cameras

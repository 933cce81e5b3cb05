"""A camera on a simulated drive: each surface in a colour of its own, exposed while the camera moves."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.geometry import portable, se3
from lslam.core.types.camera import Camera, Image, Lens
from lslam.io.formats.atomic import write_text
from lslam.io.formats.image_files import write_png
from lslam.io.formats.sequence_toml import CameraInfo
from lslam.simulation.lidar import Meeting
from lslam.simulation.moving import moving_meshes
from lslam.simulation.returns import Rays
from lslam.simulation.scenarios import SPARE_REACH, SimulatedDrive
from lslam.simulation.scene_mesh import LOOKS, Surface

NAME = "front"
FRONT = Lens("pinhole", (400, 300), (250.0, 250.0, 199.5, 149.5), (-0.05, 0.01, 0.0005, -0.0005))
_SEED = 2**32 - 19  # of exposures and pixel noise

SKY_COLOUR = (200, 225, 250)
COLOURS = np.array([*(LOOKS[surface].colour for surface in Surface), SKY_COLOUR], np.float32)


@dataclass(frozen=True)
class CameraModel:
    """A camera that rides along.

    lens : its projection; exposure_s : of an image; instants : at which the scene is seen during the exposure, blur between them
    late_s : from the stamp of a scan to the middle of the exposure of the image that follows
    exposure_sigma : standard deviation of the logarithm of the brightness, which wanders from image to image
    noise : standard deviation of a pixel's values
    """

    lens: Lens = field(default_factory=lambda: FRONT)
    exposure_s: float = 0.01
    instants: int = 3
    late_s: float = 0.037
    exposure_sigma: float = 0.15
    noise: float = 2.0


class SimulatedCamera:
    """Images of a simulated drive, one a scan; any order gives the same bytes."""

    def __init__(self, drive: SimulatedDrive, model: CameraModel | None = None) -> None:
        self.drive, self.model = drive, CameraModel() if model is None else model
        assert drive.calibration.T_cam0_lidar is not None
        self.T_lidar_camera: Floats = se3.inverse(drive.calibration.T_cam0_lidar)
        stamps = drive.stamps_ns + round(1e9 * self.model.late_s)
        self.stamps_ns: Longs = stamps[stamps <= drive.stamps_ns[-1]]
        width, height = self.model.lens.size
        row, column = np.mgrid[:height, :width]
        self._rays = self.model.lens.rays(np.stack([column.ravel(), row.ravel()], axis=1))
        self.gains = self._wandering()

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def info(self) -> CameraInfo:
        """Calibration of the camera for `sequence.toml`."""
        lens = self.model.lens
        return CameraInfo(NAME, lens.intrinsics, self.T_lidar_camera, "", lens.model, lens.distortion)

    @property
    def camera(self) -> Camera:
        """The camera as readers give it."""
        return Camera(NAME, self.model.lens, self.T_lidar_camera, self.stamps_ns, self.image)

    def image(self, index: int) -> Image:
        """Simulate image `index`, (height, width, 3) uint8 RGB, with motion blur and noise."""
        middle, model = self.stamps_ns[index] / 1e9, self.model
        shares = (np.arange(model.instants) + 0.5) / model.instants - 0.5
        width, height = model.lens.size
        total = sum(COLOURS[self.surfaces(middle + share * model.exposure_s)] for share in shares)
        rng = np.random.default_rng([self.drive.seed, _SEED, index])
        noise = rng.standard_normal((height * width, 3), np.float32) * np.float32(model.noise)
        values = np.float32(self.gains[index] / model.instants) * total + noise
        return np.clip(np.rint(values), 0, 255).astype(np.uint8).reshape(height, width, 3)

    def surfaces(self, time: float) -> NDArray[np.intp]:
        """(height * width,) surface that each pixel's ray meets at `time`, s; `len(Surface)` for the sky."""
        drive = self.drive
        T = portable.product(drive.vehicle.poses(np.array([time]))[0], self.T_lidar_camera)
        origins = np.broadcast_to(T[:3, 3].astype(np.float32), self._rays.shape)
        directions = portable.product(self._rays, T[:3, :3].T).astype(np.float32)
        reach = 10 * drive.lidar.range_max
        bodies = moving_meshes(drive.movers, T[:3, 3], time, reach + SPARE_REACH)
        meeting = Meeting(drive.scene, bodies, time, None, np.random.default_rng(0))
        hits = meeting.meet(Rays(origins, directions, np.full(len(directions), time)))
        return np.where(np.isfinite(hits.distance), hits.surface, len(Surface)).astype(np.intp)

    def _wandering(self) -> Floats:
        """Brightness factor of each image, about 1: a random process with a memory of ten images, like an automatic exposure."""
        rng = np.random.default_rng([self.drive.seed, _SEED])
        level, levels = 0.0, np.empty(len(self))
        stay = np.exp(-0.1)
        for k in range(len(self)):
            level = stay * level + self.model.exposure_sigma * float(np.sqrt(1 - stay**2)) * rng.standard_normal()
            levels[k] = level
        return np.exp(levels)


def write_images(camera: SimulatedCamera, folder: Path) -> Iterator[int]:
    """Write the images missing in `folder`/front and their stamps; yields the number of each image, also of existing ones."""
    place = folder / NAME
    place.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(2, thread_name_prefix="render") as pool:
        ahead = 4
        for first in range(0, len(camera), ahead):
            some = range(first, min(first + ahead, len(camera)))
            paths = {k: place / f"{k:06d}.png" for k in some}
            waiting = {k: pool.submit(camera.image, k) for k in some if not paths[k].is_file()}
            for k in some:
                if k in waiting:
                    write_png(paths[k], waiting[k].result())
                yield k
    write_text(place / "times.txt", "".join(f"{1e-9 * stamp:.9f}\n" for stamp in camera.stamps_ns))

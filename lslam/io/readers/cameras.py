"""Cameras of folders, of KITTI's layouts and of bags. Images are listed when cameras are asked for, and read one by one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.camera import MODELS, Camera, Image, Lens
from lslam.io.formats.bag_files import Bag, BagTopic, read_header
from lslam.io.formats.image_files import SUFFIXES, decode_image, from_pixels, image_size, read_image
from lslam.io.formats.kitti_layout import read_projection, read_raw_cam0_lidar
from lslam.io.formats.sequence_toml import FILE_NAME, CameraInfo
from lslam.io.formats.time_columns import read_stamps
from lslam.io.readers.bag_lidars import Links
from lslam.io.readers.bag_topics import HEADER, put_in_order
from lslam.io.readers.ground_truth import Voice
from lslam.io.readers.listing import list_scans, rows_of

# ROS' words for the models of `Lens`; a rational polynomial with more coefficients than eight bends its sensor.
_ROS_MODELS = {"plumb_bob": "pinhole", "rational_polynomial": "pinhole", "equidistant": "fisheye", "fisheye": "fisheye"}
_COMPRESSION_SUFFIX = "/compressed"
# Stamps of images and times of recording to the offset of their clock from that of the scans, ns.
Ahead = Callable[[Longs, Longs, str], int]


def folder_cameras(folder: Path, infos: Mapping[str, CameraInfo]) -> list[Camera]:
    """Cameras that `sequence.toml` names. Raises InputError where images or stamps are missing, or their numbers differ."""
    return [_folder_camera(folder, name, info) for name, info in infos.items()]


def _folder_camera(folder: Path, name: str, info: CameraInfo) -> Camera:
    """Camera `name` of a folder, by its table in `sequence.toml`. Raises InputError for missing images or stamps."""
    files = _images(folder / info.images, f"named by cameras.{name} of {folder / FILE_NAME}")
    path = folder / info.stamps_file
    if not path.is_file():
        raise InputError(f"{path} does not exist: camera {name} needs a file with a stamp for each of its images")
    stamps = read_stamps(path)
    if len(stamps) != len(files):
        raise InputError(f"{path} has {len(stamps)} stamps for {len(files)} images of camera {name}")
    stamps = stamps + round(1e9 * info.time_offset_s)
    return camera_of_files(name, info, files, stamps, path)


def camera_of_files(name: str, info: CameraInfo, files: list[Path], stamps: Longs, source: Path) -> Camera:
    """Camera of image files and their stamps. Raises InputError when time goes back."""
    back = np.flatnonzero(np.diff(stamps) <= 0)
    if len(back):
        raise InputError(
            f"{source}: time does not increase at line {back[0] + 2}: camera {name} needs increasing stamps"
        )
    return Camera(name, info.lens(image_size(files[0])), info.T_lidar_camera, stamps, partial(_read_file, files))


def kitti_cameras(folder: Path, scans: list[Path], stamps_ns: Longs, T_cam0_lidar: Floats | None) -> list[Camera]:
    """Rectified camera 2 of KITTI odometry, image_2 with P2 of calib.txt, taken as the scanner looks ahead; none without images.

    Raises InputError where its calibration is missing.
    """
    place = folder / "image_2"
    if not place.is_dir():
        return []
    if T_cam0_lidar is None:
        raise InputError(f"the camera of {folder} has no calibration: {folder / 'calib.txt'} with P2 and Tr is missing")
    files = _images(place, "of KITTI's layout")
    stamps = _stamps_by_name(files, scans, stamps_ns)
    return [_rectified_camera("image_2", folder / "calib.txt", "P2", T_cam0_lidar, files, stamps)]


def kitti_raw_cameras(folder: Path) -> list[Camera]:
    """Rectified camera 2 of a KITTI raw drive; none without images.

    Raises InputError without calibration or stamps, or for `extract` drives.
    """
    place = folder / "image_02"
    if not (place / "data").is_dir():
        return []
    day = folder.parent
    if not (day / "calib_cam_to_cam.txt").is_file():
        raise InputError(f"the camera of {folder} has no calibration: {day / 'calib_cam_to_cam.txt'} is missing")
    if folder.name.endswith("_extract"):
        raise InputError(
            f"{place} is not rectified: the images of a _sync drive are read, or [cameras.NAME] in {FILE_NAME}"
        )
    T_cam0_lidar = read_raw_cam0_lidar(day)
    files = _images(place / "data", "of KITTI's layout")
    stamps = read_stamps(place / "timestamps.txt")
    rows, _ = rows_of(files, len(stamps))
    if not len(stamps) or (rows < 0).any():
        raise InputError(f"{place / 'timestamps.txt'} has {len(stamps)} stamps for {len(files)} images")
    return [_rectified_camera("image_02", day / "calib_cam_to_cam.txt", "P_rect_02", T_cam0_lidar, files, stamps[rows])]


def _stamps_by_name(files: list[Path], scans: list[Path], stamps_ns: Longs) -> Longs:
    """Stamps of images that have the names of their scans. Raises InputError where one has no scan."""
    known = dict(zip((path.stem for path in scans), stamps_ns.tolist(), strict=True))
    lonely = [path for path in files if path.stem not in known]
    if lonely:
        raise InputError(f"{lonely[0]} has no scan of its name, whose stamp it would have: remove it")
    return np.array([known[path.stem] for path in files], np.int64)


def _rectified_camera(
    name: str, calib: Path, key: str, T_cam0_lidar: Floats, files: list[Path], stamps: Longs
) -> Camera:
    """Camera of rectified images by its projection P = K [1 | t] of points of the rectified camera 0."""
    P = read_projection(calib, key)
    T_camera_cam0 = se3.make(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))
    T_lidar_camera = se3.inverse(T_camera_cam0 @ T_cam0_lidar)
    intrinsics = (float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2]))
    return camera_of_files(name, CameraInfo(name, intrinsics, T_lidar_camera), files, stamps, calib)


def _images(folder: Path, whose: str) -> list[Path]:
    """Image files of a folder; raises InputError without any, with `whose` folder it is."""
    files = list_scans(folder, SUFFIXES)[0] if folder.is_dir() else []
    if not files:
        raise InputError(f"{folder}, {whose}, holds no images ({', '.join('*' + suffix for suffix in SUFFIXES)})")
    return files


def _read_file(files: list[Path], k: int) -> Image:
    """Pixels of file `k` of a list."""
    return read_image(files[k])


def bag_cameras(
    bag: Bag, links: Links, lidar: str, ahead: Ahead, infos_in_toml: Mapping[str, CameraInfo] | None
) -> list[Camera]:
    """Cameras of a bag, by topic; if the same images have a raw and a compressed topic, the raw one is used.

    links, lidar : transforms, and the frame of the scans; infos_in_toml : cameras of `sequence.toml`, whose `images` name a topic

    A camera without a calibration is named in the problems. Raises InputError if none has one.
    """
    voice, cameras, faults = links.voice, [], []
    named = {info.images: (name, info) for name, info in (infos_in_toml or {}).items()}
    topics = {topic.name: topic for topic in bag.of_type("Image", "CompressedImage")}
    if unknown := [name for name in named if name not in topics]:
        raise InputError(
            f"{bag.path} has no images in {unknown[0]}, which cameras of sequence.toml names: {_list_topics(topics)}"
        )
    for topic in topics.values():
        if topic.name.endswith(_COMPRESSION_SUFFIX) and topic.name.removesuffix(_COMPRESSION_SUFFIX) in topics:
            continue
        if named and topic.name not in named:
            continue
        try:
            cameras.append(_bag_camera(bag, topic, links, lidar, ahead, named.get(topic.name)))
        except InputError as error:
            faults.append(str(error))
    if faults and not cameras:
        raise InputError("; ".join(faults))
    voice.problems += [f"a camera is not used: {fault}" for fault in faults]
    return cameras


def _bag_camera(
    bag: Bag, topic: BagTopic, links: Links, lidar: str, ahead: Ahead, infos_in_toml: tuple[str, CameraInfo] | None
) -> Camera:
    """Camera of an image topic, with lens and extrinsics by `infos_in_toml`, else by the bag; InputError without these."""
    heads = [(k, head) for k, head in bag.each(topic, partial(read_header, topic), links.voice.problems, HEADER)]
    if not heads:
        raise InputError(f"{topic.name} has no image that can be read")
    numbers = np.array([k for k, _ in heads], np.int64)
    recording_ns = topic.stamps_ns[numbers]
    voice = Voice([], links.voice.problems)
    order, stamps = put_in_order(
        np.array([h.stamp_ns for _, h in heads], np.int64), recording_ns, f"{topic.name}: images", voice
    )
    numbers = numbers[order]
    stamps = stamps - ahead(stamps, topic.stamps_ns[numbers], topic.name)
    read = partial(_read_message, bag, topic, numbers)
    if infos_in_toml is not None:
        name, info = infos_in_toml
        height, width = read(0).shape[:2]
        return Camera(
            name, info.lens((width, height)), info.T_lidar_camera, stamps + round(1e9 * info.time_offset_s), read
        )
    lens = _bag_lens(bag, topic)
    frame = heads[0][1].frame
    place = links.find(lidar, frame)
    if place is None:
        raise InputError(f"camera {topic.name} has no place: {links.why_not(lidar, frame)}; {_state_in_toml(topic)}")
    return Camera(topic.name, lens, place[0], stamps, read)


def _bag_lens(bag: Bag, topic: BagTopic) -> Lens:
    """The lens by the CameraInfo topic of the images. Raises InputError where it is missing, empty, or of an unknown model."""
    image = topic.name.removesuffix(_COMPRESSION_SUFFIX)
    beside = (f"{image.rpartition('/')[0]}/camera_info", f"{image}/camera_info")
    infos = [t for t in bag.of_type("CameraInfo") if t.name in beside]
    if not infos:
        raise InputError(f"camera {topic.name} has no calibration: there is no {beside[0]}; {_state_in_toml(topic)}")
    message = bag.decode(infos[0], bag.message(infos[0], 0))
    # ROS 1 has capitals.
    K, D, P = (np.asarray(getattr(message, name, getattr(message, name.lower(), ()))) for name in ("K", "D", "P"))
    model = _ROS_MODELS.get(message.distortion_model or "plumb_bob", "")
    is_rectified = "rect" in image.rpartition("/")[2]
    coefficients = () if is_rectified else tuple(np.trim_zeros(np.asarray(D, np.float64), "b").tolist())
    matrix: Floats = P.reshape(3, 4)[:, :3] if is_rectified else K.reshape(3, 3)
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not (fx > 0 and fy > 0):
        raise InputError(
            f"camera {topic.name} has no calibration: {infos[0].name} is not filled in; {_state_in_toml(topic)}"
        )
    if not model or len(coefficients) > MODELS[model][-1]:
        raise InputError(
            f"camera {topic.name}: distortion {message.distortion_model} of {len(coefficients)} coefficients is not known: "
            f"{', '.join(_ROS_MODELS)} are"
        )
    return Lens(
        "pinhole" if is_rectified else model, (int(message.width), int(message.height)), (fx, fy, cx, cy), coefficients
    )


def _read_message(bag: Bag, topic: BagTopic, numbers: Longs, k: int) -> Image:
    """Pixels of image `k` of a topic; numbers : (N,) its messages in order."""
    number = int(numbers[k])
    source = f"{bag.path}, {topic.name}, message {number}"
    message: Any = bag.decode(topic, bag.message(topic, number))
    data = np.asarray(message.data, np.uint8)
    if topic.type.endswith("CompressedImage"):
        return decode_image(data.tobytes(), source)
    return from_pixels(data, int(message.width), int(message.height), int(message.step), message.encoding, source)


def _state_in_toml(topic: BagTopic) -> str:
    """Advice for a message: how to state the camera of a topic in `sequence.toml`."""
    return f'write [cameras.NAME] with images = "{topic.name}" in sequence.toml beside the bag'


def _list_topics(topics: Mapping[str, BagTopic]) -> str:
    """Text for a message: the image topics of the bag."""
    return f"it has {', '.join(topics)}" if topics else "it has none"

"""Cameras of bags: topics of images, their CameraInfo, and where they sit by the bag's transforms."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from lslam.core.errors import InputError
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.camera import MODELS, Camera, Image, Lens
from lslam.io.formats.bag_files import Bag, BagTopic, read_header
from lslam.io.formats.camera_info import CameraInfo
from lslam.io.formats.image_files import decode_image, from_pixels
from lslam.io.readers.bag_lidars import Links
from lslam.io.readers.bag_topics import HEADER, put_in_order
from lslam.io.readers.ground_truth import Voice

# ROS' words for the models of `Lens`; a rational polynomial with more coefficients than eight bends its sensor.
_ROS_MODELS = {"plumb_bob": "pinhole", "rational_polynomial": "pinhole", "equidistant": "fisheye", "fisheye": "fisheye"}
_PACKED = "/compressed"
# Stamps of images and times of recording to the offset of their clock from that of the scans, ns.
Ahead = Callable[[Longs, Longs, str], int]


def bag_cameras(
    bag: Bag, links: Links, lidar: str, ahead: Ahead, stated: Mapping[str, CameraInfo] | None
) -> list[Camera]:
    """Cameras of a bag, by name of their topics; of a raw and a compressed topic of the same images the raw one.

    links, lidar : transforms, and the frame of the scans; stated : cameras of `sequence.toml`, whose `images` name a topic

    A camera without a calibration is named in the problems. Raises InputError if none has one.
    """
    voice, cameras, faults = links.voice, [], []
    named = {info.images: (name, info) for name, info in (stated or {}).items()}
    topics = {topic.name: topic for topic in bag.of_type("Image", "CompressedImage")}
    if unknown := [name for name in named if name not in topics]:
        raise InputError(
            f"{bag.path} has no images in {unknown[0]}, which cameras of sequence.toml names: {_list(topics)}"
        )
    for topic in topics.values():
        if topic.name.endswith(_PACKED) and topic.name.removesuffix(_PACKED) in topics:
            continue
        if named and topic.name not in named:
            continue
        try:
            cameras.append(_camera(bag, topic, links, lidar, ahead, named.get(topic.name)))
        except InputError as error:
            faults.append(str(error))
    if faults and not cameras:
        raise InputError("; ".join(faults))
    voice.problems += [f"a camera is not used: {fault}" for fault in faults]
    return cameras


def _camera(
    bag: Bag, topic: BagTopic, links: Links, lidar: str, ahead: Ahead, stated: tuple[str, CameraInfo] | None
) -> Camera:
    heads = [(k, head) for k, head in bag.each(topic, partial(read_header, topic), links.voice.problems, HEADER)]
    if not heads:
        raise InputError(f"{topic.name} has no image that can be read")
    numbers = np.array([k for k, _ in heads], np.int64)
    recorded = topic.stamps_ns[numbers]
    voice = Voice([], links.voice.problems)
    order, stamps = put_in_order(
        np.array([h.stamp_ns for _, h in heads], np.int64), recorded, f"{topic.name}: images", voice
    )
    numbers = numbers[order]
    stamps = stamps - ahead(stamps, topic.stamps_ns[numbers], topic.name)
    read = partial(_read, bag, topic, numbers)
    if stated is not None:
        name, info = stated
        height, width = read(0).shape[:2]
        return Camera(
            name, info.lens((width, height)), info.T_lidar_camera, stamps + round(1e9 * info.time_offset_s), read
        )
    lens = _lens(bag, topic)
    frame = heads[0][1].frame
    found = links.find(lidar, frame)
    if found is None:
        raise InputError(f"camera {topic.name} has no place: {links.why_not(lidar, frame)}; {_way_out(topic)}")
    return Camera(topic.name, lens, found[0], stamps, read)


def _lens(bag: Bag, topic: BagTopic) -> Lens:
    """The lens by the CameraInfo beside the images. Raises InputError where there is none, or one that is not filled in."""
    image = topic.name.removesuffix(_PACKED)
    beside = (f"{image.rpartition('/')[0]}/camera_info", f"{image}/camera_info")
    infos = [t for t in bag.of_type("CameraInfo") if t.name in beside]
    if not infos:
        raise InputError(f"camera {topic.name} has no calibration: there is no {beside[0]}; {_way_out(topic)}")
    message = bag.decode(infos[0], bag.message(infos[0], 0))
    # ROS 1 has capitals.
    K, D, P = (np.asarray(getattr(message, name, getattr(message, name.lower(), ()))) for name in ("K", "D", "P"))
    model = _ROS_MODELS.get(message.distortion_model or "plumb_bob", "")
    is_rectified = "rect" in image.rpartition("/")[2]
    coefficients = () if is_rectified else tuple(np.trim_zeros(np.asarray(D, np.float64), "b").tolist())
    matrix: Floats = P.reshape(3, 4)[:, :3] if is_rectified else K.reshape(3, 3)
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not (fx > 0 and fy > 0):
        raise InputError(f"camera {topic.name} has no calibration: {infos[0].name} is not filled in; {_way_out(topic)}")
    if not model or len(coefficients) > MODELS[model][-1]:
        raise InputError(
            f"camera {topic.name}: distortion {message.distortion_model} of {len(coefficients)} coefficients is not known: "
            f"{', '.join(_ROS_MODELS)} are"
        )
    return Lens(
        "pinhole" if is_rectified else model, (int(message.width), int(message.height)), (fx, fy, cx, cy), coefficients
    )


def _read(bag: Bag, topic: BagTopic, numbers: Longs, k: int) -> Image:
    number = int(numbers[k])
    source = f"{bag.path}, {topic.name}, message {number}"
    message: Any = bag.decode(topic, bag.message(topic, number))
    data = np.asarray(message.data, np.uint8)
    if topic.type.endswith("CompressedImage"):
        return decode_image(data.tobytes(), source)
    return from_pixels(data, int(message.width), int(message.height), int(message.step), message.encoding, source)


def _way_out(topic: BagTopic) -> str:
    return f'write [cameras.NAME] with images = "{topic.name}" in sequence.toml beside the bag'


def _list(topics: Mapping[str, BagTopic]) -> str:
    return f"it has {', '.join(topics)}" if topics else "it has none"

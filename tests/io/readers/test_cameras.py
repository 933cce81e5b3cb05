"""Cameras of folders, of KITTI's layouts and of bags: pixels and calibration come back, what is missing is named."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_builders import KINDS, START_NS, STEP_NS, SUFFIX, Fill, bag, clouds, together, transforms
from PIL import Image as Pillow
from sequence_builders import T_CAM0_LIDAR, kitti_root, raw_drive, scans

from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.core.types.camera import cameras_of
from lslam.io.formats.image_files import from_pixels, write_png
from lslam.io.formats.sequence_toml import CameraInfo, SequenceInfo, read_sequence_toml, write_sequence_toml
from lslam.io.readers import open_sequence
from lslam.pipeline.convert.bag_writer import BagMessages

T_LIDAR_CAMERA = se3.inverse(T_CAM0_LIDAR)
INFO = CameraInfo(
    "front", (100.0, 101.0, 15.5, 11.5), T_LIDAR_CAMERA, distortion=(-0.1, 0.01, 0.0, 0.001), time_offset_s=0.02
)


def picture(k: int, height: int = 24, width: int = 32) -> np.ndarray:
    return np.random.default_rng(k).integers(0, 256, (height, width, 3)).astype(np.uint8)


def filmed(tmp_path: Path, count: int = 3, info: CameraInfo = INFO) -> Path:
    folder = scans(tmp_path / "drive", 4).parent / "drive"
    (folder / "front").mkdir()
    for k in range(count):
        write_png(folder / "front" / f"{k}.png", picture(k))
    (folder / "front" / "times.txt").write_text("".join(f"{0.05 + 0.1 * k:.3f}\n" for k in range(3)))
    write_sequence_toml(folder / "sequence.toml", SequenceInfo(cameras={"front": info}))
    return folder


def test_a_folder_s_camera_is_what_was_written(tmp_path: Path) -> None:
    folder = filmed(tmp_path)
    stated = (read_sequence_toml(folder / "sequence.toml").cameras or {})["front"]
    assert stated.tree() == INFO.tree()
    (camera,) = cameras_of(open_sequence(folder))
    assert camera.stamps_ns.tolist() == [70_000_000, 170_000_000, 270_000_000]
    assert camera.lens.size == (32, 24)
    assert camera.lens.distortion == INFO.distortion
    np.testing.assert_allclose(camera.T_lidar_camera, T_LIDAR_CAMERA, atol=1e-12)
    assert (camera.image(2) == picture(2)).all()


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("intrinsics", "intrinsic", r"unknown key cameras.front.intrinsic; did you mean 'intrinsics'"),
        ("T_lidar_camera", "# T = ", r"cameras.front"),
        ('model = "pinhole"', 'model = "pinole"', r"cameras.front.model = 'pinole', expected one of pinhole, fisheye"),
        ("100.0", "-100.0", r"the focal lengths fx and fy are above 0"),
        ("    -0.1,", "", r"cameras.front.distortion = .* expected 0 or 4 or 5 or 8 coefficients of a pinhole"),
        (
            "time_offset_s = 0.02",
            "time_offset_s = 1e300",
            r"cameras.front.time_offset_s = .*, expected a number of seconds",
        ),
        ("15.5,", "nan,", r"cameras.front.intrinsics = .*, expected fx, fy, cx, cy in pixels"),
        ('images = "front"', 'images = "back"', r"back, named by cameras.front of .*, holds no images"),
    ],
)
def test_a_wrong_table_is_one_sentence(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    folder = filmed(tmp_path)
    toml = folder / "sequence.toml"
    text = toml.read_text()
    if old == "T_lidar_camera":
        text = text[: text.index(old)]
        sentence = r"camera front has no calibration: cameras.front.T_lidar_camera is missing"
    assert old in text or old == "T_lidar_camera"
    toml.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=sentence):
        cameras_of(open_sequence(folder))


def test_missing_stamps_images_and_times_are_named(tmp_path: Path) -> None:
    folder = filmed(tmp_path, count=2)
    with pytest.raises(InputError, match=r"times.txt has 3 stamps for 2 images of camera front"):
        cameras_of(open_sequence(folder))
    (folder / "front" / "times.txt").write_text("100\n101\n")
    with pytest.raises(InputError, match=r"share no time with its scans: they run from 100.020 to 101.020 s"):
        cameras_of(open_sequence(folder))
    (folder / "front" / "times.txt").write_text("0.2\n0.1\n")
    with pytest.raises(InputError, match=r"time does not increase at line 2"):
        cameras_of(open_sequence(folder))
    (folder / "front" / "times.txt").unlink()
    with pytest.raises(InputError, match=r"camera front needs a file with a stamp for each of its images"):
        cameras_of(open_sequence(folder))


def test_a_folder_without_cameras_says_what_is_looked_for(tmp_path: Path) -> None:
    scans(tmp_path / "drive", 3)
    with pytest.raises(InputError, match=r"has no images that lslam reads: a bag needs Image topics"):
        cameras_of(open_sequence(tmp_path / "drive"))


def test_an_image_of_another_size_or_none_is_named(tmp_path: Path) -> None:
    folder = filmed(tmp_path)
    (camera,) = cameras_of(open_sequence(folder))
    write_png(folder / "front" / "1.png", picture(1, 12, 16))
    (folder / "front" / "2.png").write_bytes((folder / "front" / "2.png").read_bytes()[:200])
    with pytest.raises(InputError, match=r"image 1 has 16 x 12 pixels, its calibration is for 32 x 24"):
        camera.image(1)
    with pytest.raises(InputError, match=r"2.png cannot be read as an image"):
        camera.image(2)


def test_kitti_s_camera_2_projects_as_its_matrix(tmp_path: Path) -> None:
    folder = kitti_root(tmp_path, 3)
    P = np.array([[700.0, 0, 16, 45], [0, 701, 12, -0.3], [0, 0, 1, 0.005]])
    with (folder / "calib.txt").open("a") as stream:
        stream.write("P2: " + " ".join(map(str, P.ravel())) + "\n")
    (folder / "image_2").mkdir()
    for k in range(2):
        write_png(folder / "image_2" / f"{k:06d}.png", picture(k))
    (camera,) = cameras_of(open_sequence(folder))
    assert camera.stamps_ns.tolist() == [0, 100_000_000]
    point = np.array([10.0, 2.0, -1.0])
    u, v, w = P @ np.append(se3.apply(T_CAM0_LIDAR, point[None])[0], 1)
    x, y, z = se3.apply(se3.inverse(camera.T_lidar_camera), point[None])[0]
    fx, fy, cx, cy = camera.lens.intrinsics
    np.testing.assert_allclose([fx * x / z + cx, fy * y / z + cy], [u / w, v / w])


def test_a_kitti_drive_s_images_have_their_own_stamps(tmp_path: Path) -> None:
    folder = raw_drive(tmp_path, 4)
    data = folder / "image_02" / "data"
    data.mkdir(parents=True)
    for k in (0, 1, 3):
        write_png(data / f"{k:010d}.png", picture(k))
    start = (folder / "oxts" / "timestamps.txt").read_text().splitlines()
    (folder / "image_02" / "timestamps.txt").write_text("\n".join(start) + "\n")
    with pytest.raises(InputError, match=r"has no calibration: .*calib_cam_to_cam.txt is missing"):
        cameras_of(open_sequence(folder))
    day = folder.parent
    P = "P_rect_02: 700 0 16 45 0 700 12 0 0 0 1 0\nR_rect_00: 1 0 0 0 1 0 0 0 1\n"
    (day / "calib_cam_to_cam.txt").write_text(P)
    rows = " ".join(map(str, T_CAM0_LIDAR[:3, :3].ravel())), " ".join(map(str, T_CAM0_LIDAR[:3, 3]))
    (day / "calib_velo_to_cam.txt").write_text(f"R: {rows[0]}\nT: {rows[1]}\n")
    sequence = open_sequence(folder)
    (camera,) = cameras_of(sequence)
    assert len(camera.stamps_ns) == 3
    assert (camera.image(2) == picture(3)).all()


def images(
    count: int, encoding: str, topic: str = "/cam/image_raw", frame: str = "camera", info: dict[str, Any] | None = None
) -> Fill:
    """Images of 24 rows and 32 columns, some bytes behind each row, and a CameraInfo that `info` changes; {} for none."""

    def fill(writer: Any) -> None:
        types, store = writer.store.types, writer.store
        for k in range(count):
            stamp = START_NS + 30_000_000 + k * STEP_NS
            head, pixels = BagMessages(store).header(stamp, frame), picture(k)
            if encoding in ("png", "jpeg"):
                stream = io.BytesIO()
                Pillow.fromarray(pixels).save(
                    stream, format=encoding.upper(), **({"quality": 95} if encoding == "jpeg" else {})
                )
                data = np.frombuffer(stream.getvalue(), np.uint8)
                writer.write(
                    topic, stamp, types["sensor_msgs/msg/CompressedImage"](header=head, format=encoding, data=data)
                )
                continue
            rows = {"rgb8": pixels, "bgr8": pixels[:, :, ::-1], "mono8": pixels[:, :, 0]}[encoding].reshape(24, -1)
            data = np.hstack([rows, np.zeros((24, 8), np.uint8)]).reshape(-1)
            message = types["sensor_msgs/msg/Image"](
                header=head, height=24, width=32, encoding=encoding, is_bigendian=0, step=rows.shape[1] + 8, data=data
            )
            writer.write(topic, stamp, message)
        if info == {}:
            return
        names = (
            ("D", "K", "R", "P")
            if hasattr(types["sensor_msgs/msg/CameraInfo"], "K")
            or "K" in types["sensor_msgs/msg/CameraInfo"].__dataclass_fields__
            else ("d", "k", "r", "p")
        )
        K = np.array([100.0, 0, 15.5, 0, 101, 11.5, 0, 0, 1])
        values = {"D": np.array([-0.1, 0.01, 0, 0, 0.0]), "K": K, "R": np.eye(3).ravel(), "P": np.zeros(12)} | (
            info or {}
        )
        model = values.pop("distortion_model", "plumb_bob")
        region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        message = types["sensor_msgs/msg/CameraInfo"](
            header=BagMessages(store).header(START_NS, frame),
            height=24,
            width=32,
            distortion_model=model,
            binning_x=0,
            binning_y=0,
            roi=region,
            **{name: values[name.upper()] for name in names},
        )
        writer.write("/cam/camera_info", START_NS, message)

    return fill


PLACES = transforms({("base", "lidar"): np.eye(4), ("base", "camera"): T_LIDAR_CAMERA})


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "png"])
def test_a_bag_s_images_are_those_that_were_written(tmp_path: Path, kind: str, encoding: str) -> None:
    path = bag(tmp_path / f"a{SUFFIX[kind]}", together(PLACES, clouds(4), images(3, encoding)), kind)
    (camera,) = cameras_of(open_sequence(path))
    assert camera.stamps_ns.tolist() == [START_NS + 30_000_000 + k * STEP_NS for k in range(3)]
    assert camera.lens.intrinsics == (100.0, 101.0, 15.5, 11.5)
    assert camera.lens.parameters[5:7].tolist() == [-0.1, 0.01]
    np.testing.assert_allclose(camera.T_lidar_camera, T_LIDAR_CAMERA, atol=1e-9)
    wanted = picture(2) if encoding != "mono8" else np.repeat(picture(2)[:, :, :1], 3, axis=2)
    assert (camera.image(2) == wanted).all()


def test_a_bag_s_camera_without_calibration_or_place_is_one_sentence(tmp_path: Path) -> None:
    def opened(name: str, *fills: Fill) -> Any:
        return open_sequence(bag(tmp_path / name, together(clouds(4), *fills)))

    with pytest.raises(
        InputError, match=r"/cam/image_raw has no calibration: there is no /cam/camera_info; write \[cameras"
    ):
        cameras_of(opened("a.bag", PLACES, images(2, "rgb8", info={})))
    with pytest.raises(InputError, match=r"has no calibration: /cam/camera_info is not filled in"):
        cameras_of(opened("b.bag", PLACES, images(2, "rgb8", info={"K": np.zeros(9)})))
    with pytest.raises(InputError, match=r"has no place: there is no /tf_static that leads from frame lidar to camera"):
        cameras_of(opened("c.bag", images(2, "rgb8")))
    with pytest.raises(InputError, match=r"distortion cubic of 2 coefficients is not known"):
        cameras_of(opened("d.bag", PLACES, images(2, "rgb8", info={"distortion_model": "cubic"})))
    with pytest.raises(InputError, match=r"has no images that lslam reads"):
        cameras_of(opened("e.bag", PLACES))


def test_sequence_toml_beside_a_bag_calibrates_a_topic(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.bag", together(clouds(4), images(2, "png", info={})))
    info = CameraInfo("/cam/image_raw", (90.0, 90.0, 16.0, 12.0), T_LIDAR_CAMERA)
    write_sequence_toml(tmp_path / "sequence.toml", SequenceInfo(cameras={"front": info}))
    (camera,) = cameras_of(open_sequence(path))
    assert camera.name == "front"
    assert camera.lens.size == (32, 24)


def test_mosaics_become_colours_and_strange_encodings_are_named() -> None:
    cells = np.array([[200, 100, 200, 100], [120, 50, 120, 50]], np.uint8)
    image = from_pixels(cells.ravel(), 4, 2, 4, "bayer_rggb8", "x")
    assert (image == (200, 110, 50)).all()
    image = from_pixels(cells.ravel(), 4, 2, 4, "bayer_bggr8", "x")
    assert (image == (50, 110, 200)).all()
    with pytest.raises(InputError, match="images in 32FC1 are not read, only rgb8"):
        from_pixels(cells.ravel(), 4, 2, 4, "32FC1", "x")
    with pytest.raises(InputError, match="8 bytes are no 4 x 3 pixels in mono8"):
        from_pixels(cells.ravel(), 4, 3, 4, "mono8", "x")

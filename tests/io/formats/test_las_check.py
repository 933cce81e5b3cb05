"""LAZ files that lie about their sizes: a sentence, where the decompressor would end the process for want of memory."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import InputError
from lslam.core.types.cloud import ArrayCloud
from lslam.io.formats.point_files import read_cloud, write_cloud

READ = """
import sys
from pathlib import Path
from lslam.core.errors import InputError
from lslam.io.formats.point_files import read_cloud
try:
    read_cloud(Path(sys.argv[1]))
except InputError as error:
    print(error)
    sys.exit(3)
"""


@pytest.fixture
def laz(tmp_path: Path) -> Path:
    points = np.random.default_rng(0).uniform(-50, 50, (2000, 3))
    write_cloud(tmp_path / "a.laz", ArrayCloud.of(points, np.ones(2000, np.float32)), wkt='GEOGCS["a"]')
    return tmp_path / "a.laz"


def edited(path: Path, at: int, code: str, value: int) -> Path:
    data = bytearray(path.read_bytes())
    struct.pack_into(f"<{code}", data, at, value)
    path.write_bytes(data)
    return path


def places(path: Path) -> tuple[int, int]:
    """Where the points begin, and the table of chunks."""
    data = path.read_bytes()
    (start,) = struct.unpack_from("<I", data, 96)
    return start, struct.unpack_from("<q", data, start)[0]


@pytest.mark.parametrize("count", [0xFFFFFFFF, 0x00FFFFFF, 0])
def test_a_count_of_chunks_that_lies_does_not_end_the_process(laz: Path, count: int) -> None:
    edited(laz, places(laz)[1] + 4, "I", count)
    done = subprocess.run([sys.executable, "-c", READ, str(laz)], capture_output=True, text=True, check=False)
    assert done.returncode == 3, done.stderr
    assert "cannot be read as LAS" in done.stdout


def test_every_size_is_held_against_the_file(laz: Path) -> None:
    whole = laz.read_bytes()
    start, table = places(laz)
    layers = start + 8 + 30 + 4  # behind where the table is, one point as it is, and how many points there are
    for at, code, value, words in (
        (100, "I", 0xFFFFFFFF, "records do not fit"),
        (96, "I", 0xFFFFFFF0, "do not fit"),
        (243, "I", 0xFFFFFFFF, "reach beyond"),
        (247, "Q", 2**60, "chunks of 50000"),
        (105, "H", 65535, "have not 65535 bytes"),
        (105, "H", 0, "no bytes"),
        (start, "q", 2**62, "table of chunks is said to lie"),
        (layers, "I", 0xFFFFFFFF, "less than its layers need"),
        (table + 8, "I", 0xFFFFFFFF, "cannot be read"),
    ):
        laz.write_bytes(whole)
        with pytest.raises(InputError, match=words) as caught:
            read_cloud(edited(laz, at, code, value))
        assert str(laz) in str(caught.value)


def test_truncated_las_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.las"
    write_cloud(path, ArrayCloud.of(np.zeros((100, 3))))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="100 points of 30 bytes"):
        read_cloud(path)


def test_clouds_of_many_chunks_read_back(tmp_path: Path) -> None:
    points = np.round(np.random.default_rng(1).uniform(-50, 50, (120_000, 3)), 3)
    write_cloud(tmp_path / "a.laz", ArrayCloud.of(points))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.laz").points, points, atol=1e-6)

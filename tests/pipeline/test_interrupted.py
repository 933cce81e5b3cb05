"""A run that is asked to stop at any of its looks ends as interrupted, and goes on to the same bytes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

import lslam
from lslam.config import Config, load_config
from lslam.errors import InterruptedRunError
from lslam.pipeline.watch import Watch

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "sequences" / "00"
RESULTS = ("trajectory.tum", "covariances.npz", "loops.csv", "graph.g2o", "map.ply", "evaluation.json")


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(None, ["map.voxel=0.5"])


def asked(at: Callable[[int], bool], looks: list[int]) -> Watch:
    """Asks to stop from the look `at` is true of."""
    is_asked = [False]

    def look() -> bool:
        looks.append(len(looks))
        is_asked[0] |= at(looks[-1])
        return is_asked[0]

    return Watch(should_stop=look)


@pytest.fixture(scope="module")
def whole(config: Config, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """An uninterrupted run, and how often it looked."""
    out, looks = tmp_path_factory.mktemp("whole") / "out", list[int]()
    lslam.run(SAMPLE, config, out=out, watch=asked(lambda look: False, looks))
    return out, len(looks)


def test_every_stage_looks(whole: tuple[Path, int]) -> None:
    """Each scan of odometry and of the map, each keyframe, the graph, and before the last word."""
    out, count = whole
    assert count == 95 + json.loads((out / "manifest.json").read_text())["keyframes"]["count"] + 1 + 95 + 1


# Of 95 scans, 48 keyframes, the graph, 95 scans again, and the report.
@pytest.mark.parametrize("look", [0, 40, 94, 96, 130, -97, -96, -50, -2, -1])
def test_asked_at_any_look_it_is_interrupted_and_goes_on(
    look: int, whole: tuple[Path, int], config: Config, tmp_path: Path
) -> None:
    reference, count = whole
    out, looks = tmp_path / "out", list[int]()
    with pytest.raises(InterruptedRunError, match=r"interrupted .*--resume goes on"):
        lslam.run(SAMPLE, config, out=out, watch=asked(lambda k: k == look % count, looks))
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["status"] == "interrupted"
    assert any((out / "checkpoint").glob("odometry-*.npz"))
    assert len(looks) - look % count <= 3, "what comes after the look is not begun"
    lslam.run(SAMPLE, config, out=out, resume=True)
    assert json.loads((out / "manifest.json").read_text())["status"] == "done"
    for name in RESULTS:
        assert (out / name).read_bytes() == (reference / name).read_bytes(), name

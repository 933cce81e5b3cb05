"""Several LiDARs on the command line: --lidar-topic again and again, --lidar-frame, and what a run remembers of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from calling import lslam, strict_json

from lslam.core.geometry import se3
from lslam.io.readers import open_sequence
from lslam.pipeline.convert.bag_writer import BagWriter

SAMPLE = Path(__file__).parents[2] / "sample_data"
T_FRONT_REAR = se3.make(np.diag([-1.0, -1.0, 1.0]), np.array([-2.0, 0.0, 0.0]))
START_NS = 1_700_000_000_000_000_000


def two_lidars(path: Path, topics: tuple[str, str]) -> Path:
    """Scans of the sample, their points left of the sensor by one LiDAR, those right of it by another one."""
    sequence = open_sequence(SAMPLE)
    with BagWriter(path, "mcap") as writer:
        tree = {("front", "rear"): T_FRONT_REAR}
        writer.write("/tf_static", START_NS, writer.messages.transforms(START_NS, tree))
        for k in range(4):
            scan = replace(sequence.scan(k), stamp_ns=START_NS + k * 100_000_000)
            left = scan.points[:, 1] > 0
            away = scan.select(~left)
            back = se3.apply(se3.inverse(T_FRONT_REAR), away.points).astype(np.float32)
            for topic, frame, one in (
                (topics[0], "front", scan.select(left)), (topics[1], "rear", replace(away, points=back)),
            ):  # fmt: skip
                writer.write(topic, one.stamp_ns, writer.messages.cloud(one, frame))
    return path


def test_topics_are_merged_and_a_map_is_made_of_the_same_scans(tmp_path: Path) -> None:
    bag = two_lidars(tmp_path / "a.mcap", ("/front", "/rear"))
    run = tmp_path / "run"
    done = lslam("run", bag, "--lidar-topic", "/front", "--lidar-topic", "/rear", "--out", run, "-q")
    assert done.returncode == 0, done.stderr
    manifest = json.loads((run / "manifest.json").read_text())
    assert manifest["sequence"]["reading"] == {"lidar_topic": "/front,/rear"}
    assert "merged: 4 of 4 scans of rear of /rear, at (-2.000, 0.000, 0.000) m" in str(manifest)
    again = lslam("map", run, "--out", tmp_path / "again.ply", "--json")
    assert again.returncode == 0, again.stderr
    points = strict_json(again.stdout)["points"]
    one = lslam("map", run, "--out", tmp_path / "one.ply", "--lidar-topic", "/front", "--json")
    assert strict_json(one.stdout)["points"] < 0.7 * points


def test_frames_of_one_topic_are_named_and_chosen(tmp_path: Path) -> None:
    bag = two_lidars(tmp_path / "a.mcap", ("/points", "/points"))
    facts = strict_json(lslam("info", bag, "--quick", "--json").stdout)
    assert facts["scans"] == 4
    assert any(
        "LiDARs in turns: those of front (4 messages) are read, those of rear (4)" in p for p in facts["problems"]
    )
    whole = strict_json(lslam("info", bag, "--quick", "--json", "--lidar-frame", "all").stdout)
    assert not any("in turns" in problem for problem in whole["problems"])
    assert whole["points"]["count"]["max"] > 1.5 * facts["points"]["count"]["max"]
    missing = lslam("info", bag, "--lidar-frame", "top")
    assert missing.returncode == 2
    assert "choose among:\n  --lidar-frame front" in missing.stderr

"""Errors on a command line come before heavy imports: checked by the modules loaded, not by time."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lslam.evaluation import WORDS
from lslam.evaluation.evaluate import METRICS

SAMPLE = str(Path(__file__).resolve().parents[2] / "sample_data")
TRUTH = f"{SAMPLE}/poses/00.txt"
# What takes a tenth of a second and more to import; numpy and pydantic take that too, and have a word in what they check.
HEAVY = ("numba", "scipy", "gtsam", "open3d", "matplotlib", "pyarrow", "shapely", "embreex", "rich")

# Command lines with what their errors say, by what may be imported to say it.
NOTHING = [
    (f"run {SAMPLE} --method icpp", "did you mean 'icp'"),
    (f"run {SAMPLE} --residual plan", "did you mean 'plane'"),
    (f"run {SAMPLE} --out used", "used exists"),
    ("run nowhere", "no sequence 'nowhere'"),
    (f"run {SAMPLE} --resume", "--resume needs --out"),
    (f"run {SAMPLE} --resume --overwrite --out new", "give one of them"),
    (f"run {SAMPLE} --poses p.tum --method icp", "drop --method icp"),
    (f"run {SAMPLE} --gt nowhere.tum", "nowhere.tum does not exist"),
    (f"run {SAMPLE} --osm nowhere.osm --origin 49,8", "nowhere.osm does not exist"),
    (f"run {SAMPLE} --metrics foo", "no metrics 'foo'"),
    (f"run {SAMPLE} --profile nowhere/p.json", "is not a folder"),
    (f"run {SAMPLE} --gnss --crs foo", "no EPSG code"),
    (f"eval nowhere.tum {TRUTH}", "nowhere.tum does not exist"),
    (f"eval {TRUTH} {TRUTH} --align foo", "--align foo"),
    (f"eval {TRUTH} {TRUTH} --delta foo", "RPE distance 'foo'"),
    (f"eval {TRUTH} {TRUTH} --plot x.foo", "x.foo: a picture ends with .png, .svg or .pdf"),
    (f"eval {TRUTH} {TRUTH} {TRUTH} --timing t.csv", "--timing belongs to one"),
    ("sweep skip-frames --jobs 0", "--jobs 0"),
    ("sweep --report nowhere", "nowhere/results.csv does not exist"),
    (f"compare {SAMPLE} --methods icp --out used", "is not a comparison"),
    (f"compare {SAMPLE} --methods icp --seeds 1,1", "different whole numbers"),
    ("batch jobs.toml --resume --overwrite", "give one of them"),
    ("simulate block --out used", "used exists already"),
    (f"convert {SAMPLE} --to kitti --out used", "used exists"),
    ("convert nowhere --to kitti --out new", "no sequence 'nowhere'"),
    ("info nowhere", "no sequence 'nowhere'"),
    ("map nowhere", "no folder of a run"),
    ("map nowhere --score", "nowhere does not exist"),
    ("osm fetch --around 1,200", "no place on the Earth"),
]
PYDANTIC = [
    (f"run {SAMPLE} --set map.voxl=1", "did you mean 'voxel'"),
    (f"run {SAMPLE} --set map.voxel=-1", "map.voxel = -1"),
    (f"run {SAMPLE} --preset foo", "no preset 'foo'"),
    (f"run {SAMPLE} --save-feature-map", "no feature map"),
    (f"run {SAMPLE} --method loam --residual plane", "does nothing with method loam"),
    (f"eval {TRUTH} {TRUTH} --set foo.bar=1", "unknown section 'foo'"),
    ("sweep nowhere", "no study 'nowhere'"),
    ("sweep skip-frames --set map.voxl=1", "did you mean 'voxel'"),
    ("sweep skip-frames --out used", "is not a study"),
    (f"compare {SAMPLE} --methods icpp", "did you mean 'icp'"),
    ("batch nowhere.toml", "nowhere.toml cannot be read"),
    ("osm fetch --around 1,2 --out new.osm --set osm.foo=1", "unknown key osm.foo"),
    ("config show --set foo.bar=1", "unknown section 'foo'"),
]
NUMPY = [
    (f"run {SAMPLE} --extrinsics 1,2", "2 numbers"),
    ("compare nowhere --methods icp", "no scenario either"),
    ("simulate nowhere --out new", "no scenario 'nowhere'"),
    ("simulate block --out new --lidar foo", "no LiDAR 'foo'"),
    ("osm show nowhere.osm", "nowhere.osm cannot be read"),
    (f"convert {TRUTH} --to tum --out used/x", "used/x exists; name another file"),
]
CASES = {
    "nothing": (NOTHING, (*HEAVY, "numpy", "pydantic")),
    "pydantic": (PYDANTIC, (*HEAVY, "numpy")),
    "numpy": (NUMPY, HEAVY),
}

# Of one process, the lines one after the other: what one imports stays for all that follow it, so the first to blame is told.
RUNNER = """
import contextlib, io, json, shlex, sys
from lslam.cli.main import main
lines, forbidden = json.load(sys.stdin)
for line in lines:
    sys.argv = ["lslam", *shlex.split(line)]
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        try:
            main()
        except SystemExit as end:
            code = end.code
    print(json.dumps([line, code, said.getvalue(), [name for name in forbidden if name in sys.modules]]))
"""


@pytest.mark.parametrize("may", CASES)
def test_nothing_heavy_is_imported_for_a_usage_error(may: str, tmp_path: Path) -> None:
    cases, forbidden = CASES[may]
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "x").touch()
    environ = {key: value for key, value in os.environ.items() if not key.startswith("LSLAM_")}
    done = subprocess.run(
        [sys.executable, "-c", RUNNER], input=json.dumps([[line for line, _ in cases], forbidden]), cwd=tmp_path,
        env=environ, capture_output=True, text=True, check=True,
    )  # fmt: skip
    ends = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(ends) == len(cases)
    for (line, code, said, imported), (_, expected) in zip(ends, cases, strict=True):
        assert code in (2, 3), line
        assert expected in said, (line, said)
        assert not imported, f"lslam {line} imports {imported}"
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["used", "x"]


def test_the_words_of_metrics_are_those_of_the_metrics() -> None:
    """They are written down a second time, where nothing heavy is imported."""
    assert set(WORDS) == {metric.word for metric in METRICS if metric.word}

"""Warnings of a run are in its manifest and its report, and those of other runs are not."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import pytest
from stub_sequences import sample

import lslam
from lslam.core.config import Config, load_config
from lslam.core.config.config import known_presets
from lslam.core.errors import InterruptedRunError
from lslam.core.types.sequence import StatedTimes
from lslam.core.types.warned import MOST_ALIKE, collect_warnings, warnings_so_far
from lslam.odometry.frontend.checkpoints import CheckpointSchedule
from lslam.pipeline import stages
from lslam.pipeline.doctor.inspect import inspect
from lslam.pipeline.watch import Watch

PACKAGE = Path(lslam.__file__).parent
LOG = logging.getLogger("lslam")
COUNT = 12


def config_of(*settings: str) -> Config:
    # Each scan is decided as it comes: none is registered again on the map of those that follow.
    return load_config(None, ["loops.use=false", "registration.start_scans=1", *settings], {})


def manifest(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return document


def saying(index: int, sentence: str) -> Callable[[int], None]:
    """Reading this scan warns of something, in whatever thread reads."""

    def on_read(at: int) -> None:
        if at == index:
            LOG.warning("%s", sentence)

    return on_read


@pytest.fixture(autouse=True)
def _levels_stay() -> Iterator[None]:
    level = LOG.level
    yield
    assert not LOG.filters
    LOG.setLevel(level)


@pytest.mark.parametrize(
    ("changes", "settings"),
    [
        ({"motion_compensated": None, "stated_times": StatedTimes("none")}, ()),
        ({"motion_compensated": False}, ("preprocess.deskew=false",)),
        ({"scans": [*sample(8).scans, "000008.bin: 1001 bytes are not whole points", *sample(3).scans]}, ()),
        ({"problems": ["calibration is not used: calib.txt is empty"]}, ()),
    ],
)
def test_every_warning_of_the_log_is_a_problem_of_manifest_and_report(
    tmp_path: Path, changes: dict[str, Any], settings: tuple[str, ...]
) -> None:
    out = tmp_path / "out"
    lslam.run(replace(sample(COUNT), **changes), config_of(*settings), out=out)
    lines = (out / "log.txt").read_text().splitlines()
    warned = {line.split(" WARNING ", 1)[1] for line in lines if " WARNING " in line}
    assert warned
    problems = manifest(out)["problems"]
    assert warned <= set(problems)
    assert len(problems) == len(set(problems))
    page = (out / "report.html").read_text()
    section = page[page.index("<h2>What went wrong</h2>") : page.index("<h2>Map</h2>")]
    assert "Nothing" not in section
    for sentence in warned:
        assert escape(sentence) in section.replace("&#39;", "&#x27;")


def test_a_warning_alone_does_not_make_a_run_degraded(tmp_path: Path) -> None:
    strict = config_of("input.strict=true", "map.write=false")
    outcome = lslam.run(replace(sample(5), motion_compensated=None), strict, out=tmp_path / "out")
    facts = manifest(tmp_path / "out")
    assert facts["status"] == "done"
    assert [sentence[:9] for sentence in facts["problems"]] == ["no deskew"]
    assert outcome.record.manifest["problems"] == facts["problems"]


def test_warnings_are_problems_without_a_folder_and_at_any_log_level() -> None:
    LOG.setLevel(logging.CRITICAL)
    outcome = lslam.run(replace(sample(4), motion_compensated=None), config_of())
    assert [sentence[:9] for sentence in outcome.record.manifest["problems"]] == ["no deskew"]
    assert LOG.level == logging.CRITICAL


def test_keys_of_the_imu_in_a_run_without_one_are_warned_of() -> None:
    given = config_of("imu.estimate_offset=true", "imu.gyro_noise=0.001", "imu.start_s=5.0")
    (sentence,) = lslam.run(sample(4), given).record.manifest["problems"]
    assert sentence.startswith("imu.gyro_noise, imu.estimate_offset: without effect")


@pytest.mark.parametrize("preset", sorted(known_presets()))
def test_keys_that_a_preset_set_are_not_warned_of(preset: str) -> None:
    """Those set beside it are; of values as the preset has them nobody can tell who set them."""
    plain, own = (config_of(f"odometry.preset={preset}", *more) for more in ([], ["imu.gyro_noise=0.001"]))
    said = [lslam.run(sample(4), config).record.manifest["problems"] for config in (plain, own)]
    assert not [sentence for sentence in said[0] if "without effect" in sentence]
    assert [sentence for sentence in said[1] if sentence.startswith("imu.gyro_noise: without effect")]


def test_warnings_before_a_run_are_problems_of_the_run(tmp_path: Path) -> None:
    with collect_warnings():
        LOG.warning("times.txt has 3 stamps")
        lslam.run(sample(4), config_of("map.write=false"), out=tmp_path / "out")
    assert manifest(tmp_path / "out")["problems"] == ["times.txt has 3 stamps"]


def test_warnings_of_consecutive_and_concurrent_runs_do_not_mix(tmp_path: Path) -> None:
    settings = config_of("map.write=false", "report.html=false", "input.threads=2")
    both = threading.Barrier(2)

    def drive(name: str) -> None:
        def on_read(index: int) -> None:
            if index == 2:  # after the first scans were read to know their sweep
                LOG.warning("a word of %s", name)

        def on_start(stage: str, total: int) -> None:
            both.wait(60)

        watch = Watch(on_start=on_start)
        lslam.run(replace(sample(5), on_read=on_read), settings, out=tmp_path / name, watch=watch)

    threads = [threading.Thread(target=drive, args=(name,)) for name in ("one", "two")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    lslam.run(sample(5), settings, out=tmp_path / "three")
    assert [manifest(tmp_path / name)["problems"] for name in ("one", "two", "three")] == [
        ["a word of one"], ["a word of two"], [],
    ]  # fmt: skip


@pytest.mark.parametrize("threads", [1, 2])
def test_a_resumed_run_keeps_its_warnings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    monkeypatch.setattr(CheckpointSchedule, "is_due", True)
    settings = config_of("report.html=false", f"input.threads={threads}")
    stub = replace(sample(COUNT), motion_compensated=None, stated_times=StatedTimes("none"))
    lslam.run(replace(stub, on_read=saying(3, "scan 3 looks odd")), settings, out=tmp_path / "whole")
    whole = sorted(manifest(tmp_path / "whole")["problems"])
    assert whole[1:] == ["scan 3 looks odd"]

    out, left = tmp_path / "out", [9]
    watch = Watch(on_step=lambda: left.__setitem__(0, left[0] - 1), should_stop=lambda: left[0] <= 0)
    with pytest.raises(InterruptedRunError):
        lslam.run(replace(stub, on_read=saying(3, "scan 3 looks odd")), settings, out=out, watch=watch)
    assert manifest(out)["problems"][0].startswith("interrupted after 9 of 12")
    lslam.run(stub, settings, out=out, resume=True)
    assert sorted(manifest(out)["problems"]) == whole


def test_a_resumed_map_keeps_its_warnings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CheckpointSchedule, "is_due", True)
    stub, out, begun = sample(COUNT), tmp_path / "out", [False]

    class Killed(BaseException):
        """Ends the process's part of the test at once."""

    def on_read(index: int) -> None:
        if begun[0] and index == 2:
            LOG.warning("a voxel looks odd")
        if begun[0] and index == 9:
            raise Killed

    def on_start(stage: str, total: int) -> None:
        begun[0] = stage == "map"

    settings = config_of("report.html=false", "input.threads=1")
    with pytest.raises(Killed):
        lslam.run(replace(stub, on_read=on_read), settings, out=out, watch=Watch(on_start=on_start))
    lslam.run(stub, settings, out=out, resume=True)
    assert manifest(out)["problems"] == ["a voxel looks odd"]


def test_a_failed_run_lists_its_warnings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise MemoryError("no room")

    monkeypatch.setattr(stages, "make_map", broken)
    with pytest.raises(MemoryError):
        lslam.run(replace(sample(4), motion_compensated=None), config_of(), out=tmp_path / "out")
    facts = manifest(tmp_path / "out")
    assert (facts["status"], facts["why"]) == ("failed", "no room")
    assert [sentence[:9] for sentence in facts["problems"]] == ["no deskew"]


def test_similar_warnings_are_counted_and_listed_once() -> None:
    with collect_warnings() as heard:
        for scan in range(100):
            LOG.warning("scan %d skipped: no points", scan)
        LOG.warning("icp: the frames look WRONG")
        LOG.info("nothing to worry about")
        heard.filter(logging.LogRecord("lslam", logging.ERROR, "theirs.py", 1, "cut %s short", ("1", "2"), None))
    said = heard.beyond(["the frames look WRONG"])
    assert said[:MOST_ALIKE] == [f"scan {k} skipped: no points" for k in range(MOST_ALIKE)]
    assert said[MOST_ALIKE:] == [
        f"{100 - MOST_ALIKE} more such warnings stand in the log, after: scan {MOST_ALIKE - 1} skipped: no points",
        "cut %s short",
    ]
    LOG.warning("nobody listens")
    assert not warnings_so_far().beyond([])


def test_every_thread_of_a_run_shares_its_context() -> None:
    """Only simulations and studies, which are no runs, start threads that do not."""
    sources = [p for p in PACKAGE.rglob("*.py") if p.relative_to(PACKAGE).parts[0] not in ("simulation", "studies")]
    for path in sources:
        text = path.read_text()
        starts = text.count(".submit(") + text.count("threading.Thread(")
        assert text.count("copy_context().run") == starts, path
    assert any("copy_context().run" in path.read_text() for path in sources)


def test_scans_of_which_a_part_was_wrong_are_named_and_the_run_is_degraded(tmp_path: Path) -> None:
    faults = {2: "5 points have times outside the sweep and are left out", 4: "the scan has no field 't'"}
    scans = [
        replace(scan, fault=faults.get(k, "")) for k, scan in enumerate(sample(6).scans) if not isinstance(scan, str)
    ]
    sequence = replace(sample(6), scans=scans)
    lslam.run(sequence, config_of("map.write=false"), out=tmp_path / "out")
    facts = manifest(tmp_path / "out")
    assert facts["status"] == "degraded"
    (sentence,) = facts["problems"]
    assert sentence == f"in 2 of 6 scans not all was right and the rest was used (2, 4); scan 2: {faults[2]}"
    assert f"WARNING {sentence}" in (tmp_path / "out" / "log.txt").read_text()
    (finding,) = [f for f in inspect(sequence, is_quick=True)["findings"] if f["code"] == "scan-faults"]
    assert faults[2] in finding["what"]

"""The manifest's words, and what is checked before a run."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from stub_sequences import Stub

from lslam.core.config import Config, load_config
from lslam.core.errors import InterruptedRunError, OutputError, UsageError
from lslam.core.types.scan_result import ScanResult, Status
from lslam.pipeline.check import check_config
from lslam.pipeline.manifest import Manifest, describe_deskew, peak_memory_mb


def results(*statuses: Status) -> list[ScanResult]:
    return [
        ScanResult(10 + i, i, np.eye(4), status, "" if status == "ok" else f"why {i}")
        for i, status in enumerate(statuses)
    ]


def judged(expected: int, diverged: bool, *statuses: Status) -> Manifest:
    manifest = Manifest("lslam run x", Stub(["gone"] * expected), Config())
    manifest.judge(results(*statuses), expected, diverged)
    return manifest


def test_outcome_in_one_word() -> None:
    assert judged(3, False, "ok", "ok", "ok").outcome == "done"
    assert judged(3, False, "ok", "bridged", "ok").outcome == "degraded"
    assert judged(3, False, "ok", "ok").outcome == "interrupted"
    assert judged(3, True, "ok", "bridged").outcome == "diverged"
    assert judged(3, True, "bridged", "bridged", "bridged").outcome == "diverged"


def test_problems_name_the_first_bad_scan_by_its_number_in_the_recording() -> None:
    manifest = judged(4, False, "ok", "skipped", "bridged", "ok")
    assert manifest.counts == {
        "scans": 4,
        "ok": 2,
        "bridged": 1,
        "skipped": 1,
        "standing": 0,
        "degenerate": 0,
        "fallback": 0,
    }
    assert "2 of 4 scans" in manifest.problems[0]
    assert "scan 11: why 1" in manifest.problems[0]


def test_the_document_is_plain_and_strict_json() -> None:
    manifest = judged(2, False, "ok", "ok")
    with manifest.time("map_s"), manifest.time("map_s"):
        pass
    document = json.loads(json.dumps(manifest.as_dict("done"), allow_nan=False))
    assert (document["schema"], document["status"], document["command"]) == (1, "done", "lslam run x")
    assert document["timings"].keys() == {"map_s"}
    assert "why" not in document
    assert manifest.as_dict("failed", "the disk")["why"] == "the disk"
    assert document["frames"]["pose_time"] == "scan_start"


def test_what_ended_a_run() -> None:
    manifest = judged(1, False, "ok")
    assert manifest.word_for(KeyboardInterrupt()) == "interrupted"
    assert manifest.word_for(InterruptedRunError("x")) == "interrupted"
    assert manifest.word_for(OutputError("x")) == manifest.word_for(ValueError()) == "failed"


@pytest.mark.parametrize(
    ("compensated", "has_times", "how", "words", "is_distorted"),
    [(True, True, "twice", "none needed", False), (None, False, "twice", "no deskew: .*not known.* no times", True),
     (False, False, "twice", "no deskew: .*is not motion", True), (False, True, "twice", "twice$", False),
     (None, True, "no deskew, none at all", "no deskew", False),
     (False, True, "", "no deskew: icp takes each scan as one instant", True)],
)  # fmt: skip
def test_deskew_is_stated(compensated: bool | None, has_times: bool, how: str, words: str, is_distorted: bool) -> None:
    stub = Stub([], motion_compensated=compensated)
    said, is_so = describe_deskew(stub, Config(), has_times, how)
    assert re.match(words, said)
    assert is_so == is_distorted


def test_deskew_switched_off_is_stated() -> None:
    off = load_config(None, ["preprocess.deskew=false"], {})
    said = describe_deskew(Stub([], motion_compensated=False), off, True, "twice")
    assert said == ("no deskew: preprocess.deskew is off", True)


def test_peak_memory_is_in_megabytes() -> None:
    peak = peak_memory_mb()
    if peak is not None:
        assert 20 < peak < 64_000


def test_names_are_checked_with_a_way_out() -> None:
    check_config(Config())
    for setting, words in (
        ("odometry.method=kis-icp", "did you mean 'kiss-icp'"),
        ("odometry.method=zzz", "known: icp, "),
        ("eval.delta=['ten metres']", "for example 10m/all"),
        ("eval.delta=['1.5scan']", "whole numbers"),
    ):
        with pytest.raises(UsageError, match=words):
            check_config(load_config(settings=[setting], environ={}))


@pytest.mark.parametrize(
    ("method", "setting", "heeds"),
    [("loam", "target='scan'", False), ("lego-loam", "inlier_ratio=0.8", False), ("floam", "inlier_distance=2", False),
     ("kiss-icp", "target='keyframe'", False), ("small-gicp", "residual='ndt'", False), ("icp-svd", "target='keyframe'", False),
     ("icp-svd", "residual='point'", False), ("loam", "target='map'", True), ("icp-svd", "target='scan'", True),
     ("dlo", "target='scan'", False), ("dlo", "residual='plane'", False), ("icp", "target='submap'", True),
     ("dlo", "inlier_ratio=0.8", True), ("icp-svd", "inlier_ratio=0.8", True), ("icp-svd", "inlier_distance=2", True),
     ("ndt", "target='keyframe'", True),
     ("gicp", "inlier_ratio=0.8", True), ("icp", "residual='ndt'", True)],
)  # fmt: skip
def test_a_key_that_the_method_would_pass_over_is_refused(method: str, setting: str, heeds: bool) -> None:
    config = load_config(settings=[f"odometry.method={method}", f"registration.{setting}"], environ={})
    if heeds:
        check_config(config)
        return
    key = setting.partition("=")[0]
    with pytest.raises(
        UsageError, match=rf"registration\.{key} = .* does nothing with method {method}.*\(icp, icp-point"
    ):
        check_config(config)


@pytest.mark.parametrize(
    ("method", "settings", "words"),
    [("lio-sam", ("recovery.fallback=all-points",), r"recovery\.fallback = 'all-points' .* method lio-sam.*\(loam-odom, loam"),
     ("lio-sam", ("lio_sam.features=points", "registration.keyframes=5"), "method lio-sam: drop it, or"),
     ("lio-sam", ("registration.keyframe_deg=5",), "method lio-sam: drop it, or"),
     ("lio-sam", ("graph.gravity_deg=0",), r"^graph\.gravity_deg = 0 .* lio_sam\.graph_imu brings it in"),
     ("lio-sam", ("graph.gravity_deg=0", "lio_sam.graph_imu=false"), ""),
     ("ct-icp", ("registration.keyframe_m=1",), "method ct-icp: drop it, or"),
     ("lips", ("recovery.fallback=all-points",), "method lips"),
     ("lio-mapping", ("recovery.fallback=all-points",), "method lio-mapping"),
     ("ct-icp", ("recovery.fallback=all-points",), "method ct-icp"), ("icp", ("recovery.fallback=all-points",), "method icp"),
     ("loam-livox", ("recovery.fallback=all-points",), ""), ("lio-sam", ("recovery.start_search=false",), ""),
     ("lips", ("graph.gravity_deg=0",), ""), ("icp", ("registration.keyframes=5",), "")],
)  # fmt: skip
def test_what_a_method_overrides_is_refused_and_what_it_does_anyway_is_not(
    method: str, settings: tuple[str, ...], words: str
) -> None:
    config = load_config(settings=[f"odometry.method={method}", *settings], environ={})
    if not words:
        check_config(config)
        return
    with pytest.raises(UsageError, match=words):
        check_config(config)


def test_what_a_preset_says_and_its_method_only_heeds_is_said_to_be_the_presets() -> None:
    preset = "odometry.preset=thesis-icp"
    with pytest.raises(
        UsageError, match=r"preset thesis-icp sets registration\.target = 'sample', which .* method loam"
    ):
        check_config(load_config(None, [preset, "odometry.method=loam"], {}))
    own = [preset, "odometry.method=loam", "registration.target=keyframe"]
    with pytest.raises(UsageError, match=r"^registration\.target = 'keyframe' does nothing with method loam"):
        check_config(load_config(None, own, {}))
    check_config(load_config(None, [preset, "odometry.method=icp-svd"], {}))


def test_coordinates_of_a_run_with_no_place_on_the_earth_are_refused() -> None:
    with pytest.raises(UsageError, match=r"^--crs does nothing without --gnss, --georeference, --osm or --control"):
        check_config(load_config(settings=["gnss.crs=25832"], environ={}))
    for place in ("gnss.mode=fit", "gnss.mode=graph", 'osm.extract="town.osm"', 'graph.control="points.csv"'):
        check_config(load_config(settings=["gnss.crs=25832", place], environ={}))


@pytest.mark.parametrize("setting", ['loops.file="edits.csv"', 'graph.control="points.csv"'])
def test_what_works_on_a_graph_is_refused_where_a_map_holds_the_poses(setting: str) -> None:
    check_config(load_config(settings=[setting], environ={}))
    with pytest.raises(UsageError, match="--control do nothing there, drop them"):
        check_config(load_config(settings=[setting, 'localize.map="runs/first"'], environ={}))


def test_scans_are_counted_by_the_method_that_posed_them() -> None:
    manifest = Manifest("lslam run x", Stub(["gone"] * 4), Config())
    ok, policy, bridged, standing = results("ok", "ok", "bridged", "ok")
    policy, standing = (
        replace(policy, posed_by="start search"),
        replace(standing, is_stationary=True, repeats_pose=True),
    )
    manifest.judge([ok, policy, bridged, standing], 4, False)
    assert manifest.as_dict("done")["posed_by"] == {"icp": 1, "start search": 1, "motion prior": 1, "standing": 1}


@pytest.mark.parametrize(("weak", "outcome"), [(1, "done"), (2, "degraded")])
def test_more_than_a_tenth_of_the_scans_with_an_open_direction_degrade_the_run(weak: int, outcome: str) -> None:
    manifest = Manifest("lslam run x", Stub(["gone"] * 10), Config())
    found = results(*["ok"] * 10)
    along = np.eye(6)[:1]
    manifest.judge([replace(r, degenerate=along) if i < weak else r for i, r in enumerate(found)], 10, False)
    assert manifest.outcome == outcome
    assert all("scan 10: along x" in problem for problem in manifest.problems)


@pytest.mark.parametrize("key", ["estimate_offset", "estimate_extrinsics"])
def test_the_imus_clock_and_mounting_need_registration_to_be_estimated(key: str) -> None:
    """`integrated` carries the first seconds' calibration to the end."""
    asked = (f"imu.{key}=true", "imu.use=true")
    check_config(load_config(None, asked, {}))
    with pytest.raises(
        UsageError, match=r"estimate_extrinsics learn from registered turns, of which .* drop them, or imu\.v"
    ):
        check_config(load_config(None, [*asked, "imu.velocity=integrated"], {}))

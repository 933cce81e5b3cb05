"""`--preset` and `lslam config presets` as a user calls them."""

from __future__ import annotations

import tomllib
from pathlib import Path

from calling import SAMPLE, environment, lslam, lslam_process

PRESET = (
    'summary = "mine"\n[odometry]\nmethod = "kiss-icp"\n[map]\nvoxel = 0.5\nwrite = false\n[input]\nskip_frames = 2\n'
)


def test_flags_override_settings_override_the_preset(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(PRESET)
    done = lslam_process(
        "run", SAMPLE, "--preset", "mine.toml", "--method", "icp", "--set", "map.voxel=0.4", "--count", "6",
        "--out", "out", cwd=tmp_path, env=environment(LSLAM_MAP_VOXEL="0.3", PYTHONPATH=str(SAMPLE.parent)),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    resolved = tomllib.loads((tmp_path / "out" / "config.toml").read_text())
    assert resolved["odometry"]["preset"] == str((tmp_path / "mine.toml").resolve())
    assert (resolved["odometry"]["method"], resolved["map"]["voxel"]) == ("icp", 0.4)
    assert (resolved["map"]["write"], resolved["input"]["skip_frames"]) == (False, 2)
    assert not (tmp_path / "out" / "map.ply").exists()


def test_show_resolves_a_preset(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(PRESET)
    done = lslam("config", "show", "--preset", tmp_path / "mine.toml", "--set", "map.voxel=0.7")
    shown = tomllib.loads(done.stdout)
    assert (done.returncode, shown["odometry"]["method"], shown["map"]["voxel"]) == (0, "kiss-icp", 0.7)


def test_errors_about_mistyped_names_suggest_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text('[odometry]\nmethod = "kis-icp"\n')
    for words in (
        ("run", SAMPLE, "--method", "kis-icp"),
        ("run", SAMPLE, "--config", "c.toml", "--dry-run"),
        ("config", "show", "--set", "odometry.method=kis-icp"),
        ("config", "check", "c.toml"),
    ):
        done = lslam(*words, cwd=tmp_path)
        assert (done.returncode, done.stdout) == (2, ""), words
        assert "did you mean 'kiss-icp'" in done.stderr
    done = lslam("run", SAMPLE, "--preset", "nonsense", cwd=tmp_path)
    assert done.returncode == 2
    assert "no preset 'nonsense'" in done.stderr
    assert not (tmp_path / "runs").exists()

"""Presets: their precedence among other values, and errors about wrong ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from lslam.core.config import Config, load_config, to_toml
from lslam.core.config.config import BASE, known_presets, read_preset
from lslam.core.errors import ConfigError, InputError, UsageError

MINE = """summary = "ours"
[preprocess]
range_max = 40.0
range_min = 2.0
random_share = 0.5
[odometry]
method = "kiss-icp"
[map]
voxel = 0.5
write = false
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(MINE)
    return path


def load(*settings: str, path: Path | None = None, **environ: str) -> Config:
    return load_config(path, settings, environ)


def test_a_preset_stands_under_everything_but_the_defaults(mine: Path, tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[preprocess]\nrange_min = 3\n[map]\nvoxel = 0.3\n")
    config = load(f"odometry.preset={mine}", "preprocess.random_share=0.7", path=file, LSLAM_MAP_VOXEL="0.4")
    p = config.preprocess
    assert (p.range_max, p.range_min, p.random_share) == (40.0, 3.0, 0.7)
    assert (config.map.voxel, config.map.write, config.odometry.method) == (0.4, False, "kiss-icp")
    assert p.map_leaf == Config().preprocess.map_leaf


def test_file_environment_and_setting_may_name_it_and_the_highest_wins(mine: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_text("[map]\nvoxel = 0.9\n")
    file = tmp_path / "c.toml"
    file.write_text(f'[odometry]\npreset = "{mine}"\n')
    assert load(path=file).map.voxel == 0.5
    assert load(path=file, LSLAM_ODOMETRY_PRESET=str(other)).map.voxel == 0.9
    assert load(f"odometry.preset={mine}", LSLAM_ODOMETRY_PRESET=str(other)).map.voxel == 0.5


def test_a_preset_may_stand_on_another_one(tmp_path: Path) -> None:
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text("[map]\nvoxel = 0.9\nwrite = false\n")
    second.write_text(f'summary = "two"\nbase = "{first}"\n[map]\nvoxel = 0.7\n')
    config = load(f"odometry.preset={second}")
    assert (config.map.voxel, config.map.write, config.odometry.preset) == (0.7, False, str(second))
    first.write_text(f'base = "{second}"\n')
    with pytest.raises(ConfigError, match="one cannot stand on itself"):
        load(f"odometry.preset={second}")


def test_a_resolved_configuration_repeats_itself_and_names_its_preset(
    mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = load("odometry.preset=mine.toml", "map.voxel=0.25")
    assert before.odometry.preset == str(mine.resolve())
    resolved = tmp_path / "resolved.toml"
    resolved.write_text(to_toml(before))
    monkeypatch.chdir("/")
    assert load(path=resolved) == before


def test_an_unknown_preset_is_answered_with_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    shipped = {"thesis-icp": "", "thesis-loam": ""}
    monkeypatch.setattr("lslam.core.config.config._presets", lambda: shipped)
    with pytest.raises(
        UsageError, match=r"no preset 'thesis-ipc' and no TOML file; did you mean 'thesis-icp'"
    ) as caught:
        load("odometry.preset=thesis-ipc")
    assert caught.value.exit_code == 2


def test_wrong_files_and_keys_of_a_preset_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"preset none\.toml cannot be read: No such file"):
        load("odometry.preset=none.toml")
    for text, words in (
        ("[map]\nvoxl = 1\n", r"preset .*p\.toml: unknown key map\.voxl; did you mean 'voxel'"),
        ("[map\n", "not valid TOML"),
        ("voxel = 1\n", "unknown section 'voxel'"),
        ('[odometry]\npreset = "thesis-icp"\n', "what it stands on is said by base"),
        ("[map]\nvoxel = -1\n", r"map\.voxel = -1"),
    ):
        (tmp_path / "p.toml").write_text(text)
        with pytest.raises(ConfigError, match=words):
            load(f"odometry.preset={tmp_path / 'p.toml'}")


@pytest.mark.parametrize("name", sorted(known_presets()))
def test_every_shipped_preset_loads_and_says_what_it_is(name: str) -> None:
    assert len(known_presets()[name]) > 20
    config = load(f"odometry.preset={name}")
    assert config.odometry.preset == name
    sections = {section: values for section, values in read_preset(name).items() if section != BASE}
    assert len(sections) > 1
    for section, values in sections.items():
        for key, value in values.items():
            assert getattr(getattr(config, section), key) == (tuple(value) if isinstance(value, list) else value)


def test_methods_of_the_presets_exist() -> None:
    from lslam.odometry import create_odometry

    for name in known_presets():
        assert callable(create_odometry(load(f"odometry.preset={name}")).register)

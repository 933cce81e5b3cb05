"""Sources of configuration values, their precedence, and errors about wrong ones."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lslam.core.config import Config, load_config, to_toml
from lslam.core.config.config import former_keys
from lslam.core.errors import ConfigError, InputError


def load(*settings: str, path: Path | None = None, **environ: str) -> Config:
    return load_config(path, settings, environ)


def test_defaults_survive_a_round_trip(tmp_path: Path) -> None:
    file = tmp_path / "config.toml"
    for settings in ((), ("map.voxel=0.1", "input.count=7", "preprocess.ego_box=[-1,1,-2,2,-3,3.5]")):
        before = load(*settings)
        file.write_text(to_toml(before))
        assert load(path=file) == before


def test_set_wins_over_environment_over_file_over_defaults(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text('[map]\nvoxel = 0.3\nrange_min = 3\n[odometry]\nmethod = "kiss-icp"\n')
    config = load("map.voxel=0.5", path=file, LSLAM_MAP_VOXEL="0.4", LSLAM_MAP_RANGE_MIN="4", HOME="/x")
    assert (config.map.voxel, config.map.range_min, config.odometry.method) == (0.5, 4.0, "kiss-icp")
    assert config.map.range_max == Config().map.range_max


def test_values_need_no_quotes_and_may_have_them() -> None:
    for text in ("odometry.method=kiss-icp", 'odometry.method="kiss-icp"', " odometry.method = kiss-icp "):
        assert load(text).odometry.method == "kiss-icp"
    assert load("eval.align=['sim3']").eval.align == ("sim3",)
    assert load("report.html=false").report.html is False


def test_variables_of_others_are_left_alone() -> None:
    assert load(LSLAM_DATA="/data", LSLAM_COMPLETE="x", LSLAM_="1", LSLAM_MAP="1", PATH="/bin") == Config()


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("map.voxl=1", "unknown key map.voxl; did you mean 'voxel'"),
        ("mapp.voxel=1", "unknown section 'mapp'; did you mean 'map'"),
        ("voxel=1", "expected section.key=value"),
        ("map.voxel", "expected section.key=value"),
        ("map.voxel=-1", "map.voxel = -1"),
        ("map.voxel=fast", "map.voxel = 'fast'"),
        ("map.voxel=nan", "map.voxel = nan"),
        ("map.voxel=inf", "finite"),
        ("map.voxel=1e-9", "0.01"),
        ("map.range_max=1", "map: range_min = 2.0 must be less than range_max = 1.0"),
        ("preprocess.range_min=100", "range_min = 100.0 must be less"),
        ("preprocess.source_points_min=6000", "source_points_min = 6000 must be less"),
        ("preprocess.ego_box=[1,0,0,1,0,1]", "x_min, x_max, y_min, y_max, z_min, z_max"),
        ("preprocess.downsample=grd", "did you mean 'grid'"),
        ("registration.kernel_max=0.1", "registration.kernel_max = 0.1: Input should be greater than 0.15"),
        ("input.threads=-1", "input.threads = -1"),
        ("input.count=0", "input.count = 0"),
        ("input.start=-1", "input.start = -1"),
        ("input.strict=maybe", "input.strict = 'maybe'"),
        ("eval.align=['umeyama']", "'se3'"),
        ("eval.time_offset=atuo", "or Input should be 'auto'"),
    ],
)
def test_wrong_values_name_the_key_and_the_way_out(setting: str, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(setting)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("odometry.max_failures=8", "new segment"),
        ("registration.min_inliers=0.1", r"registration\.min_agreement"),
        ("registration.start_overlap=0.1", r"registration\.min_overlap"),
        ("osm.coverage_weight=1.0", r"second of osm\.weights"),
        ("osm.building_sigma=2.0", r"twice osm\.map_sigma"),
        ("loops.memory=bounded", r"loops\.memory_places"),
        ("graph.incremental=true", r'graph\.optimizer = "isam2"'),
        ("graph.gravity=false", r"graph\.gravity_deg = 0"),
        ("graph.imu_orientation=true", r"graph\.imu_orientation_deg"),
        ("debug.drift_estimate=run.tum", r"first of debug\.drift_recording"),
    ],
)
def test_a_key_of_an_earlier_version_is_answered_with_what_became_of_it(setting: str, words: str) -> None:
    with pytest.raises(ConfigError, match=rf"no {setting.partition('=')[0]} any more.*{words}"):
        load_config(settings=[setting])


FIXED = {
    f"{section}.{key}": entry
    for section, entries in former_keys().items()
    for key, entry in entries.items()
    if "outcome" not in entry
}


@pytest.mark.parametrize("name", FIXED)
def test_a_key_that_is_fixed_now_is_answered_with_its_value_and_what_to_turn(name: str, tmp_path: Path) -> None:
    value, instead = FIXED[name]["value"], FIXED[name].get("instead", "")
    section, _, key = name.partition(".")
    assert key not in type(getattr(Config(), section, Config())).model_fields
    way_out = f"turn {instead} instead" if instead else "leave the key out"
    with pytest.raises(ConfigError) as caught:
        load(f"{name}={value}")
    assert f"no {name} any more: it is {value} in all runs; {way_out}" in str(caught.value)
    if instead:
        section_of_it, _, key_of_it = instead.partition(".")
        assert key_of_it in type(getattr(Config(), section_of_it)).model_fields
    # The file of an earlier run has it at its value.
    file = tmp_path / "config.toml"
    file.write_text(f"[{section}]\n{key} = {json.dumps(value)}\n")
    assert load(path=file) == Config()
    file.write_text(f"[{section}]\n{key} = 0.123\n")
    with pytest.raises(ConfigError, match=rf"config\.toml: there is no {name} any more"):
        load(path=file)


def test_the_source_of_an_unknown_key_is_named(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[map]\nvoxels = 1\n")
    with pytest.raises(ConfigError, match=r"mine\.toml: unknown key map\.voxels; did you mean 'voxel'"):
        load(path=file)
    with pytest.raises(ConfigError, match=r"environment: unknown key map\.voxe"):
        load(LSLAM_MAP_VOXE="1")


def test_files_that_are_no_configuration(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml cannot be read: No such file") as missing:
        load(path=tmp_path / "none.toml")
    assert missing.value.exit_code == 3
    for name, data, words in (
        ("broken.toml", b"[map\nvoxel = 1", "not valid TOML: .*line 1"),
        ("flat.toml", b"map = 1", "'map' is a section"),
        ("latin.toml", b"# \xe9\xff", "not UTF-8"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises((ConfigError, InputError), match=words):
            load(path=tmp_path / name)
    (tmp_path / "bom.toml").write_bytes(b"\xef\xbb\xbf[map]\nvoxel = 0.5\n")
    assert load(path=tmp_path / "bom.toml").map.voxel == 0.5


def test_sections_are_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        Config().map.voxel = 1.0  # type: ignore[misc]


def test_every_key_says_what_it_is() -> None:
    for name in Config.model_fields:
        section = getattr(Config(), name)
        for key, field in type(section).model_fields.items():
            assert field.description, f"{name}.{key} has no description"

"""Study files: what they expand to, and what is wrong with them in one sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lslam.core.config.study import Range, StudyConfig, parse_study, read_study
from lslam.core.errors import ConfigError, InputError

TEXT = """
methods = ["icp"]
sequences = [{ scenario = "block", columns = 512 }, { path = "seq07" }]
[parameters]
input.skip_frames = { start = 1, stop = 5, step = 2 }
"preprocess.random_share" = [0.3, 1]
"""
FINDING = '[[finding]]\ntext = "So."\nkind = "good_from"\nvalues = [1]\n{}\n[parameters]'


def study(tmp_path: Path, text: str = TEXT) -> StudyConfig:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return read_study(path)


def test_parameters_make_a_full_grid_the_last_one_innermost(tmp_path: Path) -> None:
    points = study(tmp_path).points()
    assert points[:2] == [
        {"input.skip_frames": 1, "preprocess.random_share": 0.3}, {"input.skip_frames": 1, "preprocess.random_share": 1},
    ]  # fmt: skip
    assert len(points) == 6
    assert [p["input.skip_frames"] for p in points[::2]] == [1, 3, 5]


def test_one_way_varies_one_parameter_at_a_time(tmp_path: Path) -> None:
    points = study(tmp_path, 'grid = "one-way"\n' + TEXT).points()
    assert [list(point) for point in points] == [["input.skip_frames"]] * 3 + [["preprocess.random_share"]] * 2


def test_a_study_is_called_like_its_file_unless_it_has_a_name(tmp_path: Path) -> None:
    assert study(tmp_path).name == "mine"
    assert study(tmp_path, 'name = "yours"\n' + TEXT).name == "yours"


@pytest.mark.parametrize(
    ("given", "values"),
    [
        ({"start": 0.1, "stop": 1.0, "step": 0.1}, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]),
        ({"start": 1, "stop": 6, "step": 2}, [1, 3, 5]),
        ({"start": 0.0, "stop": 1.0, "num": 3}, [0.0, 0.5, 1.0]),
        ({"start": 0.1, "stop": 10.0, "num": 3, "log": True}, [0.1, 1.0, 10.0]),
        ({"start": 1, "stop": 1, "step": 1}, [1]),
    ],
)
def test_ranges_hold_both_ends_and_round_numbers(given: dict[str, Any], values: list[float]) -> None:
    made = Range(**given).values()
    assert list(made) == values
    assert [type(v) for v in made] == [type(v) for v in values]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("stop = 5", "stop = 0", r"mine\.toml.*from 1 to 0 is empty: stop lies below start$"),
        ("step = 2", "log = true, step = 1", "log needs num"),
        ("step = 2", "step = 2, num = 3", "a step or num, one of them"),
        ("step = 2", "step = 0", "greater than 0"),
        ("step = 2", "step = 1e-10", r"from 1 to 5 has more than 10000 values$"),
        ("step = 2", "num = 1000000000000", "has more than 10000 values$"),
        ("stop = 5", "stop = inf", "finite number|has more than 10000 values"),
        ("stop = 5", f"stop = 1{'0' * 400}", "has more than 64 bits"),
        ("stop = 5, step = 2", "stop = 1e308, step = 5e-324", "has more than 10000 values$"),
        (
            "[0.3, 1]",
            '{ start = 0.1, stop = 1, num = 9999 }\n"map.voxel" = { start = 0.1, stop = 1, num = 9999 }',
            "combinations, more than 100,000: vary fewer",
        ),
        (
            'path = "seq07"',
            'path = "seq07", count = 0',
            r"mine\.toml: sequences\.count = 0: .*greater than or equal to 1$",
        ),
        ('{ scenario = "block", columns = 512 }, { path = "seq07" }', '{ path = "x", count = 0 }', r"or equal to 1$"),
        ('path = "seq07"', 'path = "seq07", start = -1', r"sequences\.start = -1: .*greater than or equal to 0$"),
        ('path = "seq07"', 'path = "seq07", coumt = 9', "sequences: unknown key 'coumt'; did you mean 'count'"),
        ('path = "seq07"', 'path = "seq07", skip_frames = 2', r"input\.skip_frames is studied, and sequence seq07 has"),
        ("[0.3, 1]", "[]", r"preprocess\.random_share has no values"),
        ("[0.3, 1]", "[0.3, 0.3]", "has a value twice"),
        ('["icp"]', "[]", "methods"),
        ("methods =", "method =", "unknown key 'method'; did you mean 'methods'"),
        ("columns = 512", "colums = 512", "sequences: unknown key 'colums'; did you mean 'columns'"),
        ('path = "seq07"', 'path = "seq07", speed = 3', "speed belong to a scenario"),
        ('path = "seq07"', "speed = 3.0", "a path or a scenario"),
        ("methods =", "seeds = [1, 1]\nmethods =", "different whole numbers from 0"),
        ("methods =", 'name = "a/b"\nmethods =', "name"),
        ("methods =", "parameters = 3\nmethods =", "not valid TOML"),
        (
            "[parameters]",
            FINDING.format('parameter = "input.skip"'),
            r"finding: 'So\.' speaks of 'input\.skip', which is not studied; did",
        ),
        ("[parameters]", FINDING.format('method = "ipc"'), "speaks of 'ipc', which is not studied; did you mean 'icp'"),
        ("[parameters]", FINDING.format('at = { "input.start" = 1 }'), r"speaks of 'input\.start'"),
    ],
)
def test_invalid_studies_are_errors_in_one_sentence(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    assert old in TEXT
    with pytest.raises(ConfigError, match=sentence) as caught:
        study(tmp_path, TEXT.replace(old, new))
    assert "\n" not in str(caught.value).split("not valid TOML")[0]


def test_parameters_are_a_table_with_something_in_it() -> None:
    tree = {"methods": ["icp"], "sequences": [{"path": "x"}]}
    for parameters in (3, {}):
        with pytest.raises(ConfigError, match="mine: parameters"):
            parse_study({**tree, "parameters": parameters}, "mine", "mine")


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"study .*none\.toml cannot be read"):
        read_study(tmp_path / "none.toml")


def test_a_sequence_may_say_which_of_its_scans_are_used(tmp_path: Path) -> None:
    first, second = study(tmp_path, TEXT.replace('"seq07"', '"seq07", start = 20, count = 30')).sequences
    assert (first.own, second.own) == ({}, {"start": 20, "count": 30})

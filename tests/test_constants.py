"""The numbers of a scan's path: all have a reason in the register, and a measured effect of half and double."""

from __future__ import annotations

import re
import sys

from pages import ROOT, page

sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))

import constants

METHODS = page("docs/algorithms.md").text
PATH = {(number.name, number.file) for number in constants.numbers()}


def test_every_number_of_a_scans_path_is_in_the_register() -> None:
    listed = re.findall(r"^\| `([\w.]+)` \| [^|]+ \| [^|]* \| `(\S+)` \| [^|]+ \|$", METHODS, re.MULTILINE)
    assert sorted(PATH - set(listed)) == []


def test_what_was_halved_and_doubled_is_on_a_scans_path() -> None:
    measured = METHODS.split("<!-- table constants -->")[1].split("<!-- end -->")[0]
    rows = set(re.findall(r"^\| `([\w.]+)` \| `(\S+)` \| [^|]+ \| [^|]+ \|$", measured, re.MULTILINE))
    assert rows
    assert sorted(rows - PATH) == []


def test_a_share_is_changed_by_what_it_lacks_and_a_cosine_by_its_angle() -> None:
    assert eval(constants.changed("FORGETTING_FACTOR", "registration/history.py", "0.8", 0.5)) == 0.9
    assert eval(constants.changed("MUCH_RATIO", "registration/policies.py", "1.1", 2.0)) == 1.2000000000000002
    source = "A, B = 1.5, 3\n\n\nclass C:\n    D = (2, 4)\n"
    for name, half in {"A": "A, B = (0.5 * (1.5)), 3", "B": "A, B = 1.5, 2", "C.D": "    D = (1, 2)"}.items():
        assert half in constants.edited(source, constants.Number("x/y.py", name, "points"), 0.5).splitlines()

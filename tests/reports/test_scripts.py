"""Scripts of the pages: modules that node tests by themselves, and that share one scope once they are in a page."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from lslam.reports.shell import CHARTS, MAP, RUN, bundle

HERE = Path(__file__).parent


@pytest.mark.parametrize("entry", [CHARTS, MAP, RUN])
def test_a_page_has_each_module_once_after_those_it_needs_and_each_name_once(entry: str) -> None:
    modules = bundle(entry)
    folder = Path(bundle.__code__.co_filename).parent / "scripts"
    names = list(modules)
    for name in names:
        wanted = re.findall(r'^import .*"\./([^"]+)"', (folder / name).read_text(encoding="utf-8"), re.MULTILINE)
        assert all(names.index(other) < names.index(name) for other in wanted)
    text = "\n".join(modules.values())
    assert not re.search(r"^(import|export)\b", text, re.MULTILINE)
    defined = Counter(re.findall(r"^(?:async )?(?:function|class|const|let) (\w+)", text, re.MULTILINE))
    assert [name for name, times in defined.items() if times > 1] == []


def test_the_modules_hold_by_node() -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node")
    tests = sorted(str(path) for path in (HERE / "scripts").glob("*.test.mjs"))
    done = subprocess.run([node, "--test", *tests], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout

"""What numba compiles with its work in vain left out is what it compiles with all of it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lslam.core.kernels import haste, jit
from lslam.core.kernels.voxel import first_points

# isort: split
import numba
from numba.core.compiler import Flags
from numba.core.cpu import CPUContext
from numba.core.postproc import PostProcessor
from numba.core.targetconfig import TargetConfig
from numba.core.types.functions import BaseFunction

PATCHES = ("compare_set_flags", "remember_signatures", "emit_entry_points", "find_lifetimes_late")
CODE = """
import sys
import numpy as np
from lslam.core.kernels import haste, voxel
for name in sys.argv[1:]:
    setattr(haste, name, lambda: None)
print(voxel.first_points(np.zeros((3, 3), np.float32), 1.0))
print(*voxel.first_points.inspect_asm().values())
"""


def instructions(cache: Path, *left: str) -> str:
    """Machine code of a kernel, without names; left : patches that are not made."""
    env = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    done = subprocess.run([sys.executable, "-c", CODE, *left], env=env, capture_output=True, text=True, check=True)
    return re.sub(r"_ZN\w+|\.const\.\S+|\.L\w+", "", done.stdout)


def test_machine_code_stays_the_same(tmp_path: Path) -> None:
    plain = instructions(tmp_path / "plain", *PATCHES)
    assert "ret" in plain
    assert instructions(tmp_path / "hastened") == plain


@pytest.mark.skipif(not haste.fits_release(), reason="a newer release of numba compiles as it is")
def test_this_numba_has_the_places_of_all_patches() -> None:
    jit.kernel(lambda x: x + 1.0)(1.0)
    haste.hasten()
    places = (TargetConfig.__eq__, BaseFunction.get_call_type, CPUContext.get_executable, PostProcessor.run)
    assert all(place.__module__ == haste.__name__ for place in places)


def test_what_is_compiled_into_others_has_no_machine_code_of_its_own() -> None:
    @jit.inline
    def half(value: float) -> float:
        return 0.5 * value

    @numba.njit  # is not kept: a kernel that is loaded compiles nothing
    def quarter(value: float) -> float:
        return half(half(value))

    compiled: Any = half
    haste.hasten()
    assert quarter(4.0) == 1.0
    libraries = [result.library for result in compiled.overloads.values()]
    assert [(library._finalized, library._compiled) for library in libraries] == [(True, False)]


def test_flags_are_equal_as_before() -> None:
    haste.compare_set_flags()
    plain, stated, other = Flags(), Flags(), Flags()
    stated.nrt, other.nrt = Flags().nrt, not Flags().nrt
    assert plain == stated
    assert hash(plain) == hash(stated)
    assert plain != other
    assert plain != TargetConfig()
    assert plain != 1


def test_a_newer_release_is_compiled_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(haste, "NEWEST_RELEASE", (0, 1))
    monkeypatch.setattr(haste, "compare_set_flags", lambda: pytest.fail("a patch was made"))
    haste.hasten()


def test_one_release_that_lacks_a_place_is_compiled_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    called = []

    def lacking() -> None:
        raise AttributeError("get_executable")

    monkeypatch.setattr(haste, "emit_entry_points", lacking)
    monkeypatch.setattr(haste, "find_lifetimes_late", lambda: called.append("next"))
    monkeypatch.setattr(haste, "compare_set_flags", lambda: None)
    monkeypatch.setattr(haste, "remember_signatures", lambda: None)
    haste.hasten()
    assert called == ["next"]
    assert first_points.__name__ == "first_points"

"""Libraries that are missing, or whose shared libraries are: one sentence with the way out."""

from __future__ import annotations

import sys
from importlib.abc import MetaPathFinder
from typing import Any

import pytest

from lslam.core.config import load_config
from lslam.core.errors import InputError
from lslam.core.extras import importing
from lslam.odometry import create_odometry


def made(method: str) -> Any:
    return create_odometry(load_config(None, [f"odometry.method={method}"], {}))


@pytest.mark.parametrize(
    ("method", "module", "way_out"),
    [
        ("kiss-icp", "kiss_icp.kiss_icp", "pip install kiss-icp"),
        ("small-gicp", "small_gicp", r"pip install .*\[small-gicp\]"),
        ("open3d-gicp", "open3d", r"pip install .*\[open3d\]"),
    ],
)
def test_the_error_about_a_missing_package_names_the_remedy(
    method: str, module: str, way_out: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=f"cannot be imported: .*{way_out}") as caught:
        made(method)
    assert caught.value.exit_code == 3
    assert "\n" not in str(caught.value)


class Bare(MetaPathFinder):
    """A machine without libusb, as seen by `import open3d`."""

    def find_spec(self, fullname: str, path: object, target: object = None) -> None:
        if fullname == "open3d":
            raise OSError("libusb-1.0.so.0: cannot open shared object file: No such file or directory")


def test_shared_libraries_open3d_misses_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [m for m in sys.modules if m == "open3d" or m.startswith("open3d.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Bare(), *sys.meta_path])
    with pytest.raises(InputError, match=r"libusb-1\.0\.so\.0.*pip install .*\[open3d\].*apt install libgl1"):
        made("open3d-gicp")


def test_other_errors_pass() -> None:
    with pytest.raises(ZeroDivisionError), importing("x", "y"):
        _ = 1 / 0

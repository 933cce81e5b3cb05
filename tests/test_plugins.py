"""Methods, readers and place descriptors of another package, installed as one is."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from lslam.backend.loops import create_descriptor
from lslam.core.config.backend import LoopsConfig
from lslam.core.config.config import Config
from lslam.core.errors import InputError, UsageError
from lslam.io.readers import open_sequence
from lslam.odometry import create_odometry, known_methods
from lslam.pipeline.check import check_config

MODULE = """
from lslam.odometry.base import Traits
from lslam.io.readers import scan_folder


class Method(Traits):
    needs_rings = True


def method(config):
    return Method()


def bare(config):
    return object()


def descriptor(config):
    return "a descriptor"


def locate(path):
    return (path, "") if (path / "clouds.txt").is_file() else None


def open_folder(path, overrides, rest):
    return scan_folder.open_folder(path / "deep", overrides, rest)
"""
ENTRIES = """
[lslam.methods]
theirs = theirs:method
bare = theirs:bare
broken = theirs:nothing

[lslam.descriptors]
theirs = theirs:descriptor
scan-context = theirs:descriptor

[lslam.readers]
theirs = theirs
"""


@pytest.fixture
def theirs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the package `theirs` is installed."""
    info = tmp_path / "site" / "theirs-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRIES)
    (info.parent / "theirs.py").write_text(MODULE)
    monkeypatch.syspath_prepend(info.parent)
    monkeypatch.delitem(sys.modules, "theirs", raising=False)
    return info


def config(**sections: dict[str, object]) -> Config:
    return Config.model_validate(sections)


def test_their_methods_and_descriptors_are_found(theirs: Path) -> None:
    wanted = config(odometry={"method": "theirs"}, loops={"descriptor": "theirs"})
    check_config(wanted)
    assert known_methods()["theirs"] == "from theirs:method"
    assert "theirs" not in sys.modules
    assert create_descriptor(wanted.loops) == "a descriptor"
    odometry = create_odometry(wanted)
    assert (odometry.needs_rings, odometry.ignores_prior) == (True, False)


def test_a_method_that_does_not_declare_what_it_needs_is_refused(theirs: Path) -> None:
    with pytest.raises(UsageError, match="needs_rings"):
        create_odometry(config(odometry={"method": "bare"}))


def test_they_do_not_take_the_place_of_ours(theirs: Path) -> None:
    assert type(create_descriptor(LoopsConfig())).__name__ == "PlaceIndex"
    assert "theirs" not in sys.modules


def test_a_foreign_reader_is_tried_after_ours(theirs: Path, tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    scans = sorted((Path(__file__).parents[1] / "sample_data/sequences/00/velodyne").glob("*.bin"))[:3]
    (drive / "deep").mkdir(parents=True)
    (drive / "clouds.txt").touch()
    for scan in scans:
        (drive / "deep" / scan.name).symlink_to(scan)
    assert len(open_sequence(drive)) == 3
    (drive / "clouds.txt").unlink()
    with pytest.raises(InputError, match="holds no scans"):
        open_sequence(drive)


@pytest.mark.parametrize("code", ["", "import nowhere\n"])
def test_a_broken_one_is_one_sentence_that_names_the_package(theirs: Path, code: str) -> None:
    if code:
        (theirs.parent / "theirs.py").write_text(code)
    with pytest.raises(
        InputError, match=r"^method 'broken' of the package theirs cannot be loaded from theirs:nothing: \w+: "
    ):
        create_odometry(config(odometry={"method": "broken"}))


@pytest.mark.parametrize("code", ["import nowhere\n", "def locate(path):\n    return path.nothing\n"])
def test_a_broken_reader_does_not_hide_what_ours_say(theirs: Path, tmp_path: Path, code: str) -> None:
    (theirs.parent / "theirs.py").write_text(code)
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.txt").touch()
    with pytest.raises(
        InputError, match=r"holds no scans: .*; reader 'theirs' .*(ModuleNotFoundError|AttributeError): "
    ):
        open_sequence(tmp_path / "empty")


def test_of_two_packages_with_one_name_the_order_of_installation_decides_nothing(theirs: Path) -> None:
    info = theirs.parent / "also-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: also\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[lslam.methods]\ntheirs = also:method\n")
    assert known_methods()["theirs"] == "from also:method"


def test_an_unknown_name_is_refused_before_a_run() -> None:
    with pytest.raises(UsageError, match="no place descriptor 'scan-contxt'; did you mean 'scan-context'"):
        check_config(config(loops={"descriptor": "scan-contxt"}))


def test_help_looks_for_no_other_package() -> None:
    code = "import sys; from lslam.cli.main import main\nsys.argv = ['lslam', '--help']\ntry: main()\nexcept SystemExit: pass\n"
    code += "assert 'lslam.core.extras' not in sys.modules and 'importlib.metadata' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)

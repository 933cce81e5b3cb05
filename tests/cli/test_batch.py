"""`lslam batch`: jobs of a file and lines of `lslam run`, with one table and an exit code for scripts."""

from __future__ import annotations

import io
import re
import shlex
import subprocess
import sys
from pathlib import Path
from unittest import mock

import pytest
from calling import COMMAND, Done, assert_one_sentence, environment, lslam, sample_copy

from lslam.cli.batch import _line, command
from lslam.core.config.study import BatchConfig, read_batch
from lslam.core.errors import ConfigError, LslamError, OutputExistsError
from lslam.studies.batch_runs import expand_batch, run_words
from lslam.studies.options import OutputOptions
from lslam.studies.results_csv import read_study_csv

pytestmark = pytest.mark.usefixtures("forked_runs")

JOBS = """
[config]
map.write = false
report.html = false

[[jobs]]
sequences = ["SAMPLE"]
methods = ["icp", "kiss-icp"]

[[jobs]]
sequences = ["SAMPLE"]
methods = ["icp"]
config.input.start = 2
"""


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sample_copy(tmp_path_factory.mktemp("sample"), 8)


def piped(text: str, *words: object) -> Done:
    return subprocess.run(
        [*COMMAND, "batch", "-", *map(str, words)], input=text, capture_output=True, text=True, timeout=180, check=False,
        env=environment(),
    )  # fmt: skip


def fed(text: str, *words: object) -> Done:
    """Likewise, in this process."""
    with mock.patch.object(sys, "stdin", io.StringIO(text)):
        return lslam("batch", "-", *words)


def refusal(words: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> LslamError:
    """What the command raises in `folder`, where it leaves nothing."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr("lslam.cli.batch.setup_logging", lambda *_: None)
    with pytest.raises(LslamError) as caught:
        command.main(words, standalone_mode=False)
    assert not list(folder.iterdir())
    return caught.value


def test_every_job_of_a_file_is_a_run_and_a_row_and_is_kept(sample: Path, tmp_path: Path) -> None:
    file, out = tmp_path / "jobs.toml", tmp_path / "out"
    file.write_text(JOBS.replace("SAMPLE", str(sample)))
    plan = lslam("batch", file, "--dry-run", "--out", out)
    assert [line.split()[1] for line in plan.stdout.splitlines()] == ["icp", "kiss-icp", "icp-2"]
    assert not out.exists()
    done = lslam("batch", file, "--out", out, "--jobs", "1")
    assert done.returncode == 0, done.stderr
    assert [line.split()[1] for line in done.stdout.splitlines()] == ["method", "icp", "kiss-icp", "icp"]
    rows = read_study_csv(out / "results.csv")
    assert [(row.method, row.scans) for row in rows] == [("icp", 8), ("kiss-icp", 8), ("icp", 6)]
    assert all((out / row.folder / "trajectory.tum").is_file() for row in rows)
    again = lslam("batch", file, "--out", out, "--resume")
    assert again.returncode == 0, again.stderr
    assert again.stdout == done.stdout
    assert [repr(row) for row in read_study_csv(out / "results.csv")] == [repr(row) for row in rows]


def test_scans_of_single_sequences_are_used_as_they_say(sample: Path, tmp_path: Path) -> None:
    file = tmp_path / "jobs.toml"
    two = '["SAMPLE", { path = "SAMPLE", start = 5, count = 2 }]'
    file.write_text(JOBS.replace('["SAMPLE"]', two, 1).replace("SAMPLE", str(sample)))
    jobs = expand_batch(read_batch(file), OutputOptions(tmp_path / "out"), ["input.count=3"]).jobs
    named = [(job.sequence, job.method, job.config.input.start, job.config.input.count) for job in jobs[:4]]
    assert named == [
        ("block-0", "icp", 0, 3), ("block-0", "kiss-icp", 0, 3), ("block-0-2", "icp", 5, 3), ("block-0-2", "kiss-icp", 5, 3),
    ]  # fmt: skip
    assert expand_batch(read_batch(file), OutputOptions(tmp_path / "out")).jobs[2].config.input.count == 2


@pytest.mark.parametrize(
    "held", ["[[jobs]]\nsequences = ['street']\nmethods = ['icp']\n", "lines = ['street --imu']\n"]
)
def test_another_list_does_not_go_on_in_the_folder_of_this_one(
    held: str, sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor is it listed there by --dry-run; a list that has one run in common with what is there is the same, grown."""
    monkeypatch.setattr("lslam.cli.batch.setup_logging", lambda *_: None)
    file, mark = tmp_path / "jobs.toml", tmp_path / "out" / "batch.toml"
    file.write_text(JOBS.replace("SAMPLE", str(sample)))
    mark.parent.mkdir()
    mark.write_text(held)
    words = ["--out", str(mark.parent), "--resume", "--dry-run"]
    theirs = held.split("'")[1] + (" icp" if "jobs" in held else "")
    for source, ours in (([str(file)], f"{sample} icp"), (["-"], f"{sample} --count 2")):
        monkeypatch.setattr(sys, "stdin", io.StringIO(f"lslam run {sample} --count 2"))
        said = (
            f"holds batch {theirs!r} and --resume would go on in it with batch {ours!r}: name another folder with --out"
        )
        with pytest.raises(OutputExistsError, match=re.escape(said)):
            command.main([*source, *words], standalone_mode=False)
        assert mark.read_text() == held
    for grown, source in ((f"lines = ['{sample} --count 2', 'street']", "-"), (file.read_text(), str(file))):
        mark.write_text(grown)
        monkeypatch.setattr(sys, "stdin", io.StringIO(f"{sample}\nlslam run {sample} --count 2"))
        command.main([source, *words], standalone_mode=False)


@pytest.mark.parametrize(
    ("held", "said"),
    [
        ("[[jobs]]\nsequence = ['street']\n", r"batch\.toml: jobs: unknown key 'sequence'; did you mean 'sequences'"),
        ("lines = []\n", r"batch\.toml: unknown key 'lines'"),
        ("lines = 3\n", r"batch\.toml: unknown key 'lines'"),
    ],
)
def test_a_folder_whose_list_is_damaged_is_named(held: str, said: str, sample: Path, tmp_path: Path) -> None:
    (tmp_path / "batch.toml").write_text(held)
    batch = BatchConfig.model_validate({"jobs": [{"sequences": [str(sample)]}]})
    with pytest.raises(ConfigError, match=said):
        expand_batch(batch, OutputOptions(tmp_path, resume=True))


def test_lines_are_parsed_as_by_lslam_run_and_a_failure_is_exit_1(sample: Path, tmp_path: Path) -> None:
    own = tmp_path / "own"
    text = (
        f"# tonight\nlslam run {sample} --count 5 --set map.write=false\n"
        f"{sample} --method kiss-icp --count 4 --out {own}\nlslam run {sample} --start 8\n"
    )
    done = fed(text, "--out", tmp_path / "out", "--jobs", "1")
    assert done.returncode == 1, done.stderr
    assert "1 of 3 runs failed" in done.stderr
    assert "--start 8 is beyond the last scan" in done.stderr
    rows = read_study_csv(tmp_path / "out" / "results.csv")
    assert [(row.method, row.status, row.scans) for row in rows] == [
        ("icp", "done", 5), ("kiss-icp", "done", 4), ("icp", "failed", 0),
    ]  # fmt: skip
    assert (own / "map.ply").is_file()
    assert not list((tmp_path / "out" / rows[0].folder).glob("map.*"))
    assert rows[2].reason in done.stdout
    twice = piped(text, "--out", tmp_path / "other")
    assert twice.returncode == 2, "what lies in a folder of one's own is not lost"
    assert f"the folder {own} of" in twice.stderr


def test_a_path_with_a_space_is_quoted_in_the_recorded_command(tmp_path: Path) -> None:
    path = sample_copy(tmp_path / "my recordings", 2)
    (line,) = [
        _line(*found, {"settings": (), "data_root": None}) for found in run_words(f"lslam run '{path}' --count 1")
    ]
    assert shlex.split(line.words) == [str(path), "--count", "1"]


def test_presets_whose_names_differ_in_a_space_are_runs_of_their_own(sample: Path, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("my voxel.toml", "my_voxel.toml")]
    for file in files:
        file.write_text("")
    batch = BatchConfig.model_validate({"jobs": [{"sequences": [str(sample)], "methods": [str(f)]} for f in files]})
    jobs = expand_batch(batch, OutputOptions(tmp_path / "out")).jobs
    assert [job.method for job in jobs] == ["my_voxel", "my_voxel-2"]
    assert jobs[0].folder != jobs[1].folder


@pytest.mark.parametrize(
    ("text", "code", "sentence"),
    [
        ("", 2, "there is no line on stdin"),
        ("lslam run SAMPLE --methd icp", 2, "line 1: No such option"),
        ("\nlslam run SAMPLE --method ipc", 2, "line 2: no method 'ipc'; did you mean 'icp'"),
        ("lslam run nowhere", 3, "line 1: no sequence 'nowhere'"),
        ("lslam run SAMPLE --resume --out x", 2, "line 1: --resume is no option of a line"),
        ("lslam run SAMPLE --json", 2, "line 1: --json is no option of a line"),
        ("lslam run SAMPLE --help", 2, "line 1: --help is no run"),
        ("lslam run SAMPLE --out x\nSAMPLE --count 3 --out ./x", 2, "run 1 and run 2 of the batch are both"),
        ("lslam run 'SAMPLE", 2, "line 1: No closing quotation"),
    ],
)
def test_a_wrong_line_is_named_before_anything_runs(
    text: str, code: int, sentence: str, sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(text.replace("SAMPLE", str(sample))))
    said = refusal(["-", "--out", "out"], tmp_path, monkeypatch)
    assert said.exit_code == code
    assert sentence in str(said)


@pytest.mark.parametrize(
    ("old", "new", "code", "sentence"),
    [
        ("[[jobs]]", "[[job]]", 2, "unknown key 'job'; did you mean 'jobs'"),
        ("methods =", "method =", 2, "jobs: unknown key 'method'; did you mean 'methods'"),
        ("map.write", "map.wrote", 2, "unknown key map.wrote"),
        ('["SAMPLE"]', "[]", 2, "jobs"),
        ('["SAMPLE"]', '"SAMPLE"', 2, "jobs"),
        (
            '["SAMPLE"]',
            '[{ path = "SAMPLE", cuont = 3 }]',
            2,
            "jobs: sequences: unknown key 'cuont'; did you mean 'count'",
        ),
        (
            '["SAMPLE"]',
            '[{ path = "SAMPLE", count = -3 }]',
            2,
            "jobs.sequences.count = -3: Input should be greater than",
        ),
        (
            '["SAMPLE"]',
            '[{ path = "SAMPLE", start = 8 }]',
            2,
            "sequence block-0 has 8 scans: start = 8 goes beyond its end",
        ),
        ("methods =", "seeds = [0, 0]\nmethods =", 2, "different whole numbers"),
    ],
)
def test_what_is_no_batch_is_said_in_one_sentence(
    old: str, new: str, code: int, sentence: str, sample: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = sample.parent / "jobs.toml"
    file.write_text(JOBS.replace(old, new).replace("SAMPLE", str(sample)))
    said = refusal([str(file), "--out", "out"], tmp_path, monkeypatch)
    assert said.exit_code == code
    assert sentence in str(said)


def test_strict_counts_a_degraded_run_as_a_failed_gate(sample: Path, tmp_path: Path) -> None:
    """A recording with a torn scan in it."""
    torn = sample_copy(tmp_path, 6)
    (torn / "velodyne" / "000003.bin").write_bytes(b"torn")
    done = fed(f"lslam run {torn} --set map.write=false", "--out", tmp_path / "out", "--strict", "-q")
    assert done.returncode == 4, done.stderr
    assert_one_sentence(done.stderr)
    assert "1 of 1 runs are degraded" in done.stderr

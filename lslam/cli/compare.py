"""`lslam compare`: methods against each other on the same scans."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from lslam.cli import options
from lslam.cli.console import log, setup_logging, show, show_json

if TYPE_CHECKING:
    from lslam.core.types.comparison import Comparison
    from lslam.core.types.trajectory import Trajectory
    from lslam.studies.compare import Plan
    from lslam.studies.subjects import Subject

# Options that a comparison that ships with lslam does not have.
_NOT_OF_READY = ("preset", "config_file", "gt", "crop", "imu")


@click.command(
    epilog="\b\nExamples: lslam compare sample_data --methods icp,kiss-icp\n"
    "          lslam compare street block --methods icp,kiss-icp --seeds 0,1,2 --count 100 --count block=50\n"
    "          lslam compare walk open --methods icp,loam --imu both --seeds 0,1,2\n"
    "          lslam compare seq07 --data-root ~/kitti --methods icp,kiss-icp --count 300 --out runs/two --resume\n"
    "          lslam compare girolimetto --quick"
)
@click.argument("sequences", metavar="SEQUENCE...|NAME", nargs=-1)
@options.flag("--list", "show_list", "List the comparisons that ship with lslam.")
@options.flag("--quick", "Of a comparison of --list: few drives and seeds, in minutes.")
@options.option(
    "--methods", "A,B,...", "Names of `lslam methods`, presets or configuration files; the first is the reference."
)
@options.preset
@options.option(
    "--seeds", "N,N,...", "Seeds of simulations and of random methods, also 100-104 [default: 0, or those of NAME]."
)
@click.option(
    "--imu",
    type=click.Choice(["off", "on", "both"]),
    help="Without or with the IMU, or each method both ways, the second named icp+imu.",
)
@options.path("--gt", "FILE", "Ground truth of the one sequence.")
@options.path("--out", "DIR", "Folder of the comparison [default: runs/compare-TIME].")
@options.resume_or_overwrite
@options.integer("--jobs", "N", "Runs at once; with several, times mean little.", default=1, show_default=True)
@options.scan_ranges
@options.option("--crop", "X,Y,SIZE", "Map crop shown on the page, m; chosen by itself otherwise.")
@options.flag("--strict", "Exit 4 when any run failed.")
@click.option(
    "--table", type=click.Choice(["text", "md", "csv", "tex"]), default="text", help="Form; csv: a row per run."
)
@options.data_root
@options.configuration
@options.as_json
@options.verbosity
def command(sequences: tuple[str, ...], **given: Any) -> None:
    """Run methods on the same sequences and write one table and one page about all of them.

    SEQUENCE is what `lslam run` takes, or a scenario of `lslam simulate --list`, which is simulated once per seed. NAME is one of
    --list: what a thesis compared, beside what it prints, with a verdict; the same command again goes on. With --data-root
    del-tufo runs on the thesis' own recording.
    """
    if given["show_list"]:
        _print_list(given["as_json"])
        return
    setup_logging(given["verbose"], given["quiet"])
    if not sequences:
        raise click.UsageError("Missing argument 'SEQUENCE...'.")
    is_ready = len(sequences) == 1 and given["methods"] is None and _is_ready(sequences[0])
    if given["quick"] and not is_ready:
        raise click.UsageError("--quick is of the comparisons of --list")
    if given["methods"] is None and not is_ready:
        raise click.UsageError("Missing option '--methods'.")
    plan = _ready_plan(sequences[0], given) if is_ready else _plan(sequences, given)
    from lslam.cli.console import bars
    from lslam.core.errors import GateError, RunFailedError
    from lslam.studies.compare import run_comparison

    with ExitStack() as stack:
        comparison = run_comparison(plan, bars(stack))
    _print(comparison, given["table"], given["as_json"])
    log.info("the page: %s", plan.output.out / "compare.html")
    failed = comparison.failed
    reasons = "; ".join(f"{run.sequence} {run.method} seed {run.seed}: {run.reason}" for run in failed[:3])
    if len(failed) == len(comparison.runs):
        raise RunFailedError(f"{'the run' if len(failed) == 1 else f'all {len(failed)} runs'} failed: {reasons}")
    if failed and given["strict"]:
        raise GateError(f"--strict: {len(failed)} of {len(comparison.runs)} runs failed: {reasons}")


def _plan(sequences: tuple[str, ...], given: dict[str, Any]) -> Plan:
    """The comparison that the options describe. They are checked as far as possible before heavy imports."""
    from lslam.studies.options import COMPARISON, check_numbers, require_free

    seeds, crop = options.seeds_of(given["seeds"] or "0"), _crop(given["crop"])
    check_numbers(seeds, given["jobs"], crop)
    output = options.output_of(given, "compare")
    require_free(output, COMPARISON)
    from lslam.studies.variants import find_variants

    common, ranges = options.ranges_of(given, sequences)
    settings = [*options.settings_of({"odometry.preset": options.quote(given["preset"])}, given["settings"]), *common]
    methods = [name.strip() for name in given["methods"].split(",") if name.strip()]
    variants = tuple(find_variants(methods, given["config_file"], settings, given["imu"]))
    from lslam.studies.subjects import find_subjects

    subjects = tuple(find_subjects(sequences, given["data_root"], ranges))
    from lslam.studies.compare import Plan

    return Plan(subjects, variants, seeds, output, given["jobs"], _truth(given["gt"], subjects), crop)


def _is_ready(word: str) -> bool:
    """Whether a word names a comparison that ships with lslam."""
    from lslam.studies.ready_comparison import comparison_names

    return word in comparison_names()


def _print_list(as_json: bool) -> None:
    """Print the ready comparisons with their summaries."""
    from lslam.studies.ready_comparison import comparison_names, find_comparison

    summaries = {name: find_comparison(name).summary for name in comparison_names()}
    if as_json:
        show_json({"comparisons": summaries})
    else:
        show("".join(f"{name:<14}  {summary}\n" for name, summary in summaries.items()))


def _ready_plan(name: str, given: dict[str, Any]) -> Plan:
    """Comparison that ships with lslam, in a folder of its name. Raises UsageError for an option that it does not use."""
    from lslam.studies.compare import Plan
    from lslam.studies.options import COMPARISON, OutputOptions, check_numbers, require_free
    from lslam.studies.ready_comparison import find_comparison
    from lslam.studies.subjects import find_subjects

    typed = options.typed_options()
    for option in filter(None, map(typed.get, _NOT_OF_READY)):
        raise click.UsageError(
            f"{option} is not of {name}, which simulates its drives and fixes its systems: leave it out, or compare "
            "recordings by --methods"
        )
    ready, is_quick = find_comparison(name), given["quick"]
    data_root = given["data_root"] if "data_root" in typed else None
    if data_root is not None:
        ready = ready.on_recording(data_root)
    seeds = options.seeds_of(given["seeds"]) if given["seeds"] else ready.quick.seeds if is_quick else ready.seeds
    check_numbers(seeds, given["jobs"], None)
    marks = [name, *(["recorded"] if data_root else []), *(["quick"] if is_quick else [])]
    out, overwrite = given["out"] or Path("runs") / "-".join(marks), given["overwrite"]
    output = OutputOptions(out, overwrite, not overwrite, None, data_root, options.command_line())
    require_free(output, COMPARISON)
    common, ranges = options.ranges_of(given, ())
    subjects = tuple(find_subjects(ready.quick.sequences if is_quick else ready.sequences, data_root, ranges))
    variants = tuple(ready.variants([*given["settings"], *common]))
    return Plan(subjects, variants, seeds, output, given["jobs"], ready=ready)


def _crop(text: str | None) -> tuple[float, float, float] | None:
    """Values of --crop: x, y and size, m; None without it."""
    if text is None:
        return None
    x, y, size = options.numbers("--crop", text, (3,), "x, y and size in metres, for example 12,-40,20")
    return x, y, size


def _truth(path: Path | None, subjects: Sequence[Subject]) -> Trajectory | None:
    """Ground truth from `path` for the only recording; None without a path. Raises UsageError for several, or a scenario."""
    from lslam.cli.one_run import read_truth
    from lslam.core.errors import UsageError
    from lslam.io.readers import open_sequence
    from lslam.studies.options import ONE_TRUTH

    if path is None:
        return None
    if len(subjects) > 1 or subjects[0].path is None:
        raise UsageError(ONE_TRUTH)
    return read_truth(path, open_sequence(subjects[0].path))


def _print(comparison: Comparison, style: str, as_json: bool) -> None:
    """Print the comparison in `style` or as JSON, on a terminal in colours."""
    from lslam.reports import compare_table

    if as_json:
        show_json(compare_table.to_document(comparison))
    elif style == "text" and sys.stdout.isatty():
        _print_rich(comparison)
    else:
        show(compare_table.render(comparison, style) + "\n")


def _print_rich(comparison: Comparison) -> None:
    """Tables as wide as the terminal, the best of each sequence in bold."""
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from lslam.reports.compare_table import recipes, tables

    console = Console()
    for table in tables(comparison, console.width):
        grid = Table(
            title=table.title or None, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False
        )
        for k, name in enumerate(table.header_lines):
            side: Literal["left", "right"] = "left" if k < table.names else "right"
            grid.add_column(name, justify=side, overflow="fold", no_wrap=k == 1, vertical="bottom")
        room = max((len(row[0]) for row in table.rows), default=0) - max(table.width - console.width, 0)
        for i, row in enumerate(table.rows):
            if i and row[0] != table.rows[i - 1][0] and table.header[0] == "sequence":
                grid.add_section()
            cells = (_shorten(row[0], max(room, 9)), *row[1:])
            grid.add_row(*(Text(cell, "bold" if (i, k) in table.best else "") for k, cell in enumerate(cells)))
        console.print(grid)
    for line in (*comparison.notes, *recipes(comparison)):
        console.print(Text(f"  {line}", "dim"))


def _shorten(name: str, most: int) -> str:
    """A name with its middle left out: recordings of one day differ at the end."""
    return name if len(name) <= most else f"{name[: most // 2 - 2]}…{name[-(most // 2 + 1) :]}"

"""All runs of a sweep or a batch: keeps finished ones, simulates, makes the others, and writes each row as a run ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from lslam.core.config.config import read_toml
from lslam.core.errors import InterruptedRunError, LslamError, OutputExistsError
from lslam.core.types.study import StudyRow
from lslam.core.untrusted import parse_toml
from lslam.io.formats.atomic import write_text
from lslam.studies.grid import Job
from lslam.studies.jobs import Engine, finished
from lslam.studies.output import OutputOptions, lock_output, release_output
from lslam.studies.results import Results
from lslam.studies.runner import StudyProgress
from lslam.studies.variants import Variant


@dataclass(frozen=True)
class ExpandedStudy:
    """All runs of a study, and the meaning of its variants, by name.

    name : of the study or batch, which `text` in the file `mark` describes; what : the word for it
    metric : the error it judges by
    """

    name: str
    what: str
    mark: str
    text: str
    jobs: list[Job] = field(default_factory=list)
    variants: dict[str, Variant] = field(default_factory=dict)
    metric: str = "ate_se3"


def check_same(
    output: OutputOptions, mark: str, what: str, text: str, names_of: Callable[[dict[str, Any]], Sequence[str]]
) -> None:
    """Check that the output folder is of this study or batch, when it is to be resumed.

    A changed study may continue in its folder, since runs are reused by digest.

    text : for the file `mark`; names_of : names of the content of such a text, of which both must share one

    Raises OutputExistsError for a folder of another study; ConfigError for a damaged `mark`.
    """
    if not output.resume or not (output.out / mark).is_file():
        return
    theirs, ours = names_of(read_toml(output.out / mark, what)), names_of(parse_toml(text))
    if not set(theirs) & set(ours):
        raise OutputExistsError(
            f"output folder {output.out} holds {what} {theirs[0]!r} and --resume would go on in it with {what} {ours[0]!r}: "
            "name another folder with --out"
        )


def left_to_do(output: OutputOptions, jobs: Sequence[Job]) -> list[Job]:
    """Runs that are not finished, or all unless `output.resume`."""
    kept = finished(jobs) if output.resume else set()
    return [replace(job, goes_on=output.resume) for job in jobs if job.folder not in kept]


def make_runs(
    expanded: ExpandedStudy,
    output: OutputOptions,
    engine: Engine,
    progress: StudyProgress | None = None,
    on_rows: Callable[[Sequence[StudyRow]], None] = lambda rows: None,
) -> list[StudyRow]:
    """Make every run that is not finished yet; results.csv and results.parquet in `output.out` grow as they end.

    on_rows : called with all rows so far

    Raises
    ------
    LslamError : as `lock_output` and the engine; OutputExistsError : a run's own folder holds something else
    InterruptedRunError : Ctrl-C or SIGTERM; finished runs are kept, and `resume` goes on
    """
    progress = progress or StudyProgress()
    jobs = expanded.jobs
    results = Results(expanded.name, output.out, jobs, expanded.variants, expanded.metric)
    lock_output(output.out, expanded.mark, expanded.what, output.overwrite, output.resume)
    try:
        if not output.overwrite:
            results.check()
        write_text(output.out / expanded.mark, expanded.text)
        left = left_to_do(output, jobs)
        begun = {job.folder for job in left}
        _check_folders(left, output)
        results.add([job for job in jobs if job.folder not in begun])
        engine.prepare(left, progress)

        def on_done(job: Job) -> None:
            results.add([job])
            on_rows(results.rows)

        on_rows(results.rows)
        try:
            engine.run(left, progress, on_done)
        finally:
            results.flush()
    except KeyboardInterrupt:
        raise InterruptedRunError(
            f"interrupted; {len(finished(jobs))} of {len(jobs)} runs are finished in {output.out}: the same command with "
            "--resume goes on"
        ) from None
    except LslamError:
        release_output(output.out, expanded.mark)
        raise
    return results.rows


def _check_folders(jobs: Sequence[Job], output: OutputOptions) -> None:
    """Raise OutputExistsError if a run's own folder exists and is not of this study."""
    for job in jobs:
        may_replace = output.overwrite or (output.resume and job.state_file.is_file())
        if output.out not in job.folder.parents and job.folder.exists() and not may_replace:
            raise OutputExistsError(
                f"the folder {job.folder} of {job.name} exists: name another, or --overwrite replaces it"
            )

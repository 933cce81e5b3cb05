"""One job in a process of its own: everything it can end with becomes a state."""

from __future__ import annotations

import contextlib
import logging
import time

from lslam.errors import GateError, InterruptedRunError, LslamError, RunFailedError
from lslam.studies.grid import Job
from lslam.studies.states import State, write_state


def execute(job: Job, at_once: int, load: float) -> None:
    """Run the job into its folder, replacing what is there, and leave its state behind.

    at_once, load : how many runs share the machine, and its load before them, for the reader of the times
    Raises nothing of the run's; KeyboardInterrupt after the state is written, so that the process ends.
    """
    # What the run says is in its log.txt; the screen belongs to the study.
    log = logging.getLogger("lslam")
    log.addHandler(logging.NullHandler())
    log.propagate = False
    job.state_file.unlink(missing_ok=True)
    began = time.monotonic()
    status, reason = "failed", ""
    try:
        status, reason = _run(job)
    except (KeyboardInterrupt, InterruptedRunError):
        status, reason = "interrupted", "interrupted before its end"
        raise KeyboardInterrupt from None
    except RunFailedError as error:
        status, reason = "diverged", str(error).removeprefix("the run diverged: ")
    except LslamError as error:
        reason = str(error)
    except MemoryError:
        reason = "out of memory: use fewer points (preprocess.range_max) or larger voxels (map.voxel)"
    except Exception as error:
        reason = f"lslam made a mistake ({type(error).__name__}: {error})"
    finally:
        seconds = round(time.monotonic() - began, 3)
        write_state(job.state_file, State(job.digest, status, reason, at_once, load, seconds))


def _run(job: Job) -> tuple[str, str]:
    """Status and reason of a run that came to its end."""
    from lslam.pipeline.run import run
    from lslam.pipeline.watch import RunOutcome, Watch
    from lslam.readers import open_sequence
    from lslam.readers.raw_drive import with_imu

    ended: list[RunOutcome] = []
    sequence = open_sequence(job.path, vertical_correction_deg=job.config.input.vertical_correction_deg)
    if job.config.imu.use:
        sequence = with_imu(sequence, job.data_root)
    watch = Watch(on_end=ended.append)
    # A gate of the run's own (input.strict): it is done all the same.
    with contextlib.suppress(GateError):
        run(
            sequence, job.config, out=job.folder, ground_truth=job.truth, overwrite=True, command=job.command,
            watch=watch,
        )  # fmt: skip
    manifest = ended[-1].record.manifest
    return str(manifest["status"]), "; ".join(manifest["problems"])

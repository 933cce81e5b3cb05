"""What else of a run folder tells of the map: evaluation.json, report.html and manifest.json, when the map is built anew."""

from __future__ import annotations

import logging
from pathlib import Path

from lslam.formats.atomic import write_text
from lslam.pipeline.json_files import read_json, write_json
from lslam.pipeline.run_folder import MANIFEST
from lslam.reports.evaluation_json import run_document
from lslam.reports.html import with_new_map
from lslam.types.run_record import RunRecord

log = logging.getLogger("lslam")

EVALUATION, REPORT = "evaluation.json", "report.html"
_KEPT = "%s keeps the figures of the map before: it %s"


def write_renewed(target: Path, folder: Path, record: RunRecord) -> None:
    """Write into `target` what lies in the run folder `folder`, all of it as it is but what it says of the map.

    record : of the new map, what is drawn with it, and the manifest as it shall be. A report that the run did not write is
        not made; what cannot be read is left alone, which is said. Raises OutputError.
    """
    known, new = read_json(folder / EVALUATION), run_document(record, None) or {}
    if known or not (folder / EVALUATION).exists():
        write_json(target / EVALUATION, {**new, **known, "map": new["map"]})
    else:
        log.warning(_KEPT, folder / EVALUATION, "cannot be read")
    try:
        page = with_new_map((folder / REPORT).read_text(encoding="utf-8"), record)
        write_text(target / REPORT, page)
    except FileNotFoundError:
        pass
    except OSError as error:
        log.warning(_KEPT, folder / REPORT, f"cannot be read ({error})")
    except ValueError:
        log.warning(_KEPT, folder / REPORT, "was not written by this version of lslam: run the sequence again")
    write_json(target / MANIFEST, record.manifest)

"""Where a run may be lost: what its witness says, in the words of the manifest and beside each scan."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from lslam.pipeline.manifest import Manifest
from lslam.registration.verdict import Doubt, doubts
from lslam.registration.witness import Witness
from lslam.types.scan_result import ScanResult

log = logging.getLogger("lslam")

# Sentences of one run; the scans beyond are marked all the same.
MOST_SAID = 6


def mark_lost(results: list[ScanResult], witness: Witness, manifest: Manifest) -> list[ScanResult]:
    """The results, those in doubt marked so; the manifest has a problem for each stretch of them."""
    positions = np.stack([r.T_world_lidar[:3, 3] for r in results])
    found = doubts(witness.testimonies, positions, np.array([r.stamp_ns for r in results]))
    said = [_sentence(results, doubt) for doubt in found]
    if len(said) > MOST_SAID:
        said = [
            *said[:MOST_SAID],
            f"and {len(said) - MOST_SAID} more stretches of scans that may be lost: see scans.csv",
        ]
    for sentence in said:
        log.warning("%s", sentence)
    manifest.problems += said
    manifest.witness = {
        "comparisons": len(witness.testimonies),
        "telling": sum(t.is_telling for t in witness.testimonies),
        "doubts": len(found),
    }
    in_doubt = {k for doubt in found for k in range(doubt.first, doubt.last + 1)}
    return [replace(r, is_lost=True) if k in in_doubt else r for k, r in enumerate(results)]


def _sentence(results: list[ScanResult], doubt: Doubt) -> str:
    first, last = results[doubt.first].index, results[doubt.last].index
    scans = f"scan {first}" if first == last else f"scans {first} to {last}"
    return f"{scans} may be lost: {doubt.why}"

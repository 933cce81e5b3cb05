"""Everything of lslam that reads files, in the order of the table."""

from __future__ import annotations

from fuzz import parts, points, sequences, texts

PARSERS = [*sequences.PARSERS, *parts.PARSERS, *points.PARSERS, *texts.PARSERS]

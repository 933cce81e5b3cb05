"""Everything of lslam that reads files, in the order of the table."""

from __future__ import annotations

from fuzz import points, sequences, texts

PARSERS = [*sequences.PARSERS, *points.PARSERS, *texts.PARSERS]

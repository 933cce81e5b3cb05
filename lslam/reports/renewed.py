"""report.html with another map in it: the parts that tell of the map stand between marks, and only they are written anew."""

from __future__ import annotations

from lslam.reports.html import MAP_PARTS, map_context, template
from lslam.types.run_record import RunRecord


def with_new_map(page: str, record: RunRecord) -> str:
    """The page of a run with the figures, the picture and the manifest of `record` in place of those of the map before.

    Raises ValueError when the page has not the marks of the parts.
    """
    for name, file in MAP_PARTS.items():
        begin, end = (f"<!-- {word} {name} -->\n" for word in ("begin", "end"))
        before, found, rest = page.partition(begin)
        _, found_too, after = rest.partition(end)
        if not (found and found_too):
            raise ValueError(f"the page has no part {name}")
        page = before + begin + template(file).render(map_context(record)) + end + after
    return page

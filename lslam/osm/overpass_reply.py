"""A reply of an Overpass server as it came: its text, a fifth of what it takes as a tree, read element by element."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator, Mapping
from typing import IO, Any

from lslam.formats.osm_data import OsmData
from lslam.formats.osm_files import ELEMENTS, add_elements, check_reply
from lslam.untrusted import JsonItems, parse_json


class OverpassReply(Mapping[str, Any]):
    """The reply as the mapping its text says, parsed when it is asked for and then forgotten; nothing in it is checked.

    text : JSON; UTF-8, UTF-16 or UTF-32
    """

    def __init__(self, text: bytes) -> None:
        encoding = json.detect_encoding(text[:4])
        self.text = text if encoding == "utf-8" else text.decode(encoding, "surrogatepass").encode("utf-8", "replace")

    @classmethod
    def of(cls, tree: Mapping[str, Any]) -> OverpassReply:
        """The reply of a parsed one, or itself."""
        return tree if isinstance(tree, cls) else cls(json.dumps(tree, ensure_ascii=False).encode("utf-8", "replace"))

    def items_of(self) -> JsonItems:
        """Its elements, one at a time. Going through them raises ValueError as `JsonItems`."""
        return JsonItems(io.BytesIO(self.text), ELEMENTS)

    def write(self, stream: IO[bytes], facts: Mapping[str, Any]) -> None:
        """The text of a reply that was checked, with `facts` before what it says."""
        stream.write(json.dumps(facts).encode().removesuffix(b"}") + b", ")
        stream.write(memoryview(self.text)[self.text.index(b"{") + 1 :])

    def facts(self) -> dict[str, Any]:
        """All that is not elements."""
        found = self.items_of()
        for _ in found:
            pass
        return found.rest

    def __getitem__(self, key: str) -> Any:
        return parse_json(self.text)[key]

    def __iter__(self) -> Iterator[str]:
        return iter(parse_json(self.text))

    def __len__(self) -> int:
        return len(parse_json(self.text))

    def __repr__(self) -> str:
        return f"OverpassReply({self.text[:60]!r}..., {len(self.text)} bytes)"


def from_overpass(reply: Any) -> OsmData:
    """An Overpass reply (`[out:json]`), an `OverpassReply` or parsed already. Raises as `merged`."""
    return merged([reply])


def merged(replies: Iterable[Any]) -> OsmData:
    """One extract of many replies; what several hold is in it once.

    Raises ValueError saying what is wrong with one; GaveUpError, which is such, when a server did.
    """
    data = OsmData()
    for reply in replies:
        items = OverpassReply.of(reply).items_of()
        add_elements(data, items)
        check_reply(items)
    data.number_drawn()
    return data

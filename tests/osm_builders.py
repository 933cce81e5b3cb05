"""Small hand-made extracts at a known place: squares of known size, as XML or as an Overpass reply."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.geometry.geodesy import from_local

ORIGIN = np.array([49.0112, 8.4229, 112.8])


class ExtractMaker:
    """Collects nodes (m from `ORIGIN`), ways and relations in Overpass' form."""

    def __init__(self) -> None:
        self.elements: list[dict[str, Any]] = []
        self._nodes = 0

    def nodes(self, corners: Any) -> list[int]:
        """New nodes at corners (K, 2), m; their numbers."""
        xy = np.asarray(corners, np.float64)
        first = self._nodes + 1
        for lat, lon, _ in from_local(np.column_stack([xy, np.zeros(len(xy))]), ORIGIN):
            self._nodes += 1
            self.elements.append({"type": "node", "id": self._nodes, "lat": lat, "lon": lon})
        return list(range(first, self._nodes + 1))

    def way(self, number: int, nodes: list[int], **tags: str) -> None:
        self.elements.append({"type": "way", "id": number, "nodes": nodes, "tags": _colons(tags)})

    def square(self, number: int, x: float, y: float, side: float, **tags: str) -> None:
        """A closed way round a square with its lower left corner at (x, y)."""
        ids = self.nodes(square_at(x, y, side))
        self.way(number, [*ids, ids[0]], **tags)

    def relation(self, number: int, members: list[tuple[int, str]], **tags: str) -> None:
        held = [{"type": "way", "ref": ref, "role": role} for ref, role in members]
        self.elements.append({"type": "relation", "id": number, "members": held, "tags": _colons(tags)})

    def tree(self) -> dict[str, Any]:
        return {"version": 0.6, "generator": "Overpass API", "elements": self.elements}

    def write_json(self, path: Path) -> Path:
        path.write_text(json.dumps(self.tree()))
        return path

    def write_xml(self, path: Path) -> Path:
        """As the OpenStreetMap website exports it."""
        lines = ["<?xml version='1.0' encoding='UTF-8'?>", '<osm version="0.6" generator="openstreetmap-cgimap">']
        for e in self.elements:
            tags = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in e.get("tags", {}).items())
            if e["type"] == "node":
                lines.append(
                    f'<node id="{e["id"]}" visible="true" lat="{e["lat"]:.9f}" lon="{e["lon"]:.9f}">{tags}</node>'
                )
            elif e["type"] == "way":
                refs = "".join(f'<nd ref="{n}"/>' for n in e["nodes"])
                lines.append(f'<way id="{e["id"]}">{refs}{tags}</way>')
            else:
                held = "".join(f'<member type="way" ref="{m["ref"]}" role="{m["role"]}"/>' for m in e["members"])
                lines.append(f'<relation id="{e["id"]}">{held}{tags}</relation>')
        path.write_text("\n".join([*lines, "</osm>"]), encoding="utf-8")
        return path


def square_at(x: float, y: float, side: float) -> Any:
    return np.array([x, y]) + side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])


def _colons(tags: dict[str, str]) -> dict[str, str]:
    """`building__levels` for `building:levels`, which Python cannot spell."""
    return {key.replace("__", ":"): value for key, value in tags.items()}

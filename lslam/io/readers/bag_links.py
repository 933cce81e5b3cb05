"""Where sensors sit: transforms of a bag that hold for good, said once on /tf_static or again and again, the same, on /tf."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.io.formats.bag_files import Bag
from lslam.io.formats.bag_streams import Transforms, chain, is_static, read_transforms
from lslam.io.readers.bag_lidars import UNNAMED, ScanIndex
from lslam.io.readers.ground_truth import Voice

Floats = NDArray[np.float64]

# What moves by less over a whole recording is rigid: the rounding of a driver, the play of a joint.
_STILL = 1e-3  # m, rad
# Messages of /tf that are held against /tf_static.
_LOOKED_AT = 100


@dataclass
class Links:
    """Transforms between frames; /tf is read when /tf_static does not lead from one to the other.

    static : of /tf_static; is_tf_used : whether a chain went over /tf
    """

    bag: Bag
    voice: Voice
    static: Transforms = field(default_factory=dict)
    is_tf_used: bool = False

    def __post_init__(self) -> None:
        """Read /tf_static; a pair of which it, or the beginning of /tf, says another thing is named."""
        for pair, poses in self._read(True).items():
            self.static[pair] = poses[-1]
            if not _is_still(poses):
                self.voice.problems.append(
                    f"/tf_static says more than one thing of {pair[0]} -> {pair[1]}, {_spread_text(poses)}: the last one counts"
                )
        for pair, poses in self._read(False, _LOOKED_AT).items() if self.static else ():
            if pair in self.static and not _is_still(both := np.concatenate([self.static[pair][None], poses])):
                self.voice.problems.append(
                    f"/tf says another thing of {pair[0]} -> {pair[1]} than /tf_static, {_spread_text(both)}: /tf_static counts"
                )

    def find(self, a: str, b: str) -> tuple[Floats, str] | None:
        """`T_a_b` (4, 4) along transforms that hold for good, and what says so; None when no chain connects the frames."""
        if (T := chain(self.static, a, b)) is not None:
            return T, "the same frame" if a == b else "from /tf_static"
        if not a or not b:
            return None
        if (T := chain(self._still, a, b)) is not None:
            self.is_tf_used = True
            return T, "from /tf, which always says the same of it"
        return None

    def why_not(self, a: str, b: str) -> str:
        """Why `find` gives nothing."""
        if not a or not b:
            return "messages name no frame"
        moving = {pair: poses[0] for pair, poses in self._of_tf.items() if pair not in self._still}
        every = {**moving, **self._still}
        if moving and chain(every, a, b) is not None:
            broken = [pair for pair in moving if chain({p: T for p, T in every.items() if p != pair}, a, b) is None]
            links = []
            for parent, child in broken or moving:
                poses = self._of_tf[parent, child]
                how = "/tf says only once" if len(poses) == 1 else f"changes on /tf ({_spread_text(poses)})"
                links.append(f"{parent} -> {child}, which {how}")
            return f"the way from frame {a} to {b} leads over {', '.join(links)}"
        there = "no transform leads" if every else "there is no /tf_static that leads"
        return f"{there} from frame {a} to {b}"

    @cached_property
    def _of_tf(self) -> Transforms:
        """All that /tf says, (N, 4, 4) by pair."""
        return self._read(False)

    @cached_property
    def _still(self) -> Transforms:
        """/tf_static, and of /tf what it says more than once and always the same."""
        same = {pair: poses[0] for pair, poses in self._of_tf.items() if len(poses) > 1 and _is_still(poses)}
        return {**same, **self.static}

    def _read(self, wants_static: bool, most: int | None = None) -> Transforms:
        problems = self.voice.problems if most is None else []
        found: dict[tuple[str, str], list[Floats]] = {}
        for topic in self.bag.of_type("TFMessage"):
            if is_static(topic) == wants_static:
                for pair, poses in read_transforms(self.bag, topic, problems, most).items():
                    found.setdefault(pair, []).append(poses)
        return {pair: np.concatenate(pieces) for pair, pieces in found.items()}


def places_of(
    lidars: Sequence[ScanIndex], links: Links, stated: Mapping[str, Floats] | None
) -> list[tuple[Floats, str]]:
    """`T_leading_other` (4, 4) of each of the LiDARs behind the first, which leads, and what says so.

    stated : `T_lidar_other` by frame or topic. The only LiDAR that it does not name is the one that it is about.

    Raises InputError for a LiDAR whose place nothing says: clouds of one frame may be in it already, or their drivers do not
    know better.
    """
    named = [(stated or {}).get(one.name, (stated or {}).get(one.topic.name)) for one in lidars]
    if stated and sum(T is None for T in named) == 1:
        named = [np.eye(4) if T is None else T for T in named]
    leading, T_lidar_leading = lidars[0], named[0]
    places = []
    for other, T_lidar_other in zip(lidars[1:], named[1:], strict=True):
        if T_lidar_other is not None:
            T = T_lidar_other if T_lidar_leading is None else se3.inverse(T_lidar_leading) @ T_lidar_other
            places.append((T, "as stated"))
            continue
        is_same = other.frame == leading.frame
        place = None if is_same else links.find(leading.frame, other.frame)
        if place is None:
            key, why = other.name, links.why_not(leading.frame, other.frame)
            if is_same:
                key, why = other.topic.name, f"both are of frame {other.frame or UNNAMED}"
            raise InputError(
                f"{links.bag.path}: {other} cannot be merged with {leading}, {why}: state T_lidar_other, 12 numbers, in "
                f'sequence.toml, [lidars] "{key}" = [1, 0, 0, x, ...], or take one LiDAR with --lidar-topic or --lidar-frame'
            )
        places.append(place)
    return places


def _spread(poses: Floats) -> tuple[float, float]:
    """By how much poses (N, 4, 4) differ from the first at most: m, rad."""
    off = se3.inverse(poses[0]) @ poses
    metres, turns = (np.linalg.norm(part, axis=1) for part in (off[:, :3, 3], so3.log(off[:, :3, :3])))
    return float(metres.max()), float(turns.max())


def _is_still(poses: Floats) -> bool:
    return max(_spread(poses)) <= _STILL


def _spread_text(poses: Floats) -> str:
    metres, turn = _spread(poses)
    return f"{metres:.3f} m and {np.degrees(turn):.1f} deg apart"

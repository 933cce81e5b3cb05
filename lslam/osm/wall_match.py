"""Matching of seen walls with known walls: the best planar pose, and which directions it observes.

Del Tufo, section 3.3. Pairs of corners, angular and virtual, propose poses inside the window that the odometry's
uncertainty opens; lines refine them; the fitness of equations 3.1 to 3.4 chooses. Beyond Del Tufo, parallel walls give no
information along them, and an ambiguous match is rejected.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.config.osm import OsmConfig
from lslam.kernels import wall_matching

Floats = NDArray[np.float64]

WINDOW = 3.0  # sigmas of the prior that are searched
REACH = 20.0  # m; a virtual edge lies at most so far beyond the ends of its walls
SHARPEST = np.radians(30.0)  # between two walls that make a corner
SPREAD = np.radians(8.0)  # by which the corners of a pair may differ
LIKENESS = np.cos(np.radians(25.0))  # between the directions of a pair of walls
CELL = np.array([0.75, 0.75, np.radians(4.0)])  # of the votes
CORNERS = 40
PROPOSALS = 150  # that get the most votes; of these the best few are laid on the lines
REFINED = 12
ROUGH = 2.5  # m; a pose of votes is right to about a cell
SHORT = 4.0  # m; a wall of this length has half the weight of an endless one
# m, round by round. Where the map is right walls lie on walls; its houses err by a metre or so, one by one. What is seen of
# one house does not.
GATES = np.array([2.5, 2.2, 1.9, 1.6, 1.4, 1.2, 1.2])
FINE_GATES = np.array([2.0, 1.5, 1.0, 0.7, 0.5, 0.4, 0.4])
MORE = 30  # rounds with the last gate, at most, until the pose stays
WIDE = np.array([6.0, 4.5, 3.0])  # from the prior itself: far walls move with its heading
FAINT = 1e-3  # of the prior's weight while the walls are fitted: it is for the graph to weigh the two
START_WALLS = 4  # two walls make a corner, and a town has many
SLACK = np.array([0.5, 0.5, 0.03])  # that refinement may leave the window by
NEAR_SAME, LIKE_SAME = 1.5, np.radians(6.0)  # m and rad; what differs less is the same answer
BESIDE = 2.0  # m between places that are tried across parallel walls: the first gate of either kind is as wide
ALIGNED = np.sin(np.radians(12.0)) ** 2  # a direction seen by less than this share of the best one is not seen
LONGEST = 60.0  # m from the walls seen; the map beyond is not asked


@dataclass(frozen=True)
class WallMatch:
    """A planar pose of the source's frame in the target's, and how much it is worth.

    pose : (3,) x, y (m), yaw (rad); information : (3, 3) of x, y, yaw in the target's axes, 1/m2 and 1/rad2, singular along
        what the walls do not fix; rank : 0 to 3, how many directions they do
    fitness : of equation 3.4, weighted as the configuration says; coverage : share of the source's length that lies on the
        target; distance : m, mean distance of equation 3.1; rms : m, across the walls that found a partner
    pairs : (K, 2) int64 which source wall lies on which target wall
    kind : `edges` when two walls that are not parallel found partners, else `lines`
    is_ambiguous : another pose fits nearly as well
    """

    pose: Floats
    information: Floats
    rank: int
    fitness: float
    coverage: float
    distance: float
    rms: float
    pairs: NDArray[np.int64]
    kind: Literal["edges", "lines"]
    is_ambiguous: bool


def match_walls(
    source: NDArray[Any],
    target: NDArray[Any],
    prior: NDArray[Any],
    sigma: NDArray[Any],
    config: OsmConfig | None = None,
    by_coverage: bool = False,
) -> WallMatch | None:
    """Lay `source` (S, 2, 2) on `target` (T, 2, 2), directed segments in m, near the pose `prior` (3,) x, y, yaw.

    The window is `WINDOW` times `sigma` (3,), m, m, rad. Del Tufo's global match lays the walls of a submap on those of all
    buildings near; its local match one building's on those of the submap, `by_coverage`, because most of it is not seen.

    Returns None when too little of the source finds a partner. A match that `is_ambiguous` is returned as such.
    """
    config = config or OsmConfig()
    at, spread = np.asarray(prior, np.float64), np.asarray(sigma, np.float64)
    window = np.append(WINDOW * spread[:2], min(WINDOW * spread[2], np.pi))
    trust = FAINT * config.wall_sigma**2 / np.maximum(spread, 1e-6) ** 2
    return _best(_rows(source), _rows(target), at, window, trust, config, by_coverage)


def find_heading(
    source: NDArray[Any], target: NDArray[Any], place: NDArray[Any], radius: float, config: OsmConfig | None = None
) -> WallMatch | None:
    """Where, within `radius` m of `place` (2,), and with which of all headings, the source lies on the target.

    The start without GNSS. Returns None when nothing fits, when it is only walls that leave a direction free, or fewer than
    `START_WALLS`; when several poses fit alike the match `is_ambiguous` and must not be used.
    """
    config = config or OsmConfig()
    # Nobody said which way it is: more has to fit, and nothing is near or far.
    config = config.model_copy(update={"translation_weight": 0.0, "min_coverage": config.min_start_coverage})
    at = np.append(np.asarray(place, np.float64)[:2], 0.0)
    found = _best(
        _rows(source), _rows(target), at, np.array([radius, radius, np.pi]), np.zeros(3), config, by_coverage=False
    )
    return None if found is None or found.rank < 3 or len(found.pairs) < START_WALLS else found


def _best(
    seen: Floats, known: Floats, at: Floats, window: Floats, trust: Floats, config: OsmConfig, by_coverage: bool
) -> WallMatch | None:
    """The fittest pose of those that corners propose, and of the prior's own, each moved onto the lines."""
    known, numbers = _within(known, seen, at, float(np.hypot(window[0], window[1])))
    if not len(seen) or not len(known):
        return None
    gates = FINE_GATES if by_coverage else GATES
    starts = [(at, np.concatenate([WIDE, gates]))]
    starts += [(pose, gates) for pose in _proposals(seen, known, at, window, by_coverage)]

    def laid(starts: list[tuple[Floats, Floats]]) -> list[WallMatch]:
        found = [_refined(seen, known, pose, gates, at, trust, window, config, by_coverage) for pose, gates in starts]
        return [m for m in found if m is not None]

    inside = laid(starts)
    if not inside:
        return None
    best = max(inside, key=lambda m: m.fitness)
    if best.rank < 3:
        inside += laid([(pose, gates) for pose in _beside(best, at, window)])
        best = max(inside, key=lambda m: m.fitness)
    if best.coverage < (config.min_building_coverage if by_coverage else config.min_coverage):
        return None
    pairs = np.column_stack([best.pairs[:, 0], numbers[best.pairs[:, 1]]])
    return replace(best, pairs=pairs, is_ambiguous=_has_alternative(best, inside, config))


def _rows(segments: NDArray[Any]) -> Floats:
    return np.ascontiguousarray(np.asarray(segments, np.float64).reshape(-1, 4))


def _within(known: Floats, seen: Floats, at: Floats, slack: float) -> tuple[Floats, NDArray[np.int64]]:
    """The target walls that the source can touch, and their numbers."""
    reach = min(float(np.abs(seen).max(initial=0.0)) * np.sqrt(2), LONGEST * 2) + slack + 5.0
    a, b = known[:, :2] - at[:2], known[:, 2:] - at[:2]
    along = b - a
    share = np.clip(-(a * along).sum(1) / np.maximum((along * along).sum(1), 1e-12), 0, 1)
    numbers = np.flatnonzero(np.linalg.norm(a + share[:, None] * along, axis=1) <= reach)
    return np.ascontiguousarray(known[numbers]), numbers


def _proposals(seen: Floats, known: Floats, at: Floats, window: Floats, by_coverage: bool) -> Floats:
    """(K, 3) poses for which many pairs of corners vote, and at which the walls lie near others."""
    ours, theirs = (wall_matching.corners(walls, REACH, SHARPEST) for walls in (seen, known))
    if not len(ours) or not len(theirs):
        return np.zeros((0, 3))
    # The heaviest corners of a submap say what all do.
    ours = ours[np.argsort(-ours[:, 4], kind="stable")[:CORNERS]]
    is_round = bool(window[2] >= np.pi - 1e-9)
    cell = np.where(is_round, [*CELL[:2], 2 * np.pi / 90 * (1 + 1e-9)], CELL)
    grid = wall_matching.votes(ours, theirs, at, window, cell, SPREAD)
    if is_round:
        grid = np.ascontiguousarray(grid[:, :, :90])
    poses = wall_matching.peaks(grid, at, PROPOSALS, is_round)
    away = [wall_matching.fit(seen, known, pose, ROUGH, LIKENESS, by_coverage)[0] for pose in poses]
    return np.asarray(poses[np.argsort(away, kind="stable")[:REFINED]])


def _beside(best: WallMatch, at: Floats, window: Floats) -> Floats:
    """(K, 3) poses across the parallel walls of `best`, which no corner proposes, all through the window."""
    across = np.linalg.eigh(best.information[:2, :2])[1][:, 1]
    reach = float(np.linalg.norm(across * window[:2]))
    steps = np.arange(0.5 * BESIDE, reach, BESIDE)
    return np.asarray(at + np.append(across, 0.0) * np.concatenate([-steps, steps])[:, None])


def _refined(
    seen: Floats, known: Floats, pose: Floats, gates: Floats, at: Floats, trust: Floats, window: Floats,
    config: OsmConfig, by_coverage: bool,
) -> WallMatch | None:  # fmt: skip
    """The pose moved onto the lines; None when it leaves the window or loses all its walls."""
    pose, normal, centre, rms, pair = wall_matching.refine(
        seen, known, pose, at, trust, gates, MORE, LIKENESS, SHORT, by_coverage
    )
    away = np.array([*(pose[:2] - at[:2]), (pose[2] - at[2] + np.pi) % (2 * np.pi) - np.pi])
    if (np.abs(away) > window + SLACK).any() or not (pair >= 0).any():
        return None
    # Errors of a map's wall are those of whoever drew it: more points do not mend them.
    planar, free, rank = _deflated(normal / config.wall_sigma**2)
    pose[:2] -= free @ away[:2]
    distance, coverage, pair = wall_matching.fit(seen, known, pose, config.max_distance, LIKENESS, by_coverage)
    if not (pair >= 0).any():
        return None
    translation = float(np.linalg.norm(pose[:2] - at[:2]))
    farthest = float(np.linalg.norm(window[:2]))
    fitness = 100.0 * (
        -config.distance_weight * min(distance / config.max_distance, 1.0)
        + config.coverage_weight * coverage
        - config.translation_weight * min(translation / max(farthest, 1e-9), 1.0)
    )
    kind: Literal["edges", "lines"] = "edges" if rank == 3 else "lines"
    information = _at_pose(planar, centre, pose) * (1.0 if kind == "edges" else config.line_weight)
    pairs = np.column_stack([np.flatnonzero(pair >= 0), pair[pair >= 0]])
    return WallMatch(
        pose, information, rank, float(fitness), float(coverage), float(distance), float(rms), pairs, kind, False
    )


def _deflated(normal: Floats) -> tuple[Floats, Floats, int]:
    """The normal matrix about the walls' centre without the directions that only noise of their angles speaks of.

    Then the projector (2, 2) on these free directions, and the rank of what is left.
    """
    values, axes = np.linalg.eigh(normal[:2, :2])
    is_seen = (values >= ALIGNED * values[1]) & (values[1] > 0)
    keep = np.zeros((3, 3))
    keep[:2, :2] = (axes * is_seen) @ axes.T
    keep[2, 2] = 1.0
    planar = keep @ normal @ keep
    return np.asarray((planar + planar.T) / 2), np.eye(2) - keep[:2, :2], int(is_seen.sum()) + int(normal[2, 2] > 0)


def _at_pose(planar: Floats, centre: Floats, pose: Floats) -> Floats:
    """Information about the walls' centre as that of the pose: the centre moves with both its translation and its turn."""
    moves = np.eye(3)
    moves[0, 2], moves[1, 2] = -(centre[1] - pose[1]), centre[0] - pose[0]
    return np.asarray(moves.T @ planar @ moves)


def _has_alternative(best: WallMatch, found: list[WallMatch], config: OsmConfig) -> bool:
    """True when a pose that differs in what the walls fix fits nearly as well."""
    for other in found:
        if other.fitness < best.fitness - config.rival_margin:
            continue
        away = other.pose - best.pose
        away[2] = (away[2] + np.pi) % (2 * np.pi) - np.pi
        if best.rank < 3:
            values, axes = np.linalg.eigh(best.information[:2, :2])
            free = axes[:, values < 1e-9 * max(values[1], 1e-12)]
            away[:2] -= free @ (free.T @ away[:2])
        if np.hypot(away[0], away[1]) > NEAR_SAME or abs(away[2]) > LIKE_SAME:
            return True
    return False

"""Matching of walls: the planar pose of one set of walls in another, and its information.

Del Tufo, section 3.3. Pairs of corners, angular and virtual, vote for poses within the window of the prior; each is refined by
the lines, and the one with the best fitness (equations 3.1 to 3.4) is taken. Beyond Del Tufo, parallel walls give no
information along them, and an ambiguous match is rejected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.config.backend import OsmConfig
from lslam.core.geometry import se2
from lslam.core.types.building import BuildingMatch, KeyframeMatch
from lslam.core.types.constraint import Verdict
from lslam.osm.kernels import wall_matching
from lslam.osm.walls import BUILDING_RATIO, OsmMap, find_walls, planar_sigmas

MIN_START_COVERAGE = 0.6  # share of the walls seen that must lie on the map where any heading is possible
MIN_BUILDING_COVERAGE = 0.1  # share of a building's walls that must be seen
LINE_WEIGHT = 0.25  # information of a match of parallel walls only, against one with corners
SEARCH_SIGMAS = 3.0  # sigmas of the prior that are searched
EDGE_REACH_M = 20.0  # m; a virtual edge lies at most so far beyond the ends of its walls
SHARPEST = np.radians(30.0)  # between two walls that make a corner
CORNER_SPREAD_RAD = np.radians(8.0)  # by which the corners of a pair may differ
LIKENESS = np.cos(np.radians(25.0))  # between the directions of a pair of walls
CELL = np.array([0.75, 0.75, np.radians(4.0)])  # of the votes
CORNERS = 40
PROPOSALS = 150  # poses with the most votes; the best `MOST_REFINEMENTS` of them are refined
MOST_REFINEMENTS = 12
ROUGH = 2.5  # m; a pose of votes is right to about a cell
SHORT = 4.0  # m; a wall of this length has half the weight of an infinite one
# m, iteration by iteration. The last gate of the global match admits the errors of single buildings on the map, about a metre: a
# smaller one has two optima where some lie a metre from the others. The walls of one building have no such errors.
GATES = np.array([2.5, 2.2, 1.8])
FINE_GATES = np.array([2.0, 1.5, 1.0, 0.7, 0.5, 0.4, 0.4])
LAST_ITERATIONS = 30  # most iterations with the last gate, until convergence
FIRST_GATES = np.array([6.0, 4.5, 3.0])  # first gates from the prior itself: an error in heading displaces far walls
FAINT = 1e-3  # factor on the prior's weight in the fit, since the graph has the prior too
START_WALLS = 4  # least walls of a start: the two of one corner would fit in many places of a town
REFINED_SLACK = np.array([0.5, 0.5, 0.03])  # m, m, rad; by which refinement may leave the window
NEAR_SAME, LIKE_SAME = GATES[-1], np.radians(6.0)  # m and rad; poses that differ less pair the same walls
BESIDE = 2.0  # m between the poses that are tried across parallel walls, the width of the first gates
LEAST_INFORMATION = (
    np.sin(np.radians(12.0)) ** 2
)  # least information of an observed direction, as a part of the largest
VISIBLE_M = 60.0  # m from the walls seen; the map beyond is left out


@dataclass(frozen=True)
class WallMatch:
    """A planar pose of the source's frame in the target's, with its information and its scores.

    pose : (3,) x, y (m), yaw (rad); information : (3, 3) of x, y, yaw in the target's axes, 1/m2 and 1/rad2, singular along
        free directions; rank : 0 to 3, number of observed directions
    fitness : of equation 3.4, weighted as the configuration says; coverage : share of the source's length that lies on the
        target; distance : m, mean distance of equation 3.1; rms : m, of the distances across paired walls
    pairs : (K, 2) int64 numbers of a source wall and of its target wall
    is_ambiguous : another pose fits nearly as well
    """

    pose: Floats
    information: Floats
    rank: int
    fitness: float
    coverage: float
    distance: float
    rms: float
    pairs: Longs
    is_ambiguous: bool = False

    @property
    def kind(self) -> Literal["edges", "lines"]:
        """`edges` when the paired walls are not all parallel, else `lines`."""
        return "edges" if self.rank == 3 else "lines"

    def facts(self) -> dict[str, Any]:
        """The fields for a keyframe's or building's match, by name, with the reason if it is rejected."""
        names = ("pose", "information", "rank", "kind", "fitness", "coverage", "rms", "pairs")
        reason = "another place fits nearly as well" if self.is_ambiguous else ""
        return {name: getattr(self, name) for name in names} | {"reason": reason}


def match_walls(
    source: NDArray[Any],
    target: NDArray[Any],
    prior: NDArray[Any],
    sigma: NDArray[Any],
    config: OsmConfig | None = None,
    by_coverage: bool = False,
) -> WallMatch | None:
    """Match `source` (S, 2, 2) with `target` (T, 2, 2), directed segments in m, near the pose `prior` (3,) x, y, yaw.

    The window is `SEARCH_SIGMAS` times `sigma` (3,), m, m, rad. Del Tufo's global match has the walls of a submap as source
    and those of all buildings near as target. The local match has the walls of one building as source and those of the submap
    as target, `by_coverage`, because most of the building is not seen.

    Returns None when the coverage is too small. An ambiguous match is returned, with `is_ambiguous`.
    """
    config = config or OsmConfig()
    at, spread = np.asarray(prior, np.float64), np.asarray(sigma, np.float64)
    window = np.append(SEARCH_SIGMAS * spread[:2], min(SEARCH_SIGMAS * spread[2], np.pi))
    trust = FAINT * config.wall_sigma**2 / np.maximum(spread, 1e-6) ** 2
    return _WallSearch(_rows(source), _rows(target), at, window, trust, config, by_coverage).best()


def find_heading(
    source: NDArray[Any], target: NDArray[Any], place: NDArray[Any], radius: float, config: OsmConfig | None = None
) -> WallMatch | None:
    """Match the source with the target within `radius`, m, of `place` (2,) over all headings: the start without GNSS.

    source, target : walls (S, 2, 2), (T, 2, 2), m. Returns None without a match, for a match with a free direction, or with
    fewer than `START_WALLS` pairs. A match with `is_ambiguous` has an equally good alternative and must not be used.
    """
    config = config or OsmConfig()
    # Without a heading the least coverage is larger, and the distance from the prior does not count.
    config = config.model_copy(update={"weights": (*config.weights[:2], 0.0), "min_coverage": MIN_START_COVERAGE})
    at, window = np.append(np.asarray(place, np.float64)[:2], 0.0), np.array([radius, radius, np.pi])
    match = _WallSearch(_rows(source), _rows(target), at, window, np.zeros(3), config, by_coverage=False).best()
    return None if match is None or match.rank < 3 or len(match.pairs) < START_WALLS else match


def _rows(segments: NDArray[Any]) -> Floats:
    """Segments (N, 2, 2) as rows (N, 4), x y x y."""
    return np.ascontiguousarray(np.asarray(segments, np.float64).reshape(-1, 4))


class _WallSearch:
    """The search for the pose of source walls among target walls, rows x y x y, m, in a window about a prior.

    at : (3,) the prior; window : (3,) m, m, rad; trust : (3,) inverse variances of the prior relative to that of a wall
    by_coverage : as of `match_walls`
    """

    def __init__(
        self,
        source: Floats,
        target: Floats,
        at: Floats,
        window: Floats,
        trust: Floats,
        config: OsmConfig,
        by_coverage: bool,
    ) -> None:
        self.source, self.at, self.window, self.trust = source, at, window, trust
        self.config, self.by_coverage = config, by_coverage
        self.numbers = self._within_reach(target)
        self.target = np.ascontiguousarray(target[self.numbers])

    def best(self) -> WallMatch | None:
        """Fittest pose, refined from the prior and from poses that corners propose; None if none covers enough."""
        if not len(self.source) or not len(self.target):
            return None
        gates = FINE_GATES if self.by_coverage else GATES
        starts = [(self.at, np.concatenate([FIRST_GATES, gates]))]
        starts += [(pose, gates) for pose in self._proposals()]
        inside = self._refine_all(starts)
        if not inside:
            return None
        best = max(inside, key=lambda m: m.fitness)
        if best.rank < 3:
            inside += self._refine_all([(pose, gates) for pose in self._beside(best)])
            best = max(inside, key=lambda m: m.fitness)
        if best.coverage < (MIN_BUILDING_COVERAGE if self.by_coverage else self.config.min_coverage):
            return None
        pairs = np.column_stack([best.pairs[:, 0], self.numbers[best.pairs[:, 1]]])
        return replace(best, pairs=pairs, is_ambiguous=_has_alternative(best, inside, self.config))

    def _within_reach(self, target: Floats) -> Longs:
        """Indices of the target walls (T, 4) that a source wall can reach from any pose of the window."""
        slack = float(np.hypot(self.window[0], self.window[1]))
        reach = min(float(np.abs(self.source).max(initial=0.0)) * np.sqrt(2), VISIBLE_M * 2) + slack + 5.0
        a, b = target[:, :2] - self.at[:2], target[:, 2:] - self.at[:2]
        along = b - a
        share = np.clip(-(a * along).sum(1) / np.maximum((along * along).sum(1), 1e-12), 0, 1)
        return np.flatnonzero(np.linalg.norm(a + share[:, None] * along, axis=1) <= reach)

    def _proposals(self) -> Floats:
        """Poses (K, 3) with many votes of pairs of corners, those of least distance between the walls first."""
        ours, theirs = (wall_matching.corners(walls, EDGE_REACH_M, SHARPEST) for walls in (self.source, self.target))
        if not len(ours) or not len(theirs):
            return np.zeros((0, 3))
        # The corners of largest weight are enough.
        ours = ours[np.argsort(-ours[:, 4], kind="stable")[:CORNERS]]
        is_round = bool(self.window[2] >= np.pi - 1e-9)
        cell = np.where(is_round, [*CELL[:2], 2 * np.pi / 90 * (1 + 1e-9)], CELL)
        grid = wall_matching.votes(ours, theirs, self.at, self.window, cell, CORNER_SPREAD_RAD)
        if is_round:
            grid = np.ascontiguousarray(grid[:, :, :90])
        poses = wall_matching.peaks(grid, self.at, PROPOSALS, is_round)
        away = [self._fit(pose, ROUGH)[0] for pose in poses]
        return np.asarray(poses[np.argsort(away, kind="stable")[:MOST_REFINEMENTS]])

    def _beside(self, best: WallMatch) -> Floats:
        """Starts (K, 3) beside the match `best`, shifted across its parallel walls over the whole window.

        Parallel walls have no corners that vote.
        """
        across = np.linalg.eigh(best.information[:2, :2])[1][:, 1]
        reach = float(np.linalg.norm(across * self.window[:2]))
        steps = np.arange(0.5 * BESIDE, reach, BESIDE)
        return np.asarray(self.at + np.append(across, 0.0) * np.concatenate([-steps, steps])[:, None])

    def _refine_all(self, starts: list[tuple[Floats, Floats]]) -> list[WallMatch]:
        """Matches refined from all starts (pose and gates) that lead to one."""
        return [match for start in starts if (match := self._refine(*start)) is not None]

    def _refine(self, pose: Floats, gates: Floats) -> WallMatch | None:
        """Pose (3,) refined by lines with each of `gates` (G,), m; None if it leaves the window or no wall has a partner."""
        at, config, prior = self.at, self.config, (self.at, self.trust)
        pose, normal, centre, rms, pair = wall_matching.refine(
            self.source, self.target, pose, *prior, gates, LAST_ITERATIONS, LIKENESS, SHORT, self.by_coverage
        )
        away = np.array([*(pose[:2] - at[:2]), (pose[2] - at[2] + np.pi) % (2 * np.pi) - np.pi])
        if (np.abs(away) > self.window + REFINED_SLACK).any() or not (pair >= 0).any():
            return None
        # The error of a wall on the map does not decrease with the number of points on it.
        planar, free, rank = _deflate(normal / config.wall_sigma**2)
        pose[:2] -= free @ away[:2]
        distance, coverage, pair = self._fit(pose, config.max_distance)
        if not (pair >= 0).any():
            return None
        translation = float(np.linalg.norm(pose[:2] - at[:2]))
        farthest = float(np.linalg.norm(self.window[:2]))
        by_distance, by_coverage, by_translation = config.weights
        fitness = 100.0 * (
            -by_distance * min(distance / config.max_distance, 1.0)
            + by_coverage * coverage
            - by_translation * min(translation / max(farthest, 1e-9), 1.0)
        )
        information = _at_pose(planar, centre, pose) * (1.0 if rank == 3 else LINE_WEIGHT)
        pairs = np.column_stack([np.flatnonzero(pair >= 0), pair[pair >= 0]])
        return WallMatch(pose, information, rank, float(fitness), float(coverage), float(distance), float(rms), pairs)

    def _fit(self, pose: Floats, farthest: float) -> tuple[float, float, Longs]:
        """Mean distance, m, covered share and pairs (S,) at a pose (3,), as of `wall_matching.fit`."""
        return wall_matching.fit(self.source, self.target, pose, farthest, LIKENESS, self.by_coverage)


def _deflate(normal: Floats) -> tuple[Floats, Floats, int]:
    """The normal matrix (3, 3) about the walls' centre without free directions, whose information is noise of the walls' angles.

    Returns also the projector (2, 2) on the free directions, and the rank of the matrix.
    """
    values, axes = np.linalg.eigh(normal[:2, :2])
    is_seen = (values >= LEAST_INFORMATION * values[1]) & (values[1] > 0)
    keep = np.zeros((3, 3))
    keep[:2, :2] = (axes * is_seen) @ axes.T
    keep[2, 2] = 1.0
    planar = keep @ normal @ keep
    return np.asarray((planar + planar.T) / 2), np.eye(2) - keep[:2, :2], int(is_seen.sum()) + int(normal[2, 2] > 0)


def _at_pose(planar: Floats, centre: Floats, pose: Floats) -> Floats:
    """Information (3, 3) of the `pose` (3,) from that of the walls' `centre` (2,), which moves with the pose."""
    moves = np.eye(3)
    moves[0, 2], moves[1, 2] = -(centre[1] - pose[1]), centre[0] - pose[0]
    return np.asarray(moves.T @ planar @ moves)


def _has_alternative(best: WallMatch, found: list[WallMatch], config: OsmConfig) -> bool:
    """Whether a pose of `found` that differs from `best` along observed directions fits nearly as well."""
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


def warm_up() -> None:
    """Compile or load every kernel of matching, by matching two walls with themselves."""
    s, z = (part.ravel() for part in np.meshgrid(np.arange(0.0, 8.0, 0.2), np.arange(2.0, 5.0, 0.2)))
    corner = np.concatenate([np.column_stack([s, 0 * s + 8, z]), np.column_stack([0 * s + 8, s, z])])
    floor = np.column_stack([s, s, 0 * z])
    walls = find_walls(np.concatenate([corner, floor])).segments
    for by_coverage in (False, True):
        match_walls(walls, walls, np.zeros(3), np.ones(3), by_coverage=by_coverage)


def match_keyframe(view: KeyframeMatch, osm: OsmMap, config: OsmConfig) -> KeyframeMatch:
    """Match the walls of `view` with the buildings in range of its prior pose and sigma; `reason` tells why it is rejected."""
    if not len(view.walls):
        return replace(view, reason="no walls seen")
    reach = config.use_radius + SEARCH_SIGMAS * float(np.hypot(view.sigma[0], view.sigma[1]))
    numbers = osm.walls_near(view.prior[:2], reach)
    if not len(numbers):
        return replace(view, reason="no building near")
    match = match_walls(view.walls, osm.walls[numbers], view.prior, view.sigma, config)
    if match is None:
        return replace(view, reason="too few of the walls seen lie on the map")
    pairs = np.column_stack([match.pairs[:, 0], numbers[match.pairs[:, 1]]])
    return replace(view, **match.facts() | {"pairs": pairs})


def match_buildings(
    match: KeyframeMatch, pose: Floats, shift: Floats, osm: OsmMap, config: OsmConfig
) -> list[BuildingMatch]:
    """Match each building in range with the walls seen from a keyframe at `pose` (3,), map frame.

    shift : (2,) m, common shift of the map, by which the prior of every building is displaced
    """
    found: list[BuildingMatch] = []
    if not len(match.walls):
        return found
    sigma = planar_sigmas(BUILDING_RATIO * config.map_sigma)
    own = config.of_one_building
    for number in osm.near(pose[:2] - shift, config.use_radius).tolist():
        middle = osm.buildings[number].middle
        walls = osm.walls[osm.owners == number] - middle
        if not len(walls):
            continue
        prior = se2.relative(pose, np.append(middle + shift, 0.0))
        # By coverage, since most buildings are seen in part.
        one = match_walls(walls, match.walls, prior, sigma, own, by_coverage=True)
        if one is None:
            continue
        verdict = Verdict.REJECTED if one.is_ambiguous else Verdict.ACCEPTED
        found.append(BuildingMatch(match.keyframe, number, **one.facts(), verdict=verdict))
    return found


def shares(matches: Sequence[KeyframeMatch], walls: int) -> list[float]:
    """Weight of each match: the mean over its walls of 1 / n, where n matches have the same wall of the map's `walls`.

    The map's error of a wall is common to all keyframes that see it, so their matches are not independent.
    """
    seen = np.zeros(walls, np.int64)
    for match in matches:
        seen[np.unique(match.pairs[:, 1])] += 1
    return [float(np.mean(1.0 / seen[match.pairs[:, 1]])) for match in matches]

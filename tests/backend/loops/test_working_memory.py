"""Which places a bounded memory compares, and that loops are closed with it all the same."""

from __future__ import annotations

import numpy as np
import pytest
from known_town import Points, keyframes_of, round_the_square, seen, town
from numpy.typing import NDArray

from lslam.backend.loops import PlaceMatch
from lslam.backend.loops.detector import NEAR_M, Detector
from lslam.backend.loops.gating import LOOP_PLACES, MOST_RETRIEVALS, WorkingMemory
from lslam.core.config.backend import LoopsConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.types.constraint import LoopCandidate, LoopStage, Verdict

STEP = 4.0
RECENT = 30.0


def memory_of(places: NDArray[np.int64], bound: int | None) -> WorkingMemory:
    return WorkingMemory(places, STEP * np.arange(len(places)), bound, RECENT)


def test_without_a_bound_all_older_keyframes_are_compared() -> None:
    memory = memory_of(np.arange(50), None)
    assert not any(memory.reach(k) for k in range(50))
    memory.close(3, 40)
    np.testing.assert_array_equal(memory.before(45), np.arange(45))


def test_beyond_the_bound_the_oldest_of_the_lightest_is_transferred() -> None:
    # Place 5 stands for three keyframes, all others for one.
    places = np.sort(np.concatenate([np.arange(60), [5, 5]]))
    memory = memory_of(places, 20)
    for k in range(len(places)):
        memory.reach(k)
        assert len(memory) <= 20
    np.testing.assert_array_equal(places[memory.before(len(places))], np.concatenate([[5, 5, 5], np.arange(41, 60)]))


def test_places_of_the_way_just_travelled_are_never_transferred() -> None:
    memory = memory_of(np.arange(40), 3)
    for k in range(40):
        memory.reach(k)
        recent = np.arange(max(0, k - int(RECENT / STEP)), k + 1)
        assert np.isin(recent, memory.before(k + 1)).all()


def test_a_loop_retrieves_the_neighbours_of_its_older_place_nearest_first() -> None:
    memory = memory_of(np.arange(300), 20)
    for k in range(200):
        memory.reach(k)
    assert memory.before(200).min() > 150
    memory.close(50, 199)
    for round_ in range(1, 4):
        memory.reach(199 + round_)
        steps = np.arange(1, round_ + 1)
        np.testing.assert_array_equal(
            np.intersect1d(memory.before(200), np.arange(100)), np.sort([*50 - steps, *50 + steps])
        )
    for k in range(203, 240):
        memory.reach(k)
        assert len(memory) <= 20 + 2 * LOOP_PLACES + MOST_RETRIEVALS
    retrieved = np.intersect1d(memory.before(200), np.arange(100))
    np.testing.assert_array_equal(retrieved, np.setdiff1d(np.arange(50 - LOOP_PLACES, 51 + LOOP_PLACES), [50]))


def test_a_retrieved_place_is_as_young_as_those_that_entered_with_it() -> None:
    memory = memory_of(np.arange(300), 60)
    for k in range(200):
        memory.reach(k)
    memory.close(50, 199)
    for k in range(200, 216):
        memory.reach(k)
    # Another loop, elsewhere, so that nothing protects the first. All weigh as much.
    memory.close(205, 215)
    for k in range(216, 235):
        memory.reach(k)
        assert len(memory) <= 60
    kept = set(memory.before(235).tolist())
    assert {48, 49, 51, 52} < kept
    assert 190 not in kept


def test_the_weight_of_a_place_moves_to_the_one_that_sees_it_again() -> None:
    memory = memory_of(np.arange(200), 40)
    for k in range(20):
        memory.reach(k)
    memory.close(2, 19)
    for k in range(20, 100):
        memory.reach(k)
    # Another loop, elsewhere, so that nothing protects the first.
    memory.close(80, 99)
    for k in range(100, 160):
        memory.reach(k)
    kept = memory.before(160)
    assert 19 in kept
    assert 2 not in kept
    assert 18 not in kept


LAP = 360.0


def detect(
    monkeypatch: pytest.MonkeyPatch, bound: int | None, laps: float, threads: int = 1
) -> tuple[list[LoopCandidate], Detector]:
    """Candidates of laps round a thin town, verified where their true poses are near each other."""
    true = np.array([round_the_square(d) for d in np.arange(0, laps * LAP, 5.0)])
    world = town()[::40]

    def cloud(number: int) -> Points:
        return seen(world, true[number], np.random.default_rng(number))

    def examine(match: PlaceMatch, b: int) -> LoopCandidate:
        away = float(np.linalg.norm(true[match.number, :3, 3] - true[b, :3, 3]))
        verdict = Verdict.ACCEPTED if away < 5 and b % 7 else Verdict.REJECTED
        return LoopCandidate(match.number, b, away, match.distance, verdict, LoopStage.OVERLAP, "")

    config = LoopsConfig(memory_places=bound)
    detector = Detector(keyframes_of(true), cloud, config, RegistrationConfig())
    monkeypatch.setattr(detector, "_examine", examine)
    monkeypatch.setattr(detector, "_level_world", lambda: None)
    return detector.find(threads=threads), detector


def test_laps_are_closed_with_places_in_memory_and_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    alone, detector = detect(monkeypatch, 80, 4.2)
    together, _ = detect(monkeypatch, 80, 4.2, threads=4)
    assert [repr(c) for c in together] == [repr(c) for c in alone]
    closures = [c for c in alone if c.is_accepted]
    assert all(any(lap * 72 < c.b <= (lap + 1) * 72 for c in closures) for lap in (1, 2, 3))
    assert {c.a // 72 for c in closures if c.b > 216} & {1, 2}
    assert len(detector.memory) <= 80 + 2 * LOOP_PLACES + MOST_RETRIEVALS
    assert sum(c.is_accepted for c in detect(monkeypatch, None, 4.2)[0]) <= 1.2 * len(closures)


def test_neighbours_that_look_alike_are_rehearsed_as_one_place() -> None:
    true = np.array([round_the_square(d) for d in np.arange(0, LAP, 1.5)])
    world = town()[::40]
    clouds = [seen(world, pose, np.random.default_rng(k)) for k, pose in enumerate(true)]

    def places(rehearsal: float) -> NDArray[np.int64]:
        config = LoopsConfig(memory_places=500, rehearsal=rehearsal)
        detector = Detector(keyframes_of(true), clouds.__getitem__, config, RegistrationConfig())
        place_of = detector._rehearse(1 - rehearsal, lambda: False)
        assert set(np.diff(place_of)) <= {0, 1}
        begins = np.flatnonzero(np.diff(place_of, prepend=-1))
        for k in range(len(true)):
            first = int(begins[place_of[k]])
            assert np.linalg.norm(true[k, :3, 3] - true[first, :3, 3]) <= NEAR_M
            assert k == first or 1 - detector._matches(k, np.array([first]))[0].distance >= rehearsal
        return place_of

    few, some, all_apart = (places(rehearsal) for rehearsal in (0.5, 0.8, 0.999))
    assert few[-1] < some[-1] < all_apart[-1] == len(true) - 1


def test_an_unbounded_memory_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    bounded, every = (detect(monkeypatch, places, 2.2)[0] for places in (400, None))
    assert [repr(c) for c in bounded] == [repr(c) for c in every]

"""What appeared and what vanished, on rays whose ends are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.errors import ConfigError, InterruptedRunError
from lslam.core.geometry import se3
from lslam.core.stopping import asking
from lslam.maps.changes import ChangedCells, MapChange, changed_cells, differences, points_in
from lslam.maps.occupancy import MODEL, Evidence, OccupancyMapper

VOXEL = 0.4
ORIGIN = np.zeros(3, np.int64)
Floats = NDArray[np.float64]
# A box in front of the wall: its lower and upper corner, m.
BOX = (np.array([-1.0, 5.1, -1.1]), np.array([1.0, 6.5, 0.3]))


def scan(position: Floats, wall: float = 10.1, box: bool = False, half: bool = False) -> NDArray[np.float32]:
    """Beams from `position` on a wall at y = `wall`, or what stands before it, in the sensor's frame; `half`: to its right."""
    x, z = np.meshgrid(np.linspace(-9, 9, 181), np.linspace(-2.3, 2.5, 49))
    ends = np.stack([x, np.full_like(x, wall), z], -1).reshape(-1, 3)
    if half:
        ends = ends[ends[:, 0] > 4]
    beams = ends - position
    if box:
        # Slabs: where a beam enters the box last and leaves it first.
        sides = (np.stack(BOX)[:, None] - position) / np.where(beams == 0, 1e-12, beams)
        enters, leaves = sides.min(0).max(1), sides.max(0).min(1)
        beams = np.where((enters < leaves)[:, None], beams * enters[:, None], beams)
    return beams.astype(np.float32)


def drive(count: int = 16, voxel: float = VOXEL, step: float = 0.5, **seen: object) -> Evidence:
    """Along the wall, one scan every `step` m."""
    mapper = OccupancyMapper(voxel, 0.5, 30.0, origin=ORIGIN)
    for k in range(count):
        position = np.array([step * (k - 0.5 * count), 0.05, 0.1])
        shown = {name: value(k) if callable(value) else value for name, value in seen.items()}
        mapper.add(scan(position, **shown), se3.make(np.eye(3), position))  # type: ignore[arg-type]
    return mapper.evidence()


def kinds(found: ChangedCells) -> list[str]:
    return [change.kind for change in found.changes]


def test_a_box_appears_and_vanishes_and_what_it_hides_does_neither() -> None:
    """From one place part of the wall is behind it; on the way along it none is."""
    without, boxed = drive(step=0.0), drive(step=0.0, box=True)
    assert changed_cells(without, boxed).unseen_new > 20
    assert kinds(changed_cells(without, boxed)) == ["vanished"]
    assert kinds(changed_cells(boxed, without)) == ["appeared"]
    without, boxed = drive(), drive(box=True)
    there, gone = changed_cells(boxed, without), changed_cells(without, boxed)
    assert (kinds(there), kinds(gone)) == (["appeared"], ["vanished"])
    (box,) = there.changes
    assert np.array_equal(box.cells, gone.changes[0].cells)
    # Its faces lie in these cells; that towards the wall no beam sees.
    assert (box.cells.min(0) == np.floor(BOX[0] / VOXEL)).all()
    assert (box.cells[:, [0, 2]].max(0) == np.floor(BOX[1] / VOXEL)[[0, 2]]).all()
    assert (there.occupied_new, there.occupied_old) == (gone.occupied_old, gone.occupied_new)


def test_what_the_other_drive_never_saw_is_no_change() -> None:
    whole, half = drive(), drive(half=True)
    for found in (changed_cells(whole, half), changed_cells(half, whole)):
        assert found.changes == ()
    assert changed_cells(whole, half).unseen_new > 0.5 * changed_cells(whole, half).occupied_new


@pytest.mark.parametrize("shift", [0.05, -0.05, 0.3, -0.3])
def test_a_surface_in_the_cell_beside_its_own_has_not_changed(shift: float) -> None:
    """The border of cells lies at 10.0: noise carries a wall over it."""
    found = changed_cells(drive(wall=10.0 + shift), drive(wall=10.0 - shift))
    assert found.changes == ()
    assert len(found.same) == found.occupied_new


def test_a_wall_that_moved_by_metres_has_changed() -> None:
    """Nearer, it appears; where it was is hidden, which is no sign that it vanished."""
    assert kinds(changed_cells(drive(wall=7.1), drive(wall=10.1))) == ["appeared"]
    assert kinds(changed_cells(drive(wall=10.1), drive(wall=7.1))) == ["vanished"]


@pytest.mark.parametrize("presence", [lambda k: 3 <= k < 9, lambda k: k < 6, lambda k: k >= 10])
def test_what_came_or_went_during_a_drive_is_no_change(presence: object) -> None:
    passing, without, boxed = drive(box=presence), drive(), drive(box=True)
    for other in (without, boxed):
        assert changed_cells(passing, other).changes == ()
        assert changed_cells(other, passing).changes == ()


def test_two_scans_are_not_enough() -> None:
    assert changed_cells(drive(count=2, box=True), drive()).changes == ()
    assert changed_cells(drive(box=True), drive(count=2)).changes == ()


def test_cells_that_are_no_common_ones_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"0\.4 m and 0\.5 m"):
        changed_cells(drive(count=1), drive(count=1, voxel=0.5))


def test_an_empty_drive_and_a_wish_to_stop() -> None:
    empty = OccupancyMapper(VOXEL, origin=ORIGIN).evidence()
    assert changed_cells(empty, drive()).changes == ()
    assert changed_cells(drive(), empty).changes == ()
    with asking(lambda: True, "stopped"), pytest.raises(InterruptedRunError, match="stopped"):
        changed_cells(drive(), drive())


def test_measures_of_a_thing() -> None:
    """A staircase of cells: 10 along the diagonal, 2 high."""
    k = np.arange(10)
    cells = np.concatenate([np.column_stack([k, k, np.full(10, z)]) for z in (3, 4)])
    thing = MapChange("appeared", cells, 0.5)
    length, width = thing.extent
    assert (thing.base, thing.height, thing.volume) == (1.5, 1.0, 2.5)
    assert length == pytest.approx(10 * np.sqrt(2) * 0.5)
    assert width == pytest.approx(np.sqrt(2) * 0.5)
    x, y = thing.outline.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    # Half cells are missing at both ends of the diagonal strip.
    assert area == pytest.approx(length * width - 0.25)


def test_sums_know_no_order_and_keys_no_mapper() -> None:
    near, far = np.array([[2.1, 0.1, 0.1]], np.float32), np.array([[4.1, 0.1, 0.1]], np.float32)
    found = []
    for clouds in ([near] * 9 + [far] * 9, [far] * 9 + [near] * 9):
        mapper = OccupancyMapper(VOXEL, 0.5, 30.0, origin=ORIGIN)
        for cloud in clouds:
            mapper.add(cloud, np.eye(4))
        found.append(mapper.evidence())
    a, b = found
    assert np.array_equal(a.keys, b.keys)
    assert np.array_equal(a.sums, b.sums)
    assert not np.array_equal(a.log_odds, b.log_odds)
    assert 9 * (85 - 41) in a.sums.tolist()


def plate(low: tuple[float, float, float], high: tuple[float, float, float]) -> Floats:
    """Points 0.1 m apart between two corners, m."""
    axes = [np.arange(a, b + 1e-9, 0.1) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes), -1).reshape(-1, 3)


WALL, FLOOR = plate((-9, 10.1, -2.3), (9, 10.1, 2.5)), plate((-9, 1, -2.6), (9, 10, -2.6))
FRONT = plate((-1, 5.1, -1.1), (1, 5.1, 0.3))


def test_a_finished_map_tells_what_is_gone_and_what_is_not_in_it() -> None:
    same = drive()
    assert differences(same, np.concatenate([WALL, FLOOR])) == ()
    cloud = np.concatenate([WALL, FLOOR, FRONT])
    (gone,) = differences(same, cloud)
    assert gone.kind == "vanished"
    assert np.array_equal(points_in(cloud, [gone], same), np.arange(len(cloud)) >= len(WALL) + len(FLOOR))
    boxed = drive(box=True)
    (new,) = differences(boxed, np.concatenate([WALL, FLOOR]))
    assert new.kind == "appeared"
    assert (new.cells.min(0) == np.floor(BOX[0] / VOXEL)).all()
    # Where the map has nothing at all it does not say that there was nothing.
    assert differences(boxed, WALL) == ()
    assert points_in(cloud, [], boxed).sum() == 0


def test_what_any_beam_met_is_not_gone() -> None:
    """As foliage, which most beams pass: the cells are free in the end."""
    found = drive(box=lambda k: k == 8)
    free = found.log_odds <= MODEL[2]
    assert (free & found.has_hits).sum() > 10
    assert differences(found, np.concatenate([WALL, FLOOR, FRONT])) == ()

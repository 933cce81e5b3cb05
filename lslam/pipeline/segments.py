"""Scans that are lost: segments of a run, placed as sessions into one frame by place recognition, and alerts of the monitor."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import groupby

import numpy as np

from lslam.backend.keyframes.store import KeyframeStore, PartOfStore
from lslam.backend.localization.sessions import Chain, Session, Vicinity, locate_session
from lslam.backend.loops.detector import LEAST_REACH
from lslam.backend.loops.verify import is_elsewhere
from lslam.core.arrays import Floats, Longs
from lslam.core.config import Config
from lslam.core.geometry import noise, se3
from lslam.core.types.scan_result import MOST_ACCELERATION_M_S2, MotionCheck, ScanResult, motion_apart
from lslam.core.types.trajectory import Keyframe, Segment
from lslam.odometry.integrity.alerts import LARGE, Alert, alerts, open_throughout, stamp_faults
from lslam.pipeline.manifest import Manifest

log = logging.getLogger("lslam")

MAX_SENTENCES = 6


@dataclass(frozen=True)
class _Part:
    """A segment, and its session of scans and keyframes; None if its map failed to initialise."""

    segment: Segment
    results: list[ScanResult]
    session: Session | None


def join_segments(
    results: list[ScanResult], store: KeyframeStore, config: Config, manifest: Manifest, should_stop: Callable[[], bool]
) -> list[ScanResult]:
    """Results in as few frames as possible, frame 0 with most scans; keyframes of that frame stay in the store.

    The manifest lists the segments. A run of one segment is unchanged. On a stop the search ends.
    """
    first = next((k for k, r in enumerate(results) if r.status == "ok"), 0)
    if not first and not results[-1].segment:
        return results
    # What was recorded before the first registered scan has no place in its frame.
    runs = groupby(range(len(results)), lambda k: results[k].segment if k >= first else -1)
    parts = [_part([results[k] for k in run], n, store, config) for n, (_, run) in enumerate(runs)]
    frames: list[list[_Part]] = []
    with manifest.time("segments_s"):
        for part in parts:
            _place(part, frames, config, should_stop)
    frames.sort(key=lambda frame: -sum(part.segment.registered for part in frame))
    for number, frame in enumerate(frames):
        frame[:] = [replace(part, segment=replace(part.segment, frame=number)) for part in frame]
    # What does not fit the frame of most scans may have come first, when nothing was there to be searched.
    unfit = next((part.segment.reason for part in frames[0] if part.segment.reason), "")
    frames[1:] = [
        [replace(p, segment=replace(p.segment, reason=p.segment.reason or p.segment.tied_by or unfit)) for p in frame]
        for frame in frames[1:]
    ]
    ordered = sorted((part for frame in frames for part in frame), key=lambda part: part.segment.number)
    final = {part.segment.number: part.results for part in ordered} | _chain(frames[0], store, config)
    manifest.segments = [asdict(part.segment) for part in ordered]
    sentences = [sentence for part in ordered if (sentence := _sentence(part.segment))]
    _report(sentences, manifest, "segments: see segments in manifest.json")
    # Where a frame of its own lies, nobody knows.
    return [
        replace(r, frame=part.segment.frame, may_be_elsewhere=part.segment.frame > 0)
        for part in ordered
        for r in final[part.segment.number]
    ]


def checks_within(checks: list[MotionCheck], results: list[ScanResult]) -> list[MotionCheck]:
    """Motion checks within one segment; between segments odometry claims no motion."""
    return [check for check in checks if results[check.first].segment == results[check.last].segment]


def _part(scans: list[ScanResult], number: int, store: KeyframeStore, config: Config) -> _Part:
    """A segment of scans with its session of keyframes; without a session if too few scans were registered."""
    scans = [replace(r, segment=number) for r in scans]
    registered = sum(r.status == "ok" for r in scans)
    segment = Segment(number, scans[0].index, scans[-1].index, len(scans), registered)
    stamps = {r.stamp_ns for r in scans}
    own = PartOfStore(store, [k.number for k in store.keyframes if k.stamp_ns in stamps])
    if registered <= config.registration.start_scans or not own.keyframes:
        return _Part(replace(segment, reason=f"given up, {registered} of {len(scans)} registered"), scans, None)
    return _Part(segment, scans, Session(f"segment {number}", own, own.keyframes, scans))


def _place(part: _Part, frames: list[list[_Part]], config: Config, should_stop: Callable[[], bool]) -> None:
    """Add the part to the first frame, the largest first, in which it is found; else begin a new frame."""
    reasons = []
    for frame in sorted(frames, key=lambda frame: -sum(other.segment.registered for other in frame)):
        targets = [other.session for other in frame if other.session is not None]
        if part.session is None or not targets:
            continue
        session, why = _placement(part.session, targets, config, should_stop)
        if session is not None:
            frame.append(replace(part, session=session, segment=replace(part.segment, tied_by=why)))
            return
        reasons.append(why)
    frames.append([replace(part, segment=replace(part.segment, reason=part.segment.reason or "; ".join(reasons)))])


def _placement(
    session: Session, others: Sequence[Session], config: Config, should_stop: Callable[[], bool]
) -> tuple[Session | None, str]:
    """The session placed among the others, and the evidence in words; None, and the reason, if it is not found.

    If no second keyframe of it agrees, the last keyframes before it must.
    """
    near = _vicinity(others[-1], session)
    placed, reason = locate_session(session, others, config, should_stop, near)
    if placed is None or placed.start is None:
        return None, reason
    start = placed.start
    evidence = f"place search: {start.votes} of {start.tried} keyframes tried agree"
    if start.has_agreement:
        return placed, evidence
    if start.has_majority and _is_found_from_before(placed, others[-1], near.reach, config, should_stop):
        return placed, f"{evidence}, and the last ones before it"
    return None, "it is too short for two of its keyframes to agree on a place, and those before it are not found there"


def _is_found_from_before(
    session: Session, before: Session, reach: float, config: Config, should_stop: Callable[[], bool]
) -> bool:
    """Whether the last keyframes `before` a placed session are located in its map, too, near where the placement puts them.

    They must also have the majority of votes. reach : search radius, m
    """
    last = PartOfStore(before.store, range(len(before.keyframes))[-config.keyframes.submap_size :])
    own = last.keyframes[0]
    place = before.T_town_session @ own.T_world_lidar
    back, _ = locate_session(
        replace(before, store=last, keyframes=last.keyframes),
        [session],
        config,
        should_stop,
        Vicinity(place[:3, 3], reach),
    )
    if back is None or back.start is None or not back.start.has_majority:
        return False
    return not is_elsewhere(place, back.T_town_session @ own.T_world_lidar)


def _vicinity(before: Session, session: Session) -> Vicinity:
    """Region that the sensor may have reached since the last registered scan, by its speed there and possible acceleration."""
    (a, b), first = [r for r in before.results if r.status == "ok"][-2:], session.keyframes[0]
    seconds = max(1e-9 * (first.stamp_ns - b.stamp_ns), 0.0)
    start, end = (before.T_town_session @ r.T_world_lidar for r in (a, b))
    steps = 1e9 * seconds / max(b.stamp_ns - a.stamp_ns, 1)
    reach = 0.5 * MOST_ACCELERATION_M_S2 * seconds**2
    return Vicinity(end[:3, 3] + steps * (end[:3, 3] - start[:3, 3]), max(reach, LEAST_REACH))


def _chain(frame: Sequence[_Part], store: KeyframeStore, config: Config) -> dict[int, list[ScanResult]]:
    """Scans of the segments of a frame as one drive, by segment; only their keyframes stay in the store."""
    sessions = [part.session for part in frame if part.session is not None]
    if not sessions:
        return {}
    drive, keyframes_now, out = Chain(sessions, config), list[Keyframe](), {}
    keyframes = drive.keyframes()
    for n, session in enumerate(sessions):
        part = keyframes[drive.part(n)]
        first, T = part[0], session.T_town_session
        # What the first scan of the segment knows of its own map is small beside the tie.
        base = np.zeros((6, 6)) if n == 0 or first.covariance is None else first.covariance
        out[session.results[0].segment] = [_move(r, T, first.T_world_lidar[:3, 3], base) for r in session.results]
        assert isinstance(session.store, PartOfStore)
        if n:
            last = sessions[n - 1]
            out[last.results[0].segment] = _bridge(out[last.results[0].segment], last.T_town_session, session)
        of_scan = {r.stamp_ns: r for r in out[session.results[0].segment]}
        for own, now in zip(session.store.whole, part, strict=True):
            moved = of_scan[own.stamp_ns]
            keyframes_now.append(
                replace(own, T_world_lidar=moved.T_world_lidar, covariance=moved.covariance, distance=now.distance)
            )
    store.keep(keyframes_now)
    store.save()
    return out


def _bridge(results: list[ScanResult], T: Floats, following: Session) -> list[ScanResult]:
    """Results with the scans after the last registered one interpolated between both segments.

    T (4, 4) places this segment. The next one began at the prior of its first scan, so its placement shows the error of the
    priors over the gap, which is distributed over time.
    """
    last = max(k for k, r in enumerate(results) if r.status == "ok")
    begin_ns, end_ns = results[last].stamp_ns, following.results[0].stamp_ns
    wrong = se3.inverse(T) @ following.T_town_session
    out = results[: last + 1]
    for result in results[last + 1 :]:
        prior = se3.inverse(T) @ result.T_world_lidar
        share = (result.stamp_ns - begin_ns) / (end_ns - begin_ns)
        step = share * se3.log(se3.relative(prior, wrong @ prior))
        out.append(replace(result, T_world_lidar=se3.normalise(result.T_world_lidar @ se3.exp(step))))
    return out


def _move(result: ScanResult, T: Floats, origin: Floats, base: Floats) -> ScanResult:
    """Result in the world reached by T (4, 4), with its covariance added to that of the segment's `origin` (3,), m."""
    moved = result.in_world(T)

    def transport(own: Floats | None) -> Floats | None:
        step = moved.T_world_lidar[:3, 3] - origin
        return None if own is None else np.asarray(own + noise.transport(base, step))

    return replace(moved, covariance=transport(moved.covariance), points_covariance=transport(moved.points_covariance))


def _report(sentences: list[str], manifest: Manifest, others: str) -> None:
    """Add the first few sentences to the problems of the run, and one that counts the rest.

    others : end of that last sentence, which says where the rest are
    """
    if (more := len(sentences) - MAX_SENTENCES) > 0:
        sentences = [*sentences[:MAX_SENTENCES], f"and {more} more {others}"]
    for sentence in sentences:
        log.warning("%s", sentence)
    manifest.problems += sentences


def _sentence(segment: Segment) -> str:
    """Sentence about a segment in a frame of its own, or connected after a loss; empty for others."""
    what = f"{segment.span}, segment {segment.number}"
    if segment.frame:
        return f"{what}: not tied to the trajectory, in frame {segment.frame}, of its own: {segment.reason}"
    if segment.tied_by:
        return f"tracking was lost before scan {segment.first}; {what}: tied to those before by {segment.tied_by}"
    return ""


def raise_alerts(
    results: list[ScanResult], checks: list[MotionCheck], manifest: Manifest, are_scans_alone: bool = True
) -> list[ScanResult]:
    """Results with the scans that the integrity monitor contradicts marked lost; the manifest gets a problem for each stretch.

    are_scans_alone : whether nothing else, as wheels, tells the speed; an IMU tells its changes alone
    """
    positions, stamps_ns, frames = _positions(results)
    stretches = alerts(checks, positions, stamps_ns, frames)
    if are_scans_alone and not stretches:
        stretches = open_throughout(checks)
    _check_stamps(results, positions, stamps_ns)
    manifest.integrity = {
        "checks": len(checks),
        "conclusive": sum(check.is_conclusive for check in checks),
        "alerts": len(stretches),
    }
    return _mark(results, stretches, manifest, "")


def raise_final_alerts(
    results: list[ScanResult], checks: list[MotionCheck], manifest: Manifest, cause: str
) -> list[ScanResult]:
    """Results after `cause`, with scans marked lost that only the final poses contradict.

    The monitor's measurements between scans are compared with the motion of the final poses.
    """
    stretches = alerts([_of_final_poses(check, results) for check in checks], *_positions(results))
    new = [
        alert for alert in stretches if not all(results[k].may_be_elsewhere for k in range(alert.first, alert.last + 1))
    ]
    manifest.integrity["final_alerts"] = len(new)
    return _mark(results, new, manifest, f"after {cause}, ")


def _of_final_poses(check: MotionCheck, results: list[ScanResult]) -> MotionCheck:
    """Motion check with the motion of the final poses."""
    motion = se3.relative(results[check.first].T_world_lidar, results[check.last].T_world_lidar)
    # How many points lie on surfaces at a pose that was moved far was not counted: as good as none.
    is_far = bool(np.any(np.abs(motion_apart(check.claimed_motion, motion)) > LARGE))
    return replace(check, claimed_motion=motion, claimed_agreement=0.0 if is_far else check.claimed_agreement)


def _check_stamps(results: list[ScanResult], positions: Floats, stamps_ns: Longs) -> None:
    """Warn of wrong stamps: `positions` (N, 3) follow each other steadily, `stamps_ns` (N,) do not. No scan is lost."""
    at, off_s = stamp_faults(positions, stamps_ns)
    if at:
        log.warning(
            "the stamps of %d of %d scans, the first is scan %d, are wrong by up to %.0f ms: at the period of the sensor the "
            "poses follow each other steadily, by their stamps they jump; it spoils speeds, deskewing and the use of an IMU",
            len(at),
            len(results),
            results[at[0]].index,
            1e3 * off_s,
        )


def _positions(results: list[ScanResult]) -> tuple[Floats, Longs, Longs]:
    """Positions (N, 3), m, stamps (N,), ns, and numbers of the frame (N,) of the results."""
    positions = np.stack([r.at_stamp.T_world_lidar[:3, 3] for r in results])
    return positions, np.array([r.stamp_ns for r in results]), np.array([r.frame for r in results], np.int64)


def _mark(results: list[ScanResult], stretches: list[Alert], manifest: Manifest, after: str) -> list[ScanResult]:
    """Results with the scans of the alerts marked as possibly lost; problems of the manifest begin with `after`."""
    sentences = []
    for alert in stretches:
        first, last = results[alert.first].index, results[alert.last].index
        scans = f"scan {first}" if first == last else f"scans {first} to {last}"
        sentences.append(f"{after}{scans} may be lost: {alert.why}")
    _report(sentences, manifest, "stretches of scans that may be lost: see scans.csv")
    lost = {k for alert in stretches for k in range(alert.first, alert.last + 1)}
    return [replace(r, may_be_elsewhere=True) if k in lost else r for k, r in enumerate(results)]

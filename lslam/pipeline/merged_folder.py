"""Output of merging runs: a trajectory per session, the graph, a map, a page, and a manifest."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lslam.backend.graph.factors import regularise
from lslam.backend.localization.sessions import Session
from lslam.core import __version__
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.errors import InputError, InterruptedRunError, LslamError, UsageError
from lslam.core.geometry import se3
from lslam.core.types.gnss import Georeference
from lslam.core.types.sequence import Sequence as Recording
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.io.formats.trajectory_lines import write_g2o, write_tum
from lslam.odometry.frontend.checkpoints import Checkpoints
from lslam.odometry.frontend.register_scans import to_trajectory
from lslam.pipeline.back_end_pass import describe
from lslam.pipeline.map_files import BuiltMap, MapNote, write_map
from lslam.pipeline.map_pass import (
    INTERRUPTED,
    MapMaker,
    attribute_notes,
    posed_scans,
    with_attributes,
)
from lslam.pipeline.merge_runs import Merge, expand_folders, merge_runs
from lslam.pipeline.outputs import config_text, write_loops
from lslam.pipeline.rebuild import EarlierRun, is_missing, open_scans
from lslam.pipeline.refinement import PosedDrive, refine
from lslam.pipeline.run_folder import CHECKPOINT, SESSIONS, RunFolder
from lslam.pipeline.watch import Watch
from lslam.reports.compare_html import SessionView, write_merge_page

log = logging.getLogger("lslam")
SCHEMA = 1
COLUMNS = "session,run,scans,keyframes,first_keyframe,start_votes,start_tried,loops_between,ate_before_m,ate_after_m"


@dataclass(frozen=True)
class SessionRow:
    """One session of a merged folder, for tables and JSON. `ate` : se3, m, alone and merged; None without truth."""

    name: str
    run: str
    scans: int
    keyframes: int
    first_keyframe: int
    votes: int
    tried: int
    loops_between: int
    ate: tuple[float, float] | None
    T_town_session: list[list[float]]


def merge_into(
    folders: Sequence[Path],
    out: Path,
    config: Config,
    watch: Watch,
    *,
    overwrite: bool = False,
    resume: bool = False,
    command: str = "",
) -> dict[str, Any]:
    """Merge runs into the folder `out`. Returns its manifest.

    Raises as `merge_runs`, OutputExistsError and OutputError as `RunFolder`, UsageError for `map.colour`.
    """
    if config.map.colour:
        raise UsageError("map.colour: merged maps have no colours; those of their runs have, by lslam map RUN --colour")
    folders = expand_folders(folders)

    def on_stage(stage: str) -> None:
        log.info("merge: %s", stage)
        watch.on_start(stage, 0)

    with RunFolder(out, overwrite or resume, resume) as folder:
        manifest: dict[str, Any] = {"schema": SCHEMA, "kind": "merge", "lslam": __version__, "command": command}
        folder.write_text("config.toml", config_text(config))
        folder.write_manifest({**manifest, "status": "running"})
        checkpoints = Checkpoints(folder.path / CHECKPOINT, "merge", config.odometry.checkpoint_s)
        try:
            merge = merge_runs(folders, config, watch.should_stop, on_stage, checkpoints)
            manifest |= _fill(folder, merge, config, watch)
        except BaseException as error:
            status = "interrupted" if isinstance(error, InterruptedRunError) else "failed"
            folder.write_failure({**manifest, "status": status, "why": str(error) or type(error).__name__})
            raise
        folder.write_manifest(manifest)
        folder.drop_checkpoint()
        log.info("%s; results in %s", manifest["status"], folder.path)
    return manifest


def _fill(folder: RunFolder, merge: Merge, config: Config, watch: Watch) -> dict[str, Any]:
    """Write everything but the manifest, and return the manifest's content."""
    problems = [f"{one.name} is left out: {one.why}" for one in merge.left_out]
    recordings = [_recording(run, config, problems) for run in merge.runs]
    merge, facts = _refine(merge, recordings, config, watch)
    trajectories = [to_trajectory(results, "merge") for results in merge.results]
    (folder.path / SESSIONS).mkdir(exist_ok=True)
    world = f"that of {merge.sessions[0].name}"
    for session, trajectory in zip(merge.sessions, trajectories, strict=True):
        comment = f"lslam {__version__}, merged: T_world_lidar of {session.name}\nworld: {world}"
        write_tum(folder.path / SESSIONS / f"{session.name}.tum", trajectory, comment=comment)
    rows = _rows(merge, recordings, trajectories, config)
    folder.write_text("sessions.csv", "\n".join([COLUMNS, *map(_line, rows)]) + "\n")
    numbers = [s.results[k.scan].index for s in merge.sessions for k in s.keyframes]
    write_loops(folder.path / "loops.csv", merge.candidates, numbers)
    accepted = [c.constraint for c in merge.candidates if c.is_accepted and c.constraint is not None]
    constraints = [replace(c, covariance=regularise(c.covariance)) for c in (*merge.chain.odometry(), *accepted)]
    write_g2o(folder.path / "graph.g2o", merge.solution.poses, constraints)
    georeference = _georeference(merge)
    about: dict[str, Any] = {"refinement": facts} if facts else {}
    built = None
    if config.map.write:
        built = _map(recordings, merge, config, watch, folder.path)
        note = MapNote(
            ", ".join(s.name for s in merge.sessions), config.map.voxel, built.steps, world, built.attributes
        )
        write_map(folder.path / f"map.{config.map.format}", built.cloud, note, georeference)
        about["map_points"] = len(built.cloud)
    watch.on_start("report", 0)
    views, shown = _views(merge, trajectories), (None, None) if built is None else (built.view, built.sample)
    write_merge_page(folder.path / "report.html", views, [vars(row) for row in rows], problems, _ties(merge), *shown)
    for problem in problems:
        log.warning("%s", problem)
    return about | {
        "status": "degraded" if problems else "done",
        "problems": problems,
        "frames": {"world": world},
        "sessions": [vars(row) for row in rows],
        "left_out": [vars(one) for one in merge.left_out],
        "graph": {
            "keyframes": len(merge.chain),
            "loops": len(accepted),
            "drift_factor": round(merge.solution.drift, 4),
            "rounds": merge.solution.rounds,
        },
        **({} if georeference is None else {"georeference": describe(georeference)}),
    }


def _recording(run: EarlierRun, config: Config, problems: list[str]) -> Recording | None:
    """Raw scans of a run with the attributes that the map stores; None, with a problem, where they are missing."""
    try:
        scans = open_scans(replace(run, config=run.config.model_copy(update={"map": config.map})))
        return with_attributes(scans, config) if config.map.write else scans
    except InputError as error:
        why = f"cannot be read at {run.sequence_path}" if is_missing(run) else f"cannot be used ({error})"
        problems.append(f"the raw scans of {run.folder.name} {why}: they are missing in the map")
        return None


def _config_of(session: Session, config: Config) -> Config:
    """The configuration for the raw scans of a session: its run's sensor, mounting and vehicle."""
    return config.model_copy(update={"preprocess": session.preprocess})


def _refine(
    merge: Merge, recordings: Sequence[Recording | None], config: Config, watch: Watch
) -> tuple[Merge, dict[str, Any]]:
    """The merge with refined poses where the configuration asks for them, and what the manifest says of it."""
    if not config.graph.refine:
        return merge, {}
    drives = [
        PosedDrive(recording, [result.at_stamp for result in results], _config_of(session, config))
        for recording, results, session in zip(recordings, merge.results, merge.sessions, strict=True)
        if recording is not None
    ]
    if len(drives) < len(recordings):
        return merge, {"is_taken": False, "why": "the raw scans of a session are missing"}
    watch.on_start("refinement", sum(map(len, merge.results)))
    facts, results = refine(drives, watch)
    return (merge if results is None else replace(merge, results=results)), facts


def _rows(
    merge: Merge, recordings: Sequence[Recording | None], trajectories: Sequence[Trajectory], config: Config
) -> list[SessionRow]:
    """One row per session for the manifest and the page: counts, votes, loops with others, ATE, and its transform."""
    rows = []
    for n, (run, session, recording, trajectory) in enumerate(
        zip(merge.runs, merge.sessions, recordings, trajectories, strict=True)
    ):
        part = merge.chain.part(n)
        start = session.start
        T = merge.solution.poses[part][0] @ se3.inverse(session.keyframes[0].T_world_lidar)
        rows.append(
            SessionRow(
                session.name,
                str(run.folder.resolve()),
                len(session.results),
                len(session.keyframes),
                part.start,
                0 if start is None else start.votes,
                0 if start is None else start.tried,
                merge.between(n),
                _ate(run.trajectory, trajectory, recording, config),
                se3.normalise(T).tolist(),
            )
        )
    return rows


def _ate(
    before: Trajectory, after: Trajectory, recording: Recording | None, config: Config
) -> tuple[float, float] | None:
    """ATE, se3, m, of a session alone and merged; None without ground truth, or if one cannot be evaluated."""
    if recording is None or recording.ground_truth is None:
        return None
    errors = []
    for trajectory in (before, after):
        try:
            ate = evaluate(trajectory, recording.ground_truth, config.eval, calibration=recording.calibration).ate[
                "se3"
            ]
        except (LslamError, KeyError):
            return None
        if ate.translation is None:
            return None
        errors.append(float(ate.translation.rmse))
    return errors[0], errors[1]


def _line(row: SessionRow) -> str:
    """Line of sessions.csv."""
    before, after = ("", "") if row.ate is None else (f"{row.ate[0]:.5f}", f"{row.ate[1]:.5f}")
    run = f'"{row.run}"' if "," in row.run else row.run
    values = (row.name, run, row.scans, row.keyframes, row.first_keyframe, row.votes, row.tried, row.loops_between)
    return ",".join([*map(str, values), before, after])


def _georeference(merge: Merge) -> Georeference | None:
    """Georeference of the common world, by the first session that has one; None without."""
    for n, run in enumerate(merge.runs):
        if run.georeference is not None:
            first = merge.sessions[n].keyframes[0].T_world_lidar
            T_town_session = merge.solution.poses[merge.chain.part(n)][0] @ se3.inverse(first)
            return replace(run.georeference, T_enu_world=run.georeference.T_enu_world @ se3.inverse(T_town_session))
    return None


def _map(recordings: Sequence[Recording | None], merge: Merge, config: Config, watch: Watch, spool: Path) -> BuiltMap:
    """Map of the scans of all sessions but those without a recording (None)."""
    results = merge.results
    watch.on_start(
        "map", sum(len(r) for r, recording in zip(results, recordings, strict=True) if recording is not None)
    )
    maker, number = MapMaker(config.map, spool, up=merge.sessions[0].up), 0
    for session, recording, poses in zip(merge.sessions, recordings, results, strict=True):
        if recording is None:
            continue
        for k, scan in posed_scans(recording, poses, _config_of(session, config), watch, INTERRUPTED):
            if scan is not None:
                maker.add(number + k, scan)
        number += len(poses)
    first_ns = min((poses[0].stamp_ns for poses in results if poses), default=0)
    return replace(maker.finish(), attributes=attribute_notes(config.map, first_ns))


def _views(merge: Merge, trajectories: Sequence[Trajectory]) -> list[SessionView]:
    """Positions of each session before and after the graph, in the common world, for the page."""
    return [
        SessionView(
            session.name,
            (session.T_town_session @ np.stack([r.T_world_lidar for r in session.results]))[:, :3, 3],
            after.positions,
            np.array([r.index for r in session.results]),
        )
        for session, after in zip(merge.sessions, trajectories, strict=True)
    ]


def _ties(merge: Merge) -> Floats:
    """(K, 2, 3) m, both ends of each loop between two sessions."""
    session_of = merge.chain.session_of
    ends = [(c.a, c.b) for c in merge.candidates if c.is_accepted and session_of(c.a) != session_of(c.b)]
    return np.asarray(merge.solution.poses[np.array(ends, int).reshape(-1, 2)][..., :3, 3])

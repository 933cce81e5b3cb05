"""`lslam merge`: several runs of one place made one."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from lslam.cli import options
from lslam.cli.console import setup_logging, show, show_json
from lslam.core.stopping import handle_signals


@click.command(
    epilog="\b\nExamples: lslam merge runs/monday runs/tuesday --out runs/town\n"
    "          lslam merge runs/town runs/friday --out runs/town2 --format laz"
)
@click.argument("runs", nargs=-1, required=True, metavar="RUN RUN...", type=click.Path(path_type=Path))
@options.path("--out", "DIR", "Folder to write [default: runs/merged-TIME].")
@options.real("--voxel", "M", "Edge of a voxel of the map.")
@options.option("--format", "file_format", "NAME", "Of the map: ply, pcd, las or laz [default: ply].")
@options.flag("--no-map", "Poses only.")
@options.refine
@options.threads
@options.flag("--resume", "Go on with an interrupted merge; needs its --out.")
@options.flag("--overwrite", "Replace an earlier result in the folder.")
@options.configuration
@options.as_json
@options.verbosity
def command(runs: tuple[Path, ...], **given: Any) -> None:
    """Merge runs of one place: trajectories in one frame, one pose graph with loops between all, one map.

    The first run gives the frame. RUN may be the folder of an earlier merge, whose runs then stand in its place. A run that
    cannot be tied to the others is left out and named; exit 1 when none can.
    """
    setup_logging(given["verbose"], given["quiet"])
    options.check_resume(given, "merge")
    options.require_there(*runs)
    from lslam.core.config import load_config
    from lslam.pipeline.merged_folder import merge_into
    from lslam.pipeline.run_folder import check_target

    out = given["out"] or Path("runs") / time.strftime("merged-%Y%m%d-%H%M%S")
    if not given["resume"]:
        check_target(out, given["overwrite"])
    flags = {
        "map.voxel": given["voxel"],
        "map.format": given["file_format"],
        "input.threads": given["threads"],
        "map.write": "false" if given["no_map"] else None,
        "graph.refine": options.true_if(given["refine"]),
    }
    config = load_config(given["config_file"], options.settings_of(flags, given["settings"]))
    from lslam.cli.one_run import watch_of

    with handle_signals() as stop, ExitStack() as stack:
        watch = watch_of(stack, stop, lambda outcome: None)
        stop.is_gentle = True
        folders = {name: given[name] for name in ("overwrite", "resume")}
        manifest = merge_into(runs, out, config, watch, command=options.command_line(), **folders)
    if given["as_json"]:
        show_json({"folder": str(out), "manifest": manifest})
    else:
        show(_summary(out, manifest))


def _summary(out: Path, manifest: dict[str, Any]) -> str:
    """Summary of a merge: sessions, loops between them, errors before and after where there is ground truth."""
    from lslam.core.printable import count_of, metres
    from lslam.reports.text import refined_rows

    lines = [f"merged, {count_of(len(manifest['sessions']), 'session')}", f"  {'status':<12} {manifest['status']}"]
    lines += [f"  {'':<12} {problem}" for problem in manifest["problems"]]
    for one in manifest["sessions"]:
        place = (
            f"found by {one['votes']} of {count_of(one['tried'], 'keyframe')} tried"
            if one["tried"]
            else "gives the world"
        )
        text = f"{count_of(one['scans'], 'scan')}, {place}, {count_of(one['loops_between'], 'loop')} with others"
        if one["ate"] is not None:
            text += f"; ATE se3 {metres(one['ate'][0])} m alone, {metres(one['ate'][1])} m merged"
        lines.append(f"  {one['name']:<12} {text}")
    graph = manifest["graph"]
    lines.append(f"  {'graph':<12} {graph['keyframes']} keyframes, {count_of(graph['loops'], 'loop')} in all")
    lines += [f"  {name:<12} {text}" for name, text in refined_rows(manifest.get("refinement", {}))]
    lines += [f"  {name:<12} {out / name}" for name in ("sessions", "report.html") if (out / name).exists()]
    return "\n".join(lines) + "\n"

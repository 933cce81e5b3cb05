"""`lslam methods`: the names that `--method` takes."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import click

from lslam.cli import options
from lslam.cli.console import show_json

if TYPE_CHECKING:
    from lslam.odometry import ListedMethod

BASELINES, FOREIGN = "Baselines, of other packages", "Registered by other packages"


@click.command(epilog="Example: lslam methods")
@options.as_json
def command(as_json: bool) -> None:
    """List the odometry methods. `lslam config presets` lists whole configurations, those of the theses among them."""
    from lslam.odometry import listed_methods

    methods = listed_methods()
    if as_json:
        show_json({"methods": [asdict(method) for method in methods]}, indent=1)
        return
    width = max(len(method.name) for method in methods)
    groups: dict[str, list[ListedMethod]] = {}
    for method in methods:
        groups.setdefault(_group(method), []).append(method)
    for k, (title, group) in enumerate(groups.items()):
        click.echo(f"{chr(10) if k else ''}{title}:")
        for method in group:
            click.echo(f"  {method.name:<{width}}  {method.summary}")


def _group(method: ListedMethod) -> str:
    """Title of the group in which a method is listed."""
    from lslam.odometry import METHODS, Coupling

    if method.name not in METHODS:
        return FOREIGN
    if method.is_baseline:
        return BASELINES
    return {
        Coupling.LOOSE: "LiDAR alone, or loosely coupled with an IMU by --imu",
        Coupling.TIGHT: "Tightly coupled: they need an IMU",
        Coupling.NONE: "Without an IMU",
    }[method.coupling]

"""`lslam methods`: what `--method` takes."""

from __future__ import annotations

import click


@click.command(epilog="Example: lslam methods")
def command() -> None:
    """List the odometry methods. `lslam config presets` lists whole configurations, those of the theses among them."""
    from lslam.odometry import known_methods

    methods = known_methods()
    width = max(len(name) for name in methods)
    for name, summary in methods.items():
        click.echo(f"{name:<{width}}  {summary}")

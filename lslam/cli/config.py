"""`lslam config`: show or check a configuration."""

from __future__ import annotations

from pathlib import Path

import click

from lslam.cli import options
from lslam.cli.console import show_rows


@click.group()
def command() -> None:
    """Show or check a configuration.

    \b
    Example: lslam config show > my.toml
             lslam config check my.toml
    """


@command.command(epilog="Example: lslam config show --preset thesis-icp --set map.voxel=0.1")
@options.preset
@options.configuration
@options.flag("--describe", "Explain each key in a comment.")
def show(config_file: Path | None, preset: str | None, settings: tuple[str, ...], describe: bool) -> None:
    """Print the resolved configuration as TOML."""
    from lslam.core.config import load_config, to_described_toml, to_toml
    from lslam.pipeline.check import check_config

    flags = {"odometry.preset": options.quote(preset)}
    config = load_config(config_file, options.settings_of(flags, settings))
    check_config(config)
    click.echo(to_described_toml(config) if describe else to_toml(config), nl=False)


@command.command(epilog="Example: lslam config presets")
def presets() -> None:
    """List the presets that `--preset` takes."""
    from lslam.core.config.config import known_presets

    summaries = known_presets()
    show_rows(summaries.items(), max(map(len, summaries)) + 1)


@command.command(epilog="Example: lslam config check my.toml")
@click.argument("file", type=click.Path(path_type=Path))
def check(file: Path) -> None:
    """Check a configuration file: exit 0 when every key, value and name in it is known."""
    from lslam.core.config import load_config
    from lslam.pipeline.check import check_config

    check_config(load_config(file, environ={}))
    click.echo(f"{file}: ok")

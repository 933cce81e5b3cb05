"""`lslam completion`: the script that makes a shell complete lslam's commands and options."""

from __future__ import annotations

import click


@click.command(epilog='Example: eval "$(lslam completion bash)"')
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def command(shell: str) -> None:
    """Print the completion script of SHELL."""
    from click.shell_completion import get_completion_class

    from lslam.cli.main import cli

    complete = get_completion_class(shell)
    assert complete is not None
    click.echo(complete(cli, {}, "lslam", "_LSLAM_COMPLETE").source())

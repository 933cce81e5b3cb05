"""The `lslam` command: imports a sub-command's module when it is called, and turns errors into exit codes."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from itertools import pairwise
from typing import Any, NoReturn

import click

from lslam.core import __version__
from lslam.core.errors import LslamError, cause, nearest, sentence
from lslam.core.machine import pin_blas
from lslam.core.stopping import handle_signals, is_interrupt, is_too_late

# name -> one line for --help; the module lslam.cli.<name> has the click command `command`.
COMMANDS = {
    "demo": "Simulate a small drive, run it and open its page, in a minute.",
    "run": "Estimate a trajectory and build a map from a recorded sequence.",
    "localize": "Locate a drive in a map that exists.",
    "graph": "Optimise a run's pose graph again, with loops and control points that you know.",
    "merge": "Merge several runs of one place into one.",
    "eval": "Score estimated trajectories against ground truth.",
    "compare": "Compare methods on the same sequences.",
    "batch": "Make many runs, from a file or from lines of lslam run.",
    "sweep": "Study how results depend on parameters.",
    "simulate": "Simulate a drive with exact ground truth.",
    "convert": "Convert a sequence to a bag or KITTI's layout, or a trajectory to another format.",
    "deliver": "Make the folder that a surveyor hands over.",
    "osm": "Fetch buildings from OpenStreetMap, or show what is in an extract.",
    "info": "Show the contents and the faults of a sequence, or what this machine has.",
    "map": "Build a run's map anew with other settings, or score a map.",
    "plot": "Draw one figure of a run, for a paper.",
    "view": "Show a run in the browser, and correct its loops there.",
    "methods": "List the odometry methods.",
    "config": "Show or check a configuration.",
    "completion": "Print the completion script of a shell.",
}


class PipeContext(click.Context):
    """A context for which a closed pipe behind stdout (`lslam ... | head`) is no error; click exits with 1."""

    def __exit__(self, *error: Any) -> bool | None:
        """Exit as click does, but treat a closed pipe as success."""
        super().__exit__(*error)
        if not isinstance(error[1], BrokenPipeError):
            return None
        from lslam.cli.console import leave_stdout

        leave_stdout()
        raise click.exceptions.Exit(0) from None


class LazyGroup(click.Group):
    """A group that imports a sub-command's module only when it is called, so that `--help` is instant."""

    context_class = PipeContext

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of the commands in the order of the table."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The sub-command, imported now; None for an unknown name."""
        if cmd_name in self.commands or cmd_name not in COMMANDS:
            return self.commands.get(cmd_name)
        command = import_module(f"lslam.cli.{cmd_name}").command
        assert isinstance(command, click.Command)
        return command

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """As click does, but the error about an unknown name suggests the nearest one."""
        if args and args[0] not in COMMANDS and not args[0].startswith("-"):
            raise click.UsageError(f"no command {args[0]!r}; {nearest(args[0], COMMANDS)}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands from the table, without importing their modules."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


def _print_version(ctx: click.Context, _: click.Parameter, wants_version: bool) -> None:
    """Print the versions of lslam and its libraries, and exit, if asked for by the option."""
    if not wants_version or ctx.resilient_parsing:
        return
    from lslam.cli.machine import library_versions

    click.echo(f"lslam {__version__}, Python {sys.version.split()[0]}")
    for name, version in library_versions().items():
        if version is not None:
            click.echo(f"  {name} {version}")
    ctx.exit()


@click.group(
    cls=LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="Example: lslam run sample_data --out runs/first",
)
@click.option(
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_version,
    help="Show the versions of lslam and its libraries.",
)
def cli() -> None:
    """Batch LiDAR SLAM: a recorded sequence goes in; a trajectory, a map and an honest report come out."""


@cli.command("completion", epilog='Example: eval "$(lslam completion bash)"')
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def print_completion(shell: str) -> None:
    """Print the completion script of SHELL."""
    from click.shell_completion import get_completion_class

    complete = get_completion_class(shell)
    assert complete is not None
    click.echo(complete(cli, {}, "lslam", "_LSLAM_COMPLETE").source())


def main() -> NoReturn:
    """Entry point: results on stdout, one sentence per error on stderr, documented exit codes."""
    pin_blas()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # an ASCII terminal shows ? for ±, instead of an error after hours
    if "--progress=json" in sys.argv or ("--progress", "json") in pairwise(sys.argv):
        from lslam.cli.console import begin_events

        begin_events()  # before the options are read, of which one may be wrong
    try:
        # SIGTERM ends lslam as Ctrl-C does, with exit code 130 and without partly written files.
        with handle_signals(), _exit_codes():
            code = cli(standalone_mode=False)
            is_too_late()
        sys.exit(code if isinstance(code, int) else 0)
    finally:
        _leave_stderr()


def _leave_stderr() -> None:
    """Redirect stderr to the null device if its reader is gone: Python writes what is left at exit, and fails with code 120."""
    if sys.stderr is None:  # closed before Python began
        return
    try:
        sys.stderr.flush()
    except OSError:
        with suppress(OSError, ValueError):  # a stream without a descriptor
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


@contextmanager
def _exit_codes() -> Iterator[None]:
    """Turn an error of the block into one sentence on stderr and an exit code."""
    try:
        yield
    except LslamError as error:
        _fail(str(error), error.exit_code)
    except click.ClickException as error:
        _fail_usage(error)
    except (click.Abort, KeyboardInterrupt):
        _fail("interrupted", 130)
    except OSError as error:
        if error.filename is None:
            from lslam.cli.console import leave_stdout

            leave_stdout()  # the rest of the buffer would fail again at exit, with an exit code of Python
        _fail(f"{error.filename or 'standard output'} cannot be used: {cause(error)}", 3)
    except MemoryError:
        _fail("out of memory: use fewer points (preprocess.range_max) or larger voxels (map.voxel)", 1)
    except Exception as error:
        if is_interrupt(error):
            _fail("interrupted", 130)
        _report_mistake(error)


def _fail(message: str, code: int) -> NoReturn:
    """Print the error, or send it as an event, and exit with `code`."""
    is_too_late()
    message = sentence(message)
    from lslam.cli.console import events

    to = events()
    if to is not None:
        to.tell("error", text=message, exit_code=code)
    else:
        with suppress(OSError):  # the terminal may be closed
            click.echo(message if code == 130 else f"error: {message}", err=True)
    sys.exit(code)


def _fail_usage(error: click.ClickException) -> NoReturn:
    """Print an error of the command line and exit with code 2; without arguments, print the help."""
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show(file=sys.stderr)
        click.echo("\nNew here? `lslam demo` simulates a drive, runs it and opens its page, in a minute.", err=True)
        sys.exit(2)
    ctx = getattr(error, "ctx", None)
    command = _typed_command() if ctx is None else ctx.command_path
    _fail(f"{error.format_message().rstrip('.')}; see {command} --help", 2)


def _typed_command() -> str:
    """Command on the command line, with its sub-command: some errors of click do not say where they are raised."""
    command: click.Command = cli
    names = ["lslam"]
    for word in sys.argv[1:]:
        inner = command.get_command(click.Context(command), word) if isinstance(command, click.Group) else None
        if inner is None:
            break
        command = inner
        names.append(word)
    return " ".join(names)


def _report_mistake(error: Exception) -> NoReturn:
    """Report an error of lslam itself in one sentence, with the traceback in the debug log alone."""
    import logging

    logging.getLogger("lslam").debug("traceback", exc_info=error)
    _fail(f"lslam made a mistake ({type(error).__name__}: {error}): please report it with what -v shows", 1)

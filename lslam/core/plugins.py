"""Tables of names that other packages extend by entry point; nothing is looked up before a name of ours fails."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

from lslam.core.errors import InputError, UsageError, nearest

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


# name -> (module with `create`, one line for people)
Table = Mapping[str, tuple[str, str]]


def registered(group: str, own: Mapping[str, object]) -> dict[str, EntryPoint]:
    """What other packages register under `group`, by name; they cannot take the name of anything of our `own`.

    Of two packages with one name the first in the alphabet has it, whatever was installed last.
    """
    from importlib.metadata import entry_points  # imported late: as much work as the whole command line

    entries = sorted(
        entry_points(group=group), key=lambda entry: "" if entry.dist is None else entry.dist.name, reverse=True
    )
    return {entry.name: entry for entry in entries if entry.name not in own}


def known(group: str, own: Table) -> dict[str, str]:
    """Names and one-line summaries, those of other packages included; nothing is imported."""
    foreign = {name: f"from {entry.value}" for name, entry in registered(group, own).items()}
    return {name: summary for name, (_, summary) in own.items()} | foreign


def require(group: str, own: Table, name: str, what: str) -> None:
    """Raise UsageError with the nearest name when there is no `what` of this name; nothing is imported."""
    if name not in own and name not in (names := known(group, own)):
        raise UsageError(f"no {what} {name!r}; {nearest(name, names)}")


def factory(group: str, own: Table, name: str, what: str) -> Callable[..., Any]:
    """What makes the `what` of this name. Raises as `require` and `load`."""
    if name in own:
        made: Callable[..., Any] = import_module(own[name][0]).create
        return made
    require(group, own, name, what)
    return load(registered(group, own)[name], what)  # type: ignore[no-any-return]


def load(entry: EntryPoint, what: str) -> Any:
    """What the entry point names. Raises InputError naming the package when it is broken."""
    try:
        return entry.load()
    except Exception as error:
        package = "another package" if entry.dist is None else f"the package {entry.dist.name}"
        raise InputError(
            f"{what} {entry.name!r} of {package} cannot be loaded from {entry.value}: {type(error).__name__}: {error}; "
            "mend or uninstall it"
        ) from None

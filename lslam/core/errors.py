"""The error tree of lslam: every class carries the exit code a batch script can rely on.

0 done, 1 the run failed, 2 usage, configuration or an output that exists, 3 input missing or unreadable and output
unwritable, 4 done but a gate the user set failed, 130 interrupted.
"""

from __future__ import annotations

import contextlib
import difflib
import re
from collections.abc import Iterable, Iterator

# Nobody reads a word of so many characters; paths may have some hundreds.
_FLOOD = re.compile(r"\S{1000,}")


def sentence(text: str) -> str:
    r"""A text that is safe to print: control characters are escaped, and the middle of a long run of text is left out.

    >>> sentence("9" * 5000).count("9"), sentence("a\x1bb")
    (300, 'a\\x1bb')
    """
    said = "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
    return _FLOOD.sub(lambda word: f"{word[0][:200]}...{word[0][-100:]}", said)


class LslamError(Exception):
    """Base of all errors lslam raises on purpose: one clear sentence that names the file, the place and the way out."""

    exit_code = 1

    def __str__(self) -> str:
        """As `sentence`: it quotes what files hold."""
        return sentence(super().__str__())


class RunFailedError(LslamError):
    """The run produced no usable result (diverged, no scan registered)."""

    exit_code = 1


class GraphError(LslamError):
    """A pose graph that cannot be optimised: in pieces, singular, or not finite."""

    exit_code = 1


class UsageError(LslamError):
    """Wrong arguments, names or combinations."""

    exit_code = 2


class ConfigError(UsageError):
    """Unknown configuration key or a value out of range."""


class OutputExistsError(UsageError):
    """The output is there already, or another run is writing it."""


class InputError(LslamError):
    """Input that is missing, unreadable or contradicts itself."""

    exit_code = 3


class OutputError(LslamError):
    """Output that cannot be written: permissions, a full disk."""

    exit_code = 3


class StorageError(LslamError):
    """Object storage that does not answer or refuses: nothing is known of what lies there, and later it may be read."""

    exit_code = 3


class GateError(LslamError):
    """Everything was done, but a gate the user set failed."""

    exit_code = 4


class RunFinishedError(LslamError):
    """A run that shall go on has come to its end before: nothing was done."""

    exit_code = 0


class InterruptedRunError(LslamError):
    """SIGINT or SIGTERM ended the run; what was done is written."""

    exit_code = 130


def cause(error: BaseException) -> str:
    """The reason of an error for a sentence that already names the file: an OSError's text repeats errno and path.

    >>> cause(FileNotFoundError(2, "No such file or directory", "poses.txt"))
    'No such file or directory'
    >>> cause(ValueError("no number"))
    'no number'
    """
    return getattr(error, "strerror", None) or str(error)


@contextlib.contextmanager
def input_errors(place: object, *kinds: type[Exception], as_what: str = "") -> Iterator[None]:
    """Turn an OSError, or one of further `kinds`, inside the block into InputError: `place` cannot be read as `as_what`."""
    caught: tuple[type[Exception], ...] = (OSError, *kinds)
    try:
        yield
    except caught as error:
        how = f" as {as_what}" if as_what else ""
        raise InputError(f"{place} cannot be read{how}: {cause(error)}") from None


@contextlib.contextmanager
def output_errors(place: object) -> Iterator[None]:
    """Turn an OSError of the block into an OutputError: `place` cannot be written, and why."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{place} cannot be written: {cause(error)}") from None


def nearest(name: str, candidates: Iterable[str]) -> str:
    """Sentence fragment suggesting the known names nearest to `name`, or listing the known ones.

    >>> nearest("kis-icp", ["icp", "kiss-icp"])
    "did you mean 'kiss-icp'?"
    >>> nearest("gcip", ["icp", "gicp", "vgicp"])
    "did you mean 'gicp' or 'vgicp'?"
    >>> nearest("zzz", ["icp", "kiss-icp"])
    'known: icp, kiss-icp'
    """
    names = {known_name.lower(): known_name for known_name in candidates}
    close = difflib.get_close_matches(name.lower(), names, n=3, cutoff=0.5)
    if not close:
        return "known: " + ", ".join(names.values())
    best = _likeness(name, close[0])
    *others, last = [repr(names[c]) for c in close if _likeness(name, c) > best - 0.1]
    return f"did you mean {', '.join(others)} or {last}?" if others else f"did you mean {last}?"


def _likeness(name: str, names: str) -> float:
    """Similarity of two texts, 0 to 1, as `difflib.get_close_matches` computes it."""
    return difflib.SequenceMatcher(None, names, name.lower()).ratio()

"""How old the tables of the documents are: each has in `ages.json` the digest of the code that made it.

    python tests/benchmarks/ages.py --stale [-v]
    python tests/benchmarks/ages.py --mark
    python tests/benchmarks/ages.py --rerun [TABLE ...] [--budget MINUTES] [--recordings FOLDER]
    python tests/benchmarks/ages.py --made TABLE

`--stale` lists the tables whose code has changed, and its modules (all of them with `-v`). `--mark` says so below their
captions, and takes the mark away where code is again what was measured. `--rerun` makes them anew, cheapest first, as long as
the next one fits into what is left of the budget of CPU time; one whose cost nobody knows is stopped where the budget ends.
`--made` says that a table was now written by hand, as those of campaigns are.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from resource import RLIMIT_CPU, RUSAGE_CHILDREN, RUSAGE_SELF, getrusage, setrlimit
from typing import Any

from code_digest import ROOT, Code, parse

STARTED_S = time.time()
REGION = re.compile(r"(<!-- table (.+?) -->\n```bash\n(.*?)\n```\n\n)(.*?)(\n\n\|.*?<!-- end -->)", re.DOTALL)
MARK = re.compile(r"\nMeasured before the changes since (\w{8})\.$")
# Options whose folder a benchmark fills; other folders hold recordings.
SCRATCH = ("--runs", "--folder", "--work", "--keep")
SHOWN = 6


@dataclass(frozen=True)
class Entry:
    """What is kept of a table: digest of its code, commit below it, CPU seconds, and modules that its run did not load."""

    digest: str
    commit: str
    cost_s: float | None
    unused: list[str]


@dataclass(frozen=True)
class Table:
    """A table of a document: its command, its caption, and the commit that its mark names, or None."""

    page: Path
    name: str
    command: str
    caption: str
    mark: str | None


@dataclass
class Ages:
    """Tables and code below `root`."""

    root: Path = ROOT

    @cached_property
    def code(self) -> Code:
        return Code(self.root)

    @property
    def file(self) -> Path:
        return self.root / "tests" / "benchmarks" / "ages.json"

    def pages(self) -> list[Path]:
        return [
            path for path in (self.root / "README.md", *sorted((self.root / "docs").rglob("*.md"))) if path.is_file()
        ]

    def tables(self) -> dict[str, Table]:
        found = {}
        for page in self.pages():
            for _, name, command, caption, _ in REGION.findall(page.read_text(encoding="utf-8")):
                mark = MARK.search(caption)
                found[name] = Table(page, name, command, caption, mark[1] if mark else None)
        return found

    def entries(self) -> dict[str, Entry]:
        kept = json.loads(self.file.read_text(encoding="utf-8")) if self.file.is_file() else {}
        return {name: Entry(**entry) for name, entry in kept.items()}

    def keep(self, entries: dict[str, Entry]) -> None:
        """One table a line, so that changes of two branches meet in none."""
        lines = [f"{json.dumps(name)}: {json.dumps(asdict(entry))}" for name, entry in sorted(entries.items())]
        self.file.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")

    def stamp(self, name: str, command: str, page: Path, is_by_hand: bool = False) -> None:
        """Keep the digest of a table that was written now; code that changed since the start is none that was measured."""
        if page.resolve() not in [path.resolve() for path in self.pages()]:
            return
        unused = [] if is_by_hand else self.code.unused(command, sys.modules)
        reach = self.code.reach(command, unused)
        later = [name for name, path in reach.items() if path.stat().st_mtime > STARTED_S]
        if later:
            print(f"changed while the table was made: {', '.join(later)}", file=sys.stderr)
        digest = "unknown" if later else self.code.digest(command, unused)
        spent_s = round(sum(sum(getrusage(who)[:2]) for who in (RUSAGE_SELF, RUSAGE_CHILDREN)), 1)
        cost_s = None if is_by_hand else spent_s
        self.keep(self.entries() | {name: Entry(digest, self.git("rev-parse", "--short=8", "HEAD"), cost_s, unused)})

    def stale(self) -> dict[str, Table]:
        """Tables whose code, or command, is not what made them."""
        entries = self.entries()
        return {
            name: table
            for name, table in self.tables().items()
            if name not in entries or entries[name].digest != self.code.digest(table.command, entries[name].unused)
        }

    def wrongly_marked(self) -> list[str]:
        """Tables that are stale and do not say so, and that say so and are not."""
        stale = self.stale()
        return [name for name, table in self.tables().items() if (name in stale) != (table.mark is not None)]

    def git(self, *words: str) -> str:
        done = subprocess.run(["git", "-C", str(self.root), *words], capture_output=True, text=True, check=False)
        return done.stdout.strip() if done.returncode == 0 else ""

    def since(self, entry: Entry | None) -> str:
        """The commit on which a table was measured; if no history has it, as after a rebase, the one that brought the digest."""
        brought = ""
        if entry is not None:
            if self.git("merge-base", entry.commit, "HEAD").startswith(entry.commit or "-"):
                return entry.commit
            brought = self.git("log", "--format=%h", "--abbrev=8", f"-S{entry.digest}", "--", str(self.file))
        return (brought or self.git("rev-parse", "--short=8", "HEAD")).splitlines()[-1][:8]

    def mark(self) -> list[str]:
        """Put marks and take them away; the names of the tables that changed."""
        entries, stale, changed = self.entries(), self.stale(), []

        def marked(match: re.Match[str]) -> str:
            head, name, _, caption, rest = match.groups()
            is_marked = MARK.search(caption) is not None
            if is_marked != (name in stale):
                changed.append(name)
                caption = MARK.sub("", caption)
                if name in stale:
                    caption += f"\nMeasured before the changes since {self.since(entries.get(name))}."
            return f"{head}{caption}{rest}"

        for page in self.pages():
            text = page.read_text(encoding="utf-8")
            new = REGION.sub(marked, text)
            if new != text:
                page.write_text(new, encoding="utf-8")
        return changed

    def changes(self, table: Table, entry: Entry) -> list[str]:
        """Names of what a table depends on and is not as it was."""
        commit = self.since(entry)
        paths = set(self.git("diff", "--name-only", commit).splitlines())
        reach = self.code.reach(table.command, entry.unused)
        return [
            name
            for name, path in reach.items()
            if path.relative_to(self.root).as_posix() in paths and self._differs(commit, path)
        ]

    def _differs(self, commit: str, path: Path) -> bool:
        old = self.git("show", f"{commit}:{path.relative_to(self.root).as_posix()}")
        return path.suffix == ".toml" or parse(old).digest != self.code.digest_of(path)

    def jobs(self, names: Iterable[str]) -> Iterator[tuple[float | None, Table]]:
        """CPU seconds and one table of each command that made one of the stale tables named, cheapest first."""
        entries, of_command = self.entries(), {}
        for name, table in self.stale().items():
            if not names or name in names:
                of_command.setdefault(table.command, (entries[name].cost_s if name in entries else None, table))
        yield from sorted(of_command.values(), key=lambda job: (job[0] is None, job[0] or 0.0))


def arguments(command: str, scratch: str, recordings: Path | None) -> list[str] | None:
    """Words behind `python`, with a folder for each FOLDER; None for what wants a hand."""
    words = shlex.split(command, comments=True)[1:]
    places = [i for i, word in enumerate(words) if word == "FOLDER"]
    foreign = [i for i in places if words[i - 1] not in SCRATCH]
    if "-m" in words or "--known" in words or len(foreign) > 1 or (foreign and recordings is None):
        return None
    for i in places:
        words[i] = str(recordings) if i in foreign else scratch
    return words


def run(words: list[str], root: Path, most_s: float) -> str:
    """How a command ended that is not '': with so many seconds of CPU in one process it is stopped."""
    # The package below root, whichever is installed.
    environment = {**os.environ, "PYTHONPATH": str(root)}
    limit = math.ceil(most_s)
    code = subprocess.run(
        [sys.executable, *words], cwd=root, env=environment, check=False,
        preexec_fn=lambda: setrlimit(RLIMIT_CPU, (limit, limit)),
    ).returncode  # fmt: skip
    return (
        f"stopped after {limit} s"
        if code in (-signal.SIGXCPU, -signal.SIGKILL)
        else f"failed with {code}"
        if code
        else ""
    )


def rerun(ages: Ages, names: list[str], budget_min: float, recordings: Path | None) -> None:
    left_s = 60 * budget_min
    for cost_s, table in ages.jobs(names):
        with tempfile.TemporaryDirectory() as scratch:
            words = arguments(table.command, scratch, recordings)
            if words is None or (cost_s is not None and cost_s > left_s) or left_s <= 0:
                reason = "by hand" if words is None else f"costs {cost_s or '?'} s, {left_s:.0f} are left"
                print(f"{table.name}: {reason}: {table.command}", flush=True)
                continue
            before = sum(getrusage(RUSAGE_CHILDREN)[:2])
            page = table.page.relative_to(ages.root)
            ended = run([*words, "--write", str(page)], ages.root, left_s)
            spent_s = sum(getrusage(RUSAGE_CHILDREN)[:2]) - before
            left_s -= spent_s
            print(f"{table.name}: {ended or 'renewed'}, {spent_s:.0f} s of CPU", flush=True)


def show_stale(ages: Ages, is_verbose: bool) -> None:
    entries = ages.entries()
    for name, table in ages.stale().items():
        if name not in entries:
            print(f"{name}: nothing is known of what made it")
            continue
        entry, names = entries[name], ages.changes(table, entries[name])
        more = "" if is_verbose or len(names) <= SHOWN else f" and {len(names) - SHOWN} more"
        cost = "" if entry.cost_s is None else f", {entry.cost_s:.0f} s of CPU"
        print(f"{name} ({table.page.relative_to(ages.root)}{cost}), since {ages.since(entry)}:")
        print(f"    {' '.join(names if is_verbose else names[:SHOWN])}{more}")


def main(arguments_given: list[str] | None = None, **given: Any) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--stale", action="store_true")
    what.add_argument("--mark", action="store_true")
    what.add_argument("--rerun", nargs="*", metavar="TABLE")
    what.add_argument("--made", metavar="TABLE")
    parser.add_argument("-v", "--verbose", action="store_true")
    parser.add_argument("--budget", type=float, default=30.0, metavar="MINUTES", help="of CPU time; 30")
    parser.add_argument("--recordings", type=Path, metavar="FOLDER", help="of unpacked recordings")
    args = parser.parse_args(arguments_given)
    ages = Ages(**given)
    if args.stale:
        show_stale(ages, args.verbose)
    elif args.made:
        table = ages.tables().get(args.made) or sys.exit(f"no document has a table {args.made}")
        ages.stamp(table.name, table.command, table.page, is_by_hand=True)
    elif args.mark:
        print(*ages.mark(), sep="\n")
    else:
        rerun(ages, args.rerun, args.budget, args.recordings)


if __name__ == "__main__":
    main()

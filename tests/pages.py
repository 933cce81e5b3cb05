"""The project's pages as tests read them: blocks, commands, anchors, tables."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Page:
    """One page in Markdown; `name` is its path below the project's folder."""

    name: str
    text: str

    @property
    def blocks(self) -> list[tuple[str, str]]:
        """Language and text of each fenced block."""
        return _FENCE.findall(self.text)

    @property
    def prose(self) -> str:
        """All but the blocks."""
        return _FENCE.sub("", self.text)

    def block(self, language: str, holding: str = "") -> str:
        """The one block of a language that holds some text."""
        (text,) = [text for kind, text in self.blocks if kind == language and holding in text]
        return text

    def shell_lines(self) -> list[str]:
        """Lines of its shell blocks, without comments."""
        lines = [
            line.split("  #")[0].strip() for kind, text in self.blocks if kind == "bash" for line in text.splitlines()
        ]
        return [line for line in lines if line]

    def lslam_calls(self) -> list[list[str]]:
        """Arguments of each `lslam ...`: of its shell blocks, and of its text in backticks."""
        steps = [step.strip() for line in self.shell_lines() for step in re.split(r"&&|\|\|?", line)]
        # In the text `lslam COMMAND` and `lslam run ...` stand for any.
        steps += [s for s in re.findall(r"`(lslam [^`]+)`", self.prose) if not re.search(r"COMMAND|\.\.\.", s)]
        called = [step for step in steps if step.startswith("lslam ")]
        return [shlex.split(re.split(r" [<>] ", step)[0])[1:] for step in called]

    def anchors(self) -> set[str]:
        """Of its headings, as GitHub and mkdocs make them."""
        return {slug(title) for title in re.findall(r"^#+ (.+)$", self.prose, re.MULTILINE)}

    def links(self) -> list[str]:
        """Targets of its links and pictures."""
        return re.findall(r"\]\(([^)\s]+)\)", self.prose)

    def rows(self) -> list[list[str]]:
        """Cells of all rows of its tables."""
        lines = [line for line in self.prose.splitlines() if line.startswith("|") and not line.startswith("|---")]
        return [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]


def slug(title: str) -> str:
    """The anchor of a heading."""
    return re.sub(r"\s+", "-", re.sub(r"[^\w\s-]", "", title.lower()).strip())


def page(name: str) -> Page:
    """The page of that name."""
    return Page(name, (ROOT / name).read_text(encoding="utf-8"))


def task_pages() -> list[Page]:
    """The README and the pages that say how a task is done."""
    return [shown for shown in every_page() if shown.name == "README.md" or shown.name.startswith("docs/tasks/")]


def every_page() -> list[Page]:
    """The pages at the top and in docs/."""
    paths = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    return [page(path.relative_to(ROOT).as_posix()) for path in sorted(paths)]

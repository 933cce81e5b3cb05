"""Names of what is defined are nouns and verbs: participles (`found`, `known`) do not say what a thing is."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "lslam"
# May only go down.
MOST_PARTICIPLES = 48
IRREGULAR = """begun bound bought broken brought built caught chosen done drawn driven felt flown found frozen given gone grown
heard held hidden kept known laid left lent lost made meant met paid risen said seen sent shaken shown sold sought spent stolen
sunk swept taken taught thought thrown told torn understood won worn woven written"""
# They end like participles and are none.
OTHERS = "bed breed deed exceed feed hundred indeed need proceed seed shed speed succeed weed"
QUESTIONS = ("is", "are", "has", "have", "was", "were", "can", "may")


def is_participle(name: str) -> bool:
    """Whether a name ends in a participle, and asks no question (`is_lost`)."""
    snake = "".join("_" + letter.lower() if letter.isupper() else letter for letter in name)
    words = snake.strip("_").split("_") if not name.isupper() else name.lower().split("_")
    regular = len(words[-1]) > 3 and words[-1].endswith("ed") and words[-1] not in OTHERS.split()
    return words[0] not in QUESTIONS and (regular or words[-1] in IRREGULAR.split())


def defined_names(tree: ast.AST) -> Iterator[str]:
    """Names of functions, classes, arguments and annotated fields, and of assignments outside functions."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.name
            case ast.arg():
                yield node.arg
        if isinstance(node, ast.Module | ast.ClassDef):
            for statement in node.body:
                targets = (
                    statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
                )
                yield from (target.id for target in targets if isinstance(target, ast.Name))


def participles(folder: Path) -> set[str]:
    """Different names in all modules below a folder that are participles."""
    return {
        name
        for path in folder.rglob("*.py")
        for name in defined_names(ast.parse(path.read_text("utf-8")))
        if is_participle(name)
    }


def test_few_names_are_participles() -> None:
    names = participles(PACKAGE)
    assert len(names) <= MOST_PARTICIPLES, f"{len(names)}: {' '.join(sorted(names))}"


@pytest.mark.parametrize("name", ["found", "_judged", "scans_needed", "Cleaned", "KNOWN", "without_lost"])
def test_a_participle_is_counted(name: str) -> None:
    assert is_participle(name)


@pytest.mark.parametrize("name", ["merged_map", "is_lost", "speed", "seed", "split", "merge", "red", "Bed"])
def test_nouns_verbs_and_questions_are_not(name: str) -> None:
    assert not is_participle(name)


def test_every_kind_of_definition_is_read() -> None:
    source = "KNOWN = 1\nclass Made:\n    told: int\n    def felt(self, seen): held = 2\nasync def kept(*, lost): ...\n"
    assert sorted(filter(is_participle, defined_names(ast.parse(source)))) == [
        "KNOWN",
        "Made",
        "felt",
        "kept",
        "lost",
        "seen",
        "told",
    ]

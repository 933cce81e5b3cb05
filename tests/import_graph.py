"""The graph of imports, read from the source and not from a run; `python -m tests.import_graph` counts it."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "lslam"


def modules() -> dict[str, Path]:
    names = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        names[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return names


@cache
def read(path: Path) -> tuple[set[str], set[str], list[str]]:
    """What a file says, parsed once for all tests: its imports, its dotted names, its classes."""
    imports: set[str] = set()
    names: set[str] = set()
    classes: list[str] = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            imports |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            imports |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.ClassDef):
            classes.append(node.name)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("lslam."):
            names.add(node.value.split(":")[0])
    return imports, names, classes


def imports_of(path: Path) -> set[str]:
    """Every name imported anywhere in the file, also inside functions and `if TYPE_CHECKING`, with from-imports expanded."""
    return read(path)[0]


def tables_of(path: Path) -> set[str]:
    """Dotted names in string constants: modules imported lazily through a table."""
    return read(path)[1]


MODULES = modules()


def edges() -> list[tuple[str, str]]:
    pairs = []
    for name, path in MODULES.items():
        for target in imports_of(path) | tables_of(path):
            if target in MODULES and target != name:
                pairs.append((name, target))
    return pairs


def package_of(name: str) -> str:
    parts = name.split(".")
    return parts[1] if len(parts) > 1 else ""


def main() -> None:
    """Print how large the house is: arrows are pairs of rooms, the ground floor aside."""
    pairs = {(package_of(a), package_of(b)) for a, b in edges()}
    arrows = {(a, b) for a, b in pairs if a != b and b and a not in ("", "__main__")}
    rooms = {package_of(name) for name in MODULES} - {"", "__main__"}
    lines = sum(len(path.read_text().splitlines()) for path in MODULES.values())
    print(f"{len(MODULES)} modules, {lines} lines, {len(rooms)} rooms, {len(arrows)} arrows")


if __name__ == "__main__":
    main()

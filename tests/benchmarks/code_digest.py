"""Digests of the code that a command reaches by its imports, which comments, docstrings and formatting do not change.

Imports are read from the source, those inside functions too, those for the type checker alone not, and modules that strings
name (registries of methods, readers, matchers). Of these, modules that the run had not loaded when it wrote its table do not
count, unless it works in processes of its own. `PRESENTING` rooms show and convert what a run found: they count where the
benchmark itself imports them. TOML files that ship with the package count where the benchmark names them. A campaign
(`python -m`), and a benchmark that calls `lslam` by its command line, depend on the whole package.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
import shlex
import tomllib
from collections.abc import Container, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PRESENTING = ("lslam.cli", "lslam.reports", "lslam.pipeline.doctor", "lslam.pipeline.convert")
# What writes tables down, and these digests, is no part of what is measured.
APART = ("ages", "code_digest")
SHORT = 12


@dataclass(frozen=True)
class Source:
    """What one file says: its digest, its imports, its strings, and the attributes of `lslam` that it uses."""

    digest: str
    imports: frozenset[str]
    strings: frozenset[str]
    attributes: frozenset[str]


def short(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:SHORT]


def parse(text: str) -> Source:
    tree = ast.parse(text)
    words: list[str] = []
    imports: set[str] = set()
    strings: set[str] = set()
    attributes: set[str] = set()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            return
        words.append(type(node).__name__)
        if isinstance(node, ast.Import):
            imports.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            imports.add(node.module)
            imports.update(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            strings.add(node.value)
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "lslam":
            attributes.add(node.attr)
        for name, value in ast.iter_fields(node):
            # Fields that are empty differ from one Python to the next, and do not matter.
            is_empty = value is None or value == []
            if name in ("ctx", "kind", "type_comment") or (is_empty and not isinstance(node, ast.Constant)):
                continue
            words.append(name)
            if isinstance(value, list) and name == "body" and _has_docstring(node):
                value = value[1:]
            for item in value if isinstance(value, list) else [value]:
                if isinstance(item, ast.AST):
                    visit(item)
                else:
                    words.append(repr(item))
            words.append("/")

    visit(tree)
    return Source(short("\n".join(words)), frozenset(imports), frozenset(strings), frozenset(attributes))


def _has_docstring(node: ast.AST) -> bool:
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    return isinstance(node, kinds) and ast.get_docstring(node, clean=False) is not None


def _is_whole(command: str, own: Iterable[Source]) -> bool:
    return " -m " in command or any({"-m", "lslam"} <= source.strings for source in own)


@dataclass
class Code:
    """The package and the tests below `root`; each file is read once."""

    root: Path = ROOT
    _read: dict[Path, Source] = field(default_factory=dict)
    _beyond: dict[str, frozenset[str]] = field(default_factory=dict)

    @cached_property
    def modules(self) -> dict[str, Path]:
        found = {}
        for path in sorted((self.root / "lslam").rglob("*.py")):
            parts = path.relative_to(self.root).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
        return found

    @cached_property
    def _scripts(self) -> dict[str, Path]:
        """Modules of the tests by the names under which scripts import them, those of the benchmarks first."""
        found: dict[str, Path] = {}
        tests = self.root / "tests"
        for path in [*sorted((tests / "benchmarks").glob("*.py")), *sorted(tests.rglob("*.py"))]:
            found.setdefault(path.stem, path)
            found.setdefault(".".join(path.relative_to(tests).with_suffix("").parts), path)
        return {name: path for name, path in found.items() if name not in APART}

    @cached_property
    def _lazy(self) -> dict[str, str]:
        """Modules by the names under which `lslam` itself gives what they define."""
        tree = ast.parse(self.modules["lslam"].read_text(encoding="utf-8"))
        pairs = [
            pair
            for node in ast.walk(tree)
            if isinstance(node, ast.Dict)
            for pair in zip(node.keys, node.values, strict=True)
        ]
        return {
            key.value: value.elts[0].value
            for key, value in pairs
            if isinstance(key, ast.Constant)
            and isinstance(value, ast.Tuple)
            and isinstance(value.elts[0], ast.Constant)
        }

    def source(self, path: Path) -> Source:
        if path not in self._read:
            self._read[path] = parse(path.read_text(encoding="utf-8"))
        return self._read[path]

    def script(self, command: str) -> Path:
        """The file that a command runs."""
        words = shlex.split(command, comments=True)
        return self.root / (words[1] if words[1] != "-m" else words[2].replace(".", "/") + "/__main__.py")

    def own(self, command: str) -> dict[str, Path]:
        """The files of the tests that a command imports, its own among them."""
        todo, found = [self.script(command)], {}
        while todo:
            path = todo.pop()
            name = path.relative_to(self.root).with_suffix("").as_posix()
            if name not in found:
                found[name] = path
                imports = self.source(path).imports
                todo += [self._scripts[one] for one in imports if one in self._scripts and one not in self.modules]
        return found

    def unused(self, command: str, loaded: Container[str]) -> list[str]:
        """Modules where what was not loaded begins: each is imported, or named, by one that was."""
        own = [self.source(path) for path in self.own(command).values()]
        if _is_whole(command, own) or any("subprocess" in source.imports for source in own):
            return []
        names = [name for name in self.reach(command) if name in self.modules and name in loaded]
        return sorted({one for name in names for one in self._next(name) if one not in loaded})

    def _next(self, name: str) -> frozenset[str]:
        """Modules that a module imports, or names, and its package; those of `lslam` itself are asked for one by one."""
        if name not in self._beyond:
            source = self.source(self.modules[name])
            named = {text.split(":")[0] for text in source.strings if text.startswith("lslam.") and name != "lslam"}
            rooms = tuple(text for text in named if text.endswith("."))
            found = {one for one in self.modules if one in named or one in source.imports or one.startswith(rooms)}
            self._beyond[name] = frozenset(found | ({name.rpartition(".")[0]} & set(self.modules))) - {name}
        return self._beyond[name]

    def reach(self, command: str, unused: Iterable[str] = ()) -> dict[str, Path]:
        """Files that a command depends on, by name, not followed beyond the modules that its run did not use."""
        own = self.own(command)
        sources = [self.source(path) for path in own.values()]
        is_whole = _is_whole(command, sources)
        direct: set[str] = set()
        for source in sources:
            names = source.imports | {f"lslam.{one}" for one in source.attributes}
            direct |= names & set(self.modules)
            direct |= {self._lazy[one] for one in (name.removeprefix("lslam.") for name in names) if one in self._lazy}
        todo, found, skipped = sorted(self.modules if is_whole else direct), set(), set(unused)
        while todo:
            name = todo.pop()
            if name not in found:
                found.add(name)
                todo += self._next(name) - skipped
        rooms = tuple(f"{room}." for room in PRESENTING)
        counted = {name for name in found if name in direct or not f"{name}.".startswith(rooms)}
        strings = {text for source in sources for text in source.strings} | set(shlex.split(command, comments=True))
        data = self._data({word for text in strings for word in re.findall(r"[\w-]+", text)}, is_whole)
        return own | {name: self.modules[name] for name in sorted(counted)} | data

    def _data(self, words: set[str], is_whole: bool) -> dict[str, Path]:
        """TOML files that ship with the package and are named, or are the base of one that is."""
        files = {path.stem: path for path in sorted((self.root / "lslam").rglob("*.toml"))}
        todo, found = sorted(files if is_whole else words & set(files)), {}
        while todo:
            path = files[todo.pop()]
            found[path.relative_to(self.root).as_posix()] = path
            base = tomllib.loads(path.read_text(encoding="utf-8")).get("base")
            todo += [base] * (base in files)
        return found

    def digest_of(self, path: Path) -> str:
        if path.suffix == ".toml":
            return short(json.dumps(tomllib.loads(path.read_text(encoding="utf-8")), sort_keys=True, default=str))
        return self.source(path).digest

    def digest(self, command: str, unused: Iterable[str] = ()) -> str:
        """Of the command, its seeds included, and of all that it depends on."""
        files = {name: self.digest_of(path) for name, path in self.reach(command, unused).items()}
        words = shlex.split(command, comments=True)
        return short(json.dumps([words, files], sort_keys=True))

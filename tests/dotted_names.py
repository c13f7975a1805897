"""Whether names of ours lead somewhere, read off the sources: nothing is imported, so no optional package is needed."""

from __future__ import annotations

import ast
import io
import re
import tokenize
import tomllib
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("flockopt", "learned", "sim", "benchmarks")

#: Names of ours in running text; what goes on with a hyphen or a slash is the name of a file format or a file.
NAME = re.compile(rf"(?<![\w./-])(?:{'|'.join(PACKAGES)})(?:\.[A-Za-z_]\w*)+(?![\w/-])")

COMMAND = re.compile(r"python3? -m ([A-Za-z_]\w*(?:\.\w+)*)")
IMPORT = re.compile(r"from ([A-Za-z_][\w.]*) import ([\w, ]+)")
PATH = re.compile(r"(?<![\w./-])(?:flockopt|learned|sim|benchmarks|tests|docs|examples)/[\w./-]*\.[a-z]\w*")

#: Groups of entry points, which look like modules and are none.
GROUPS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["entry-points"].keys()


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def texts(path):
    """All that a source says in words: its comments and its strings, docstrings among them."""
    source = path.read_text(encoding="utf-8")
    yield from (
        token.string for token in tokenize.generate_tokens(io.StringIO(source).readline) if token.type == tokenize.COMMENT
    )
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def dangling(text):
    """What a text names of ours and does not lead anywhere: names, imports, commands and paths."""
    names = set(NAME.findall(text)) - GROUPS
    for module, imported in IMPORT.findall(text):
        if module.split(".")[0] in PACKAGES:
            names |= {f"{module}.{name.strip().split(' ')[0]}" for name in imported.split(",") if name.strip()}
    commands = {name for name in COMMAND.findall(text) if name.split(".")[0] in PACKAGES}
    paths = {path for path in PATH.findall(text) if not (ROOT / path).exists()}
    return {name for name in names if not exists(name)} | {f"-m {name}" for name in commands if not runs(name)} | paths


def runs(module):
    """Whether ``python -m`` runs it."""
    return f"{module}.__main__" in MODULES or (module in MODULES and "__main__" in MODULES[module].read_text(encoding="utf-8"))


@cache
def bound_names(module):
    """What a module binds at its top, by name: the statement that does."""
    bound = {}
    for node in _statements(ast.parse(MODULES[module].read_text(encoding="utf-8")).body):
        bound |= dict.fromkeys(_targets(node), node)
    return bound


def _statements(body):
    """Statements, and those below ``if``, ``try`` and ``with``."""
    for node in body:
        if isinstance(node, (ast.If, ast.Try, ast.With)):
            for part in ("body", "orelse", "finalbody"):
                yield from _statements(getattr(node, part, []))
        else:
            yield node


def _targets(node):
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        return [node.name]
    if isinstance(node, (ast.Import, ast.ImportFrom)):
        return [alias.asname or alias.name for alias in node.names]
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]


def _members(node):
    """Fields and methods of a class, and what its methods set on ``self``."""
    own = {name for statement in node.body for name in _targets(statement)}
    return own | {
        part.attr
        for part in ast.walk(node)
        if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store) and ast.unparse(part.value) == "self"
    }


def exists(name):
    """Whether a dotted name is a module, something that a module binds, or a member of a class bound there."""
    parts = name.split(".")
    length = next((length for length in range(len(parts), 0, -1) if ".".join(parts[:length]) in MODULES), 0)
    if length in (0, len(parts)):
        return length > 0
    module, (first, *rest) = ".".join(parts[:length]), parts[length:]
    node = bound_names(module).get(first)
    if isinstance(node, ast.Import):  # of others, as all of ours import names
        return True
    if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in PACKAGES:
        original = next(alias.name for alias in node.names if first in (alias.asname, alias.name))
        return exists(".".join([node.module, original, *rest]))
    if not rest:
        return node is not None
    return isinstance(node, ast.ClassDef) and len(rest) == 1 and rest[0] in _members(node)

"""Imports point one way: every file imports only what stands above it in docs/architecture.md."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("flockopt", "learned", "sim", "benchmarks")

#: Which of our packages each of them may import, besides itself.
ALLOWED = {"flockopt": set(), "learned": {"flockopt"}, "sim": {"flockopt"}, "benchmarks": {"flockopt", "learned", "sim"}}


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def sources(package):
    return {module_name(path): path for path in sorted((ROOT / package).rglob("*.py"))}


#: Where modules are imported by names that others give: public names looked up late, and optional dependencies.
BY_NAME = ("flockopt", "flockopt.errors")

MODULES = {name: path for package in PACKAGES for name, path in sources(package).items()}


#: The packages with a map of their own in docs/architecture.md, and the module that it begins with.
MAPPED = {"flockopt": "errors", "sim": "physics.vectors", "learned": "networks.weight_files"}


def layers(package="flockopt"):
    """The modules of a package in the order of its map in docs/architecture.md."""
    text = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    block = re.search(rf"```text\n({MAPPED[package]}.*?)```", text, re.DOTALL)
    lines = [line.split("  ")[0].strip() for line in block.group(1).splitlines()]
    return [f"{package}.{name}" for line in lines for name in line.replace(",", " ").split()]


def is_type_checking(node):
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


def imports(name):
    """What a module imports of ours, wherever in the file; imports for type checkers only are left out."""
    found = set()

    def visit(node):
        if is_type_checking(node):
            for child in node.orelse:
                visit(child)
            return
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} has a relative import"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in MODULES else node.module)
        elif (
            isinstance(node, ast.Call) and name not in BY_NAME and ast.unparse(node.func).endswith(("import_module", "require"))
        ):
            assert isinstance(node.args[0], ast.Constant), f"{name} imports by a computed name"
            found.add(node.args[0].value)
        for child in ast.iter_child_nodes(node):
            visit(child)

    visit(ast.parse(MODULES[name].read_text(encoding="utf-8")))
    return {module for module in found if module.split(".")[0] in PACKAGES} - {name}


def is_package(name):
    return MODULES[name].name == "__init__.py"


def mapped_modules():
    """Every module that has a place in a map."""
    return [name for package in MAPPED for name in sources(package) if name not in MAPPED and not is_package(name)]


def rank(name, order):
    """A module's place in the map; a package re-exports, so importing it needs the last of what it imports."""
    if is_package(name):
        return max((rank(target, order) for target in imports(name)), default=-1)
    return order.index(name)


def room(name):
    """The package that a module of flockopt stands in, or the module itself."""
    return name.split(".")[1]


@pytest.mark.parametrize("package", MAPPED)
def test_the_map_names_every_module_once(package):
    order = layers(package)
    assert len(order) == len(set(order))
    modules = {name for name in sources(package) if not is_package(name)}
    assert set(order) == modules, "docs/architecture.md and the files differ"


@pytest.mark.parametrize("name", mapped_modules())
def test_imports_point_up(name):
    package = name.split(".")[0]
    order = layers(package)
    for target in imports(name) - {package}:
        assert target in MODULES, f"{name} imports {target}, which does not exist"
        if target.split(".")[0] == package:
            assert rank(target, order) < rank(name, order), f"{name} imports {target}, which stands below it"


def test_packages_stand_in_one_order():
    """Whatever a package of flockopt imports, nothing runs back: each package is done before the next begins."""
    order = list(dict.fromkeys(room(name) for name in layers()))
    for name in sources("flockopt"):
        if name != "flockopt":
            rooms = {room(target) for target in imports(name) if target.startswith("flockopt.")}
            assert all(order.index(other) <= order.index(room(name)) for other in rooms), name


def test_no_function_shares_its_name_with_a_module_beside_it():
    names = {name.rpartition(".")[0::2] for name in MODULES}
    for name in filter(is_package, MODULES):
        exported = {
            alias.name
            for node in ast.walk(ast.parse(MODULES[name].read_text()))
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        assert not {(name, one) for one in exported} & names, name


@pytest.mark.parametrize("name", [name for name in MODULES if is_package(name) and name != "flockopt"])
def test_packages_only_re_export(name):
    tree = ast.parse(MODULES[name].read_text(encoding="utf-8"))
    for node in tree.body:
        text = ast.unparse(node)
        assert isinstance(node, (ast.ImportFrom, ast.Expr)) or text.startswith("__all__"), f"{name} does more: {text}"


@pytest.mark.parametrize("name", MODULES)
def test_packages_import_only_what_they_may(name):
    package = name.split(".")[0]
    others = {target.split(".")[0] for target in imports(name)} - {package}
    assert others <= ALLOWED[package]


def test_the_judge_imports_no_planner():
    reached, waiting = set(), ["flockopt.certificate.judge"]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += imports(name) if name != "flockopt" else ()
    records = {"flockopt.bundles", "flockopt.bundles.bundles", "flockopt.flights", "flockopt.flights.curve"}
    planners = ("flockopt.bundles", "flockopt.flights", "flockopt.planning", "learned", "sim")
    assert not {name for name in reached - records if name.startswith(planners)}
    assert {"flockopt.scene.scene", "flockopt.flights.curve"} <= reached


def test_an_edge_that_points_down_would_be_seen(tmp_path, monkeypatch):
    path = tmp_path / "curve.py"
    path.write_text("def deferred():\n    from flockopt.planning.pipeline import plan\n    return plan\n")
    monkeypatch.setitem(MODULES, "flockopt.flights.curve", path)
    assert imports("flockopt.flights.curve") == {"flockopt.planning.pipeline"}
    path.write_text("def hidden():\n    return require('flockopt.planning.pipeline', extra='all')\n")
    assert imports("flockopt.flights.curve") == {"flockopt.planning.pipeline"}
    with pytest.raises(AssertionError, match="stands below"):
        test_imports_point_up("flockopt.flights.curve")

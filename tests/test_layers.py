"""Data flows one way: a module imports only from layers above its own, its own package, or the outside.

No two files import each other, directly or round about, and no package reaches for another's underscore names.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Set
from pathlib import Path

import pytest

NAME = "yid_ocp"
PACKAGE = Path(__file__).parents[1] / NAME
LAYERS = (
    ("errors", "version"),
    ("registry",),  # it raises errors, so the two cannot share a layer
    ("options", "files", "least_squares", "interruption", "progress", "display", "serialization"),
    ("parallel",),
    ("model",),
    ("effects", "sensors"),
    ("integrator",),
    ("data",),
    ("vision",),
    ("virtual",),
    ("problem",),
    ("inference",),
    ("solvers",),
    ("analysis",),
    ("diagnosis",),
    ("planning",),
    ("export", "report"),
    ("config",),
    ("workflow",),
    ("cli",),
    ("__main__",),
)
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
MODULES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def dotted(path: Path) -> tuple[list[str], list[str]]:
    """Name of a module and of the package that it stands in, without `yid_ocp`."""
    parts = list(path.relative_to(PACKAGE).with_suffix("").parts)
    return (parts[:-1], parts[:-1]) if parts[-1] == "__init__" else (parts, parts[:-1])


def absolute(target: str, package: list[str]) -> str:
    """Resolve the leading dots of a relative import."""
    name = target.lstrip(".")
    level = len(target) - len(name)
    if level == 0:
        return name
    base = [NAME, *package][: len(package) + 2 - level]
    return ".".join([*base, *([name] if name else [])])


def imported(source: str, package: list[str]) -> Iterator[tuple[int, str]]:
    """Line and full name of all that is imported from the package, at the top, in functions or by name."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, (ast.Import, ast.ImportFrom, ast.Call)):
            continue
        targets: list[str] = []
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = absolute("." * node.level + (node.module or ""), package)
            # `from yid_ocp import model` imports a package, `from yid_ocp.model import System` need not
            targets = [f"{base}.{alias.name}" for alias in node.names] if base == NAME else [base]
        else:
            function = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            first = node.args[0] if node.args else None
            if function in ("import_module", "__import__") and isinstance(first, ast.Constant):
                targets = [absolute(str(first.value), package)]
        for target in targets:
            if target.split(".")[0] == NAME:
                yield node.lineno, target


def violations(source: str, module: list[str], package: list[str]) -> list[str]:
    """What a module imports from layers below, from another package of its own layer, or through the front door."""
    found = []
    for line, target in imported(source, package):
        top = ([*target.split("."), ""])[1]
        # the front door imports everything, so only its version may be asked for from inside
        if top not in (module[0], "__version__") and RANK.get(top, len(LAYERS)) >= RANK[module[0]]:
            found.append(f"line {line}: {'.'.join(module)} must not import {target}")
    return found


def at_import(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes outside functions: what runs when a module is imported, and what stands under `if TYPE_CHECKING`."""
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            yield node
            yield from at_import(node)


def neighbours(source: str, package: list[str], modules: Set[str]) -> set[str]:
    """Modules that a file imports when it is imported itself, of those named."""
    found = set()
    for node in at_import(ast.parse(source)):
        targets: list[str] = []
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = absolute("." * node.level + (node.module or ""), package)
            # a name may be a module of the package or something that the package's own file defines
            targets = [name if inner(name) in modules else base for name in (f"{base}.{a.name}" for a in node.names)]
        found |= {inner(target) for target in targets} & modules
    return found


def inner(target: str) -> str:
    """A full name without `yid_ocp.`; empty for what lies outside."""
    return target.removeprefix(f"{NAME}.") if target.startswith(f"{NAME}.") else ""


def circles(edges: Mapping[str, Set[str]]) -> list[list[str]]:
    """Groups of files that import each other."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        waiting = [start]
        while waiting:
            new = edges.get(waiting.pop(), set()) - seen
            seen |= new
            waiting += new
        return seen

    reach = {name: reached(name) for name in edges}
    groups = {tuple(sorted(b for b in reach[a] if a in reach.get(b, ()))) for a in edges if a in reach[a]}
    return [list(group) for group in sorted(groups)]


def private(source: str, module: list[str], package: list[str]) -> list[str]:
    """Underscore names of other packages that a module imports or reaches for through a module that it imported."""

    def hidden(name: str) -> bool:
        return name.startswith("_") and not name.endswith("__")

    found, bound = [], set()
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            base = absolute("." * node.level + (node.module or ""), package)
            names = {alias.asname or alias.name: f"{base}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names = {alias.asname or alias.name.split(".")[0]: alias.name for alias in node.names}
        else:
            continue
        for name, target in names.items():
            parts = inner(target).split(".")
            if parts[0] in ("", module[0]):
                continue
            bound.add(name)
            if any(hidden(part) for part in parts):
                found.append(f"line {node.lineno}: {'.'.join(module)} must not import {target}")
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and hidden(node.attr):
            owner = node.value
            while isinstance(owner, ast.Attribute):
                owner = owner.value
            if isinstance(owner, ast.Name) and owner.id in bound:
                found.append(f"line {node.lineno}: {'.'.join(module)} must not use {ast.unparse(node)}")
    return found


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    """Which files of the package import which."""
    names = {".".join(dotted(path)[0]): path for path in MODULES}
    return {
        name: neighbours(path.read_text(encoding="utf-8"), dotted(path)[1], set(names)) for name, path in names.items()
    }


def test_no_two_files_import_each_other(graph: dict[str, set[str]]) -> None:
    assert circles(graph) == []


@pytest.mark.parametrize("path", MODULES, ids=lambda path: ".".join(dotted(path)[0]))
def test_module_imports_from_the_left_only(path: Path) -> None:
    module, package = dotted(path)
    assert module[0] in RANK, f"say in LAYERS where '{module[0]}' belongs"
    assert violations(path.read_text(encoding="utf-8"), module, package) == []
    assert private(path.read_text(encoding="utf-8"), module, package) == []


@pytest.mark.parametrize(
    ("module", "source", "wrong"),
    [
        ("registry", "from yid_ocp.errors import DataError", False),
        ("errors", "from yid_ocp.registry import Registry", True),
        ("solvers.base", "import yid_ocp.problem.estimation_problem", False),
        ("solvers.base", "import numpy, yid_ocp.analysis", True),
        ("solvers.base", "from yid_ocp.solvers.initial_guess import nlp", False),
        ("solvers.base", "from .formulation import nlp", False),
        ("solvers.base", "from ..problem import problem", False),
        ("solvers.base", "from ..analysis import compare", True),
        ("solvers.base", "from .. import analysis", True),
        ("solvers.__init__", "from .base import Solver", False),
        ("solvers.__init__", "from ..report import html", True),
        ("solvers.base", "from yid_ocp import analysis", True),
        ("solvers.base", "from yid_ocp import model", False),
        ("solvers.base", "import yid_ocp", True),
        ("solvers.base", "from yid_ocp import System", True),
        ("cli", "from yid_ocp import __version__", False),
        ("cli", "from yid_ocp import solve", True),
        ("effects.damping", "from yid_ocp.sensors import joints", True),
        ("sensors.joints", "from yid_ocp.effects import damping", True),
        ("model.system", "def f():\n    from yid_ocp.effects import damping", True),
        ("model.system", "if TYPE_CHECKING:\n    from yid_ocp.effects import damping", True),
        ("model.system", "import importlib\nimportlib.import_module('yid_ocp.cli')", True),
        ("model.system", "import_module('..cli', __package__)", True),
        ("model.system", "__import__('yid_ocp.cli')", True),
        ("model.system", "from yid_ocpus import cli", False),
        ("data.readers", "from yid_ocp.unheard_of import x", True),
    ],
)
def test_the_check_itself(module: str, source: str, wrong: bool) -> None:
    parts, package = dotted(PACKAGE / f"{module.replace('.', '/')}.py")
    assert bool(violations(source, parts, package)) is wrong


@pytest.mark.parametrize(
    ("files", "groups"),
    [
        ({"a.x": "from yid_ocp.a.y import f", "a.y": "import numpy"}, []),
        ({"a.x": "from yid_ocp.a.y import f", "a.y": "from yid_ocp.a.x import g"}, [["a.x", "a.y"]]),
        ({"a.x": "import yid_ocp.a.y", "a.y": "from . import x"}, [["a.x", "a.y"]]),
        ({"a.x": "from yid_ocp.a import y", "a.y": "from .x import g"}, [["a.x", "a.y"]]),
        ({"a.x": "if TYPE_CHECKING:\n    from .y import F", "a.y": "from .x import g"}, [["a.x", "a.y"]]),
        ({"a.x": "try:\n    from .y import F\nexcept E:\n    pass", "a.y": "from .x import g"}, [["a.x", "a.y"]]),
        ({"a.x": "class C:\n    from .y import F", "a.y": "from .x import g"}, [["a.x", "a.y"]]),
        ({"a.x": "def f():\n    from .y import F", "a.y": "from .x import g"}, []),
        ({"a": "from .x import f", "a.x": "from . import g"}, [["a", "a.x"]]),
        ({"a.x": "from .y import f", "a.y": "from .z import f", "a.z": "from .x import f"}, [["a.x", "a.y", "a.z"]]),
        ({"a.x": "from ..b.y import f", "b.y": "from yid_ocp.a import x"}, [["a.x", "b.y"]]),
        (
            {
                "a.x": "from .y import f",
                "a.y": "from .x import f",
                "b.x": "from .y import f",
                "b.y": "from .x import f",
            },
            [["a.x", "a.y"], ["b.x", "b.y"]],
        ),
    ],
)
def test_the_check_for_circles_itself(files: dict[str, str], groups: list[list[str]]) -> None:
    packages = {name: [name] if f"{name}.x" in files else [name.split(".")[0]] for name in files}
    graph = {name: neighbours(source, packages[name], set(files)) for name, source in files.items()}
    assert circles(graph) == groups


@pytest.mark.parametrize(
    ("module", "source", "wrong"),
    [
        ("solvers.base", "from yid_ocp.problem.estimation_problem import _hidden", True),
        ("solvers.base", "from ..problem.problem import _hidden as shown", True),
        ("solvers.base", "from yid_ocp.problem._hidden import shown", True),
        ("solvers.base", "import yid_ocp.problem._hidden", True),
        ("solvers.base", "from yid_ocp.problem import problem\nproblem._hidden()", True),
        ("solvers.base", "import yid_ocp.problem.estimation_problem as p\np._hidden", True),
        ("solvers.base", "import yid_ocp.problem.estimation_problem\nyid_ocp.problem.problem._hidden", True),
        ("solvers.base", "def f():\n    from yid_ocp.problem.estimation_problem import _hidden", True),
        ("solvers.base", "from yid_ocp.solvers.initial_guess import _hidden", False),
        ("solvers.base", "from .transcription import _hidden", False),
        ("solvers.base", "from yid_ocp.problem.estimation_problem import shown\nself._hidden = shown", False),
        ("cli", "from yid_ocp import __version__", False),
        ("solvers.base", "from numpy import _core\n_core._hidden", False),
    ],
)
def test_the_check_for_underscore_names_itself(module: str, source: str, wrong: bool) -> None:
    parts, package = dotted(PACKAGE / f"{module.replace('.', '/')}.py")
    assert bool(private(source, parts, package)) is wrong

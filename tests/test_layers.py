"""Data flows one way: a module imports only from layers above its own, its own package, or the outside.

No two files import each other, directly or round about, and no package reaches for another's underscore names.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Set
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

NAME = "yid_ocp"
PACKAGE = Path(__file__).parents[1] / NAME
LAYERS = (
    ("errors", "version", "arrays"),
    ("registry",),  # it raises errors, so the two cannot share a layer
    ("options", "files", "least_squares", "interruption", "display"),
    ("parallel",), ("model",), ("effects", "sensors"), ("integrator",), ("data",), ("vision",), ("virtual",),
    ("problem",), ("inference",), ("solvers",), ("analysis",), ("diagnosis",), ("planning",), ("export", "report"),
    ("config",), ("workflow",), ("cli",), ("__main__",),
)  # fmt: skip
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
SOURCES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path.read_text("utf-8")
    for path in sorted(PACKAGE.rglob("*.py"))
    if path != PACKAGE / "__init__.py"
}


def imported(tree: ast.AST, at_import: bool = False) -> Iterator[tuple[str, str, str]]:
    """Name that it is bound to, module and name in it, of all that is imported from the package, without `yid_ocp.`.

    `at_import` leaves functions out: what remains runs when a module is imported, or stands under `if TYPE_CHECKING`.
    """
    for node in ast.iter_child_nodes(tree):
        found: list[tuple[str, str, str]] = []
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"line {node.lineno}: imports are written in full"
            found = [(alias.asname or alias.name, str(node.module), alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            found = [(alias.asname or alias.name.split(".")[0], alias.name, "") for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__"):
            found = [("", ast.unparse(node.args[0]).strip("'"), "")]
        for bound, module, name in found:
            if module == NAME:  # `from yid_ocp import model` imports a package
                yield bound, name, ""
            elif module.startswith(f"{NAME}."):
                yield bound, module.removeprefix(f"{NAME}."), name
        if not (at_import and isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))):
            yield from imported(node, at_import)


def violations(source: str, module: str) -> list[str]:
    """What a module imports from layers below or from its own layer's other packages; underscore names of others."""
    own, found, bound = module.split(".")[0], [], set()
    tree = ast.parse(source)
    for name, target, inner in imported(tree):
        top = target.split(".")[0]
        # the front door imports everything, so only its version may be asked for from inside
        if top in (own, "__version__"):
            continue
        bound.add(name)
        if RANK.get(top, len(LAYERS)) >= RANK[own]:
            found.append(f"{module} must not import {target}")
        if any(part.startswith("_") for part in (*target.split("."), inner)):
            found.append(f"{module} must not import {target}.{inner}")
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.endswith("__"):
            path = ast.unparse(node).split(".")
            if path[0] in bound and all(part.isidentifier() for part in path):
                found.append(f"{module} must not use {'.'.join(path)}")
    return found


def neighbours(source: str, modules: Set[str]) -> set[str]:
    """Modules that a file imports when it is imported itself, of those named."""
    targets = {(target, f"{target}.{name}") for _, target, name in imported(ast.parse(source), at_import=True)}
    # a name may be a module of the package or something that the package's own file defines
    return {whole if whole in modules else target for target, whole in targets} & modules


def circle(sources: Mapping[str, str]) -> list[str]:
    """Files that import each other, the first one once more at the end; empty without any."""
    try:
        TopologicalSorter({name: neighbours(source, set(sources)) for name, source in sources.items()}).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_two_files_import_each_other() -> None:
    assert circle(SOURCES) == []


@pytest.mark.parametrize("module", SOURCES)
def test_module_imports_from_the_left_only(module: str) -> None:
    assert module.split(".")[0] in RANK, f"say in LAYERS where '{module}' belongs"
    assert violations(SOURCES[module], module) == []


@pytest.mark.parametrize(
    ("module", "source", "wrong"),
    [
        ("registry", "from yid_ocp.errors import DataError", False),
        ("errors", "from yid_ocp.registry import Registry", True),
        ("solvers.base", "import yid_ocp.problem.estimation_problem", False),
        ("solvers.base", "from yid_ocp.solvers.initial_guess import _hidden", False),
        ("solvers.base", "from yid_ocp import analysis", True),
        ("solvers.base", "import yid_ocp", True),
        ("cli", "from yid_ocp import __version__", False),
        ("model.system", "def f():\n    from yid_ocp.effects import damping", True),
        ("model.system", "if TYPE_CHECKING:\n    from yid_ocp.effects import damping", True),
        ("model.system", "import importlib\nimportlib.import_module('yid_ocp.cli')", True),
        ("model.system", "from yid_ocpus import cli", False),
        ("data.readers", "from yid_ocp.unheard_of import x", True),
        ("solvers.base", "from yid_ocp.problem.estimation_problem import _hidden as shown", True),
        ("solvers.base", "from yid_ocp.problem import problem\nproblem._hidden()", True),
        ("solvers.base", "import yid_ocp.problem.problem\nyid_ocp.problem.problem._hidden", True),
        ("solvers.base", "from numpy import _core\n_core._hidden", False),
    ],
)
def test_the_check_itself(module: str, source: str, wrong: bool) -> None:
    assert bool(violations(source, module)) is wrong


@pytest.mark.parametrize(
    ("sources", "found"),
    [
        ({"a.x": "from yid_ocp.a.y import f", "a.y": "from yid_ocp.a.x import g"}, "a.x a.y"),
        ({"a.x": "def f():\n    import yid_ocp.a.y", "a.y": "import yid_ocp.a.x"}, ""),
        ({"a": "from yid_ocp.a.x import f", "a.x": "from yid_ocp.a import g"}, "a a.x"),
        ({"a.x": "import yid_ocp.a.y", "a.y": "import yid_ocp.a.z", "a.z": "import yid_ocp.a.x"}, "a.x a.y a.z"),
    ],
)
def test_the_check_for_circles_itself(sources: dict[str, str], found: str) -> None:
    assert set(circle(sources)) == set(found.split())

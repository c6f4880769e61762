"""Data flows one way: every module imports only from the layers above its own, from its own package, or the outside."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

NAME = "yid_ocp"
PACKAGE = Path(__file__).parents[1] / NAME
LAYERS = (
    ("errors",),
    ("registry",),  # it raises errors, so the two cannot share a layer
    ("options", "files", "least_squares"),
    ("parallel",),
    ("model",),
    ("effects", "sensors"),
    ("integrator",),
    ("data",),
    ("vision",),
    ("virtual",),
    ("problem",),
    ("solvers",),
    ("analysis",),
    ("diagnosis",),
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


@pytest.mark.parametrize("path", MODULES, ids=lambda path: ".".join(dotted(path)[0]))
def test_module_imports_from_the_left_only(path: Path) -> None:
    module, package = dotted(path)
    assert module[0] in RANK, f"say in LAYERS where '{module[0]}' belongs"
    assert violations(path.read_text(encoding="utf-8"), module, package) == []


@pytest.mark.parametrize(
    ("module", "source", "wrong"),
    [
        ("registry", "from yid_ocp.errors import DataError", False),
        ("errors", "from yid_ocp.registry import Registry", True),
        ("solvers.base", "import yid_ocp.problem.problem", False),
        ("solvers.base", "import numpy, yid_ocp.analysis", True),
        ("solvers.base", "from yid_ocp.solvers.transcription import nlp", False),
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

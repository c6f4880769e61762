"""Where a line can be broken, and how: Cosmic Ray's operators, less what no test can or should notice.

An operator is replaced by its like: + by -, * by /, a comparison by another one, `and` by `or`; a number moves by one;
a condition is negated, a loop left out, a decorator taken away. Left out by rule, since nothing that the program does
depends on them or since they only say something:

- annotations, type aliases, protocols, blocks under TYPE_CHECKING; what `dataclass` is called with;
- texts of errors (`raise`), of the log and of progress;
- our own assertions: `assert`, and the arguments `strict` and `check_finite`;
- numbers of threads, and caches of results (`functools.cache`).

At every place one change is drawn, and of all places as many as wanted, both by a hash of the seed, the text of the
line and the function that it stands in: an edit elsewhere changes neither.
"""

from __future__ import annotations

import ast
import hashlib
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cosmic_ray.ast
import cosmic_ray.mutating
import cosmic_ray.plugins
import parso.python.tree
import parso.tree

Place = tuple[int, int]

COMPARISONS = ("Eq", "NotEq", "Lt", "LtE", "Gt", "GtE")
ALIKE = {"Add": "Sub", "Sub": "Add", "Mul": "Div", "Div": "Mul", "Pow": "Mul", "Mod": "Div", "FloorDiv": "Mul"} | {
    "BitOr": "BitAnd",
    "BitAnd": "BitOr",
}
OPERATORS = (
    *(f"ReplaceBinaryOperator_{a}_{b}" for a, b in ALIKE.items()),
    *(f"ReplaceComparisonOperator_{a}_{b}" for a in COMPARISONS for b in COMPARISONS if a != b),
    "ReplaceComparisonOperator_Is_IsNot",
    "ReplaceComparisonOperator_IsNot_Is",
    "ReplaceUnaryOperator_Delete_USub",
    "ReplaceUnaryOperator_Delete_Not",
    "ReplaceUnaryOperator_Delete_Invert",
    "AddNot",
    "ReplaceTrueWithFalse",
    "ReplaceFalseWithTrue",
    "ReplaceAndWithOr",
    "ReplaceOrWithAnd",
    "ReplaceBreakWithContinue",
    "ReplaceContinueWithBreak",
    "ExceptionReplacer",
    "NumberReplacer",
    "RemoveDecorator",
    "ZeroIterationForLoop",
)
TOLD = ("log", "progress", "say", "tell", "_tell", "note")
"""Functions, or objects of functions, whose arguments are only read by people."""
GUARDS = ("strict", "check_finite", "max_workers")
BARE = ("dataclass", "cache", "runtime_checkable")


@dataclass(frozen=True)
class Mutant:
    """One change of one place.

    Attributes
    ----------
    file : str
        Below the repository.
    line : int
    first, last : int
        Lines of the statement, or of its head.
    at_import : bool
        Whether it stands outside all functions.
    was, becomes : str
        The line.
    operator : str
    occurrence : int
        Among all places of the file to which the operator applies.
    """

    file: str
    line: int
    first: int
    last: int
    at_import: bool
    was: str
    becomes: str
    operator: str
    occurrence: int

    def text(self, root: Path) -> str:
        """The whole file with the change."""
        return _mutated((root / self.file).read_text(encoding="utf-8"), self.operator, self.occurrence)


def drawn(root: Path, files: Sequence[str], seed: int, count: int) -> list[Mutant]:
    """So many mutants of some files, in the order of the draw.

    Parameters
    ----------
    root : Path
        The repository.
    files : sequence of str
        Below it.
    seed : int
    count : int
        Fewer where there are fewer places.
    """
    ranked: list[tuple[str, str, int, list[tuple[str, int]]]] = []
    for file in files:
        source = (root / file).read_text(encoding="utf-8")
        ranked += [(_hash(seed, file, where), file, line, options) for where, line, options in _places(source)]
    made: list[Mutant] = []
    for rank, file, line, options in sorted(ranked):
        if len(made) == count:
            break
        ordered = sorted(range(len(options)), key=lambda i, rank=rank: _hash(rank, i))
        for operator, occurrence in (options[i] for i in ordered):
            mutant = _mutant(root, file, line, operator, occurrence)
            if mutant is not None:
                made.append(mutant)
                break
    return made


def _hash(*parts: object) -> str:
    return hashlib.sha256("|".join(map(str, parts)).encode()).hexdigest()


def _operator(name: str) -> cosmic_ray.operators.operator.Operator:
    return cosmic_ray.plugins.get_operator(f"core/{name}")()


def _mutated(source: str, operator: str, occurrence: int) -> str:
    text = cosmic_ray.mutating.mutate_code(source, _operator(operator), occurrence)
    assert text is not None
    return str(text)


def _places(source: str) -> Iterator[tuple[str, int, list[tuple[str, int]]]]:
    """Every place: function, text of the line and column in words, the line's number, the changes that can be made."""
    lines = source.splitlines()
    silent = list(_silent(ast.parse(source)))
    owner = _owners(ast.parse(source))
    operators = {name: _operator(name) for name in OPERATORS}
    seen = dict.fromkeys(OPERATORS, 0)
    found: dict[tuple[Place, str], list[tuple[str, int]]] = {}
    for node in cosmic_ray.ast.ast_nodes(cosmic_ray.ast.get_ast(source)):
        for name, operator in operators.items():
            for begin, _ in operator.mutation_positions(node):
                occurrence, seen[name] = seen[name], seen[name] + 1
                if not any(a <= begin < b for a, b in silent) and _makes_sense(node, name):
                    found.setdefault((begin, name.split("_")[0]), []).append((name, occurrence))
    repeated: dict[str, int] = {}
    for ((line, column), family), options in sorted(found.items()):
        text = lines[line - 1]
        where = f"{owner.get(line, '')}|{text.strip()}|{column - (len(text) - len(text.lstrip()))}|{family}"
        repeated[where] = repeated.get(where, 0) + 1
        yield f"{where}|{repeated[where]}", line, options


def _makes_sense(node: parso.tree.NodeOrLeaf, operator: str) -> bool:
    """Whether a change is not that of a bare * in a parameter list, or of two texts compared by their order."""
    if isinstance(node, parso.python.tree.Operator):
        return node.parent.type not in ("parameters", "lambdef", "param")
    if operator.startswith("ReplaceComparisonOperator") and operator.rpartition("_")[2] not in ("Eq", "NotEq"):
        return not any(isinstance(part, parso.python.tree.String) for part in node.children)
    return True


def _silent(tree: ast.Module) -> Iterator[tuple[Place, Place]]:
    """Stretches of the source in which nothing is changed."""
    for node in ast.walk(tree):
        match node:
            case ast.arg(annotation=ast.expr() as part) | ast.AnnAssign(annotation=part):
                yield _stretch(part)
            case ast.Raise() | ast.Assert():
                yield _stretch(node)
            case ast.keyword(arg=name) if name in GUARDS:
                yield _stretch(node)
            case ast.Call(func=function) if _named(function) & set(TOLD):
                yield _stretch(node)
            case ast.Call(func=ast.Name(id="threadpool_limits") | ast.Attribute(attr="threadpool_limits")):
                yield _stretch(node)
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                yield _stretch(node)
            case ast.ClassDef(bases=bases) if any("Protocol" in _named(base) for base in bases):
                yield _stretch(node)
        if isinstance(node, ast.FunctionDef) and node.returns is not None:
            yield _stretch(node.returns)
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            for decorator in node.decorator_list:
                if _named(decorator.func if isinstance(decorator, ast.Call) else decorator) & set(BARE):
                    begin, end = _stretch(decorator)
                    yield (begin[0], 0), end
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript):
            yield _stretch(node)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.BinOp) and isinstance(node.value.op, ast.BitOr):
            yield _stretch(node)


def _named(node: ast.expr) -> set[str]:
    """Names in a dotted name."""
    if isinstance(node, ast.Attribute):
        return {node.attr} | _named(node.value)
    return {node.id} if isinstance(node, ast.Name) else set()


def _stretch(node: ast.AST) -> tuple[Place, Place]:
    return (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)  # type: ignore[attr-defined]


def _owners(tree: ast.Module) -> dict[int, str]:
    """Name of the innermost function or class around every line."""
    owner: dict[int, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            owner |= dict.fromkeys(range(node.lineno, (node.end_lineno or node.lineno) + 1), node.name)
    return owner


def _mutant(root: Path, file: str, line: int, operator: str, occurrence: int) -> Mutant | None:
    """The mutant, None where the change is no Python or no change."""
    source = (root / file).read_text(encoding="utf-8")
    text = _mutated(source, operator, occurrence)
    before = ast.parse(source)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            after = ast.parse(text)
            compile(text, file, "exec")
        except SyntaxError:
            return None
    if ast.dump(before) == ast.dump(after):
        return None
    old, new = source.splitlines(), text.splitlines()
    becomes = new[line - 1].strip() if len(new) == len(old) else "(gone)"
    first, last, at_import = _statement(before, line)
    return Mutant(file, line, first, last, at_import, old[line - 1].strip(), becomes, operator, occurrence)


def _statement(tree: ast.Module, line: int) -> tuple[int, int, bool]:
    """First and last line of the innermost statement, or statement's head, at a line; whether outside all functions."""
    first, last, inside = line, line, False
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or node.lineno):
            body = getattr(node, "body", None)
            head = node.end_lineno or node.lineno
            if body:
                head = max(node.lineno, body[0].lineno - 1)
                inside = inside or (isinstance(node, ast.FunctionDef) and line > head)
            if line <= head:
                first, last = node.lineno, head
    return first, last, not inside

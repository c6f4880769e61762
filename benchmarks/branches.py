"""Lines and branches on the way to a diagnosis' verdict.

    python benchmarks/branches.py [FILE ...]

A branch is an `if`, `elif`, conditional expression, `while` or condition of a comprehension, and a chain of `and` or
`or`, however long.
"""

from __future__ import annotations

import argparse
import ast
from pathlib import Path

import yid_ocp

JUDGEMENT = ("select", "verdict", "screening", "refit", "diagnose", "diagnosis_result", "sentences")


def count_branches(source: str) -> int:
    """Branches of a program's text."""
    total = 0
    for node in ast.walk(ast.parse(source)):
        total += isinstance(node, (ast.If, ast.IfExp, ast.While, ast.BoolOp))
        total += len(node.ifs) if isinstance(node, ast.comprehension) else 0
    return total


if __name__ == "__main__":
    folder = Path(yid_ocp.__file__).parent / "diagnosis"
    parser = argparse.ArgumentParser(description="Count lines and branches of the diagnosis' judgement.")
    parser.add_argument("files", nargs="*", type=Path, default=[folder / f"{name}.py" for name in JUDGEMENT])
    texts = {file.name: file.read_text() for file in parser.parse_args().files}
    rows = [(name, len(text.splitlines()), count_branches(text)) for name, text in texts.items()]
    rows.append(("together", *(sum(row[i] for row in rows) for i in (1, 2))))
    width = max(len(name) for name, *_ in rows)
    for name, lines, branches in (("file", "lines", "branches"), *rows):
        print(f"{name:{width}} {lines:>6} {branches:>9}")

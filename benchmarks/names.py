"""Public names and docstrings drawn at random, for a reader who has never seen the project.

    python benchmarks/names.py --seed 1 [--names 60] [--sentences 40]   print a draw
    python benchmarks/names.py --count                                  print how many public names each package has

The reader says what each name is without opening a file; somebody else grades the answers against the code (right,
half, wrong). A public name is a function, class or constant of a module, or a method or property of a public class,
without a leading underscore; settings are the keys of a configuration. Overridden methods count once for each class.
"""

from __future__ import annotations

import argparse
import ast
import collections
import random
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from yid_ocp.config.schema import config_json_schema

PACKAGE = Path(__file__).parents[1] / "yid_ocp"
Documented = ast.FunctionDef | ast.ClassDef


def assigned(node: ast.stmt) -> list[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return [target.id for target in targets if isinstance(target, ast.Name)]


def public(name: str) -> bool:
    return not name.startswith("_")


def definitions(path: Path) -> Iterator[tuple[str, Documented | None]]:
    """Public names of a file, `Class.member` for members, with what is defined where that has a docstring."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, Documented) and public(node.name):
            yield node.name, node
            if isinstance(node, ast.ClassDef):
                for member in node.body:
                    if isinstance(member, ast.FunctionDef) and public(member.name):
                        yield f"{node.name}.{member.name}", member
        for name in assigned(node):
            if public(name) and name != "log":
                yield name, None


def files() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def place(path: Path) -> str:
    return path.relative_to(PACKAGE.parent).as_posix()


def sentences() -> Iterator[str]:
    """First sentence of each docstring, with its place."""
    for path in files():
        for name, node in definitions(path):
            text = None if node is None else ast.get_docstring(node)
            if text:
                yield f"{place(path)}: {name}: {' '.join(text.split(chr(10) * 2)[0].split()).split('. ')[0]}"


def settings(described: Mapping[str, Any]) -> set[str]:
    """Dotted keys of a configuration; `*` for names that a user chooses."""
    found: set[str] = set()

    def walk(node: Any, prefix: str, depth: int) -> None:
        if not isinstance(node, Mapping) or depth > 12:
            return
        if "$ref" in node:
            target: Any = described
            for part in node["$ref"].removeprefix("#/").split("/"):
                target = target[part]
            walk(target, prefix, depth + 1)
        for key, value in node.get("properties", {}).items():
            found.add(f"{prefix}{key}")
            walk(value, f"{prefix}{key}.", depth + 1)
        for several in ("anyOf", "oneOf", "allOf"):
            for value in node.get(several, ()):
                walk(value, prefix, depth + 1)
        walk(node.get("items"), prefix, depth + 1)
        walk(node.get("additionalProperties"), f"{prefix}*.", depth + 1)

    walk(described, "", 0)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description="Public names and first sentences drawn at random.")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--names", type=int, default=60, help="names and settings")
    parser.add_argument("--sentences", type=int, default=40, help="first sentences of docstrings")
    parser.add_argument("--count", action="store_true", help="count public names by package instead")
    arguments = parser.parse_args()
    names = [(place(path), name) for path in files() for name, _ in definitions(path)]
    if arguments.count:
        rooms = collections.Counter(where.split("/")[1].removesuffix(".py") for where, _ in names)
        for room, number in rooms.most_common():
            print(f"{number:6d} {room}")
        print(f"{len(names):6d} in all, and {len(settings(config_json_schema()))} settings")
        return 0
    generator = random.Random(arguments.seed)
    pool = [f"{where}: {name}" for where, name in names] + [
        f"setting {key}" for key in sorted(settings(config_json_schema()))
    ]
    print(*generator.sample(sorted(pool), arguments.names), sep="\n")
    print()
    print(*generator.sample(sorted(sentences()), arguments.sentences), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

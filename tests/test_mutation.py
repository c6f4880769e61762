"""The mutation run: named breaks fit the sources, and mutants are drawn where something depends on them."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / "benchmarks" / "mutation"
BREAKS = YAML(typ="safe").load((FOLDER / "breaks.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("entry", BREAKS, ids=lambda entry: entry["what"])
def test_every_named_break_fits_one_place_and_is_python(entry):
    source = (REPOSITORY / "yid_ocp" / entry["file"]).read_text(encoding="utf-8")
    assert source.count(entry["old"]) == 1, f"write benchmarks/mutation/breaks.yaml anew for {entry['file']}"
    broken = source.replace(entry["old"], entry["new"])
    assert ast.dump(ast.parse(broken)) != ast.dump(ast.parse(source))
    assert (REPOSITORY / entry["tests"]).is_file()


def test_breaks_have_names_of_their_own():
    names = [entry["what"] for entry in BREAKS]
    assert len(set(names)) == len(names) >= 32


@pytest.fixture(scope="module")
def places():
    pytest.importorskip("cosmic_ray", reason="mutants are drawn with Cosmic Ray: pip install 'yid-ocp[dev]'")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        return importlib.import_module("places")


SOURCE = '''"""A module."""

from __future__ import annotations

import logging

Array = list[int | float]
LIMIT = 3
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Point:
    x: int | None = 4


def far(points: list[int] | None, *, least: float = 2.0) -> bool | None:
    """Whether any is."""
    assert points is not None and len(points) > 0
    log.info("at most %d", LIMIT - 1)
    if len(points) > 100:
        raise ValueError(f"{len(points) - 100} too many")
    return any(x * x > least for x, _ in zip(points, points, strict=True))
'''


def changes(places, folder, seed=1, count=100):
    (folder / "module.py").write_text(SOURCE, encoding="utf-8")
    return places.drawn(folder, ["module.py"], seed, count)


def test_nothing_is_changed_that_only_speaks_or_guards(places, tmp_path):
    found = changes(places, tmp_path)
    said = dict(enumerate(SOURCE.splitlines(), 1))
    assert {said[mutant.line] for mutant in found} == {
        "LIMIT = 3",
        "    x: int | None = 4",
        "def far(points: list[int] | None, *, least: float = 2.0) -> bool | None:",
        "    if len(points) > 100:",
        "    return any(x * x > least for x, _ in zip(points, points, strict=True))",
    }
    assert not any("strict" in mutant.becomes and "strict=True" not in mutant.becomes for mutant in found)
    assert all(ast.parse(mutant.text(tmp_path)) for mutant in found)
    for mutant in found:
        if mutant.was.startswith("return"):
            assert (mutant.first, mutant.last, mutant.at_import) == (mutant.line, mutant.line, False)
        assert mutant.at_import or not mutant.was.startswith(("LIMIT", "x:"))


def test_one_change_is_drawn_at_every_place_and_the_draw_is_fixed(places, tmp_path):
    texts = [mutant.text(tmp_path) for mutant in changes(places, tmp_path)]
    assert len(set(texts)) == len(texts)
    assert [m.text(tmp_path) for m in changes(places, tmp_path, count=3)] == texts[:3]
    assert [m.text(tmp_path) for m in changes(places, tmp_path, seed=2)] != texts

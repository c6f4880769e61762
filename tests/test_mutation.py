"""The mutation run: named breaks fit the sources, and mutants are drawn where something depends on them."""

import ast
from functools import cache
from pathlib import Path

import pytest
from ruamel.yaml import YAML

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / "benchmarks" / "mutation"
tree_of = cache(lambda source: ast.dump(ast.parse(source)))
BREAKS = YAML(typ="safe").load((FOLDER / "breaks.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("entry", BREAKS, ids=lambda entry: entry["what"])
def test_every_named_break_fits_one_place_and_is_python(entry):
    source = (REPOSITORY / "yid_ocp" / entry["file"]).read_text(encoding="utf-8")
    assert source.count(entry["old"]) == 1, f"write benchmarks/mutation/breaks.yaml anew for {entry['file']}"
    assert ast.dump(ast.parse(source.replace(entry["old"], entry["new"]))) != tree_of(source)
    assert (REPOSITORY / entry["tests"]).is_file()


def test_breaks_have_names_of_their_own():
    names = [entry["what"] for entry in BREAKS]
    assert len(set(names)) == len(names) >= 32


SOURCE = """
LIMIT = 3


def far(points: list[int]) -> bool:
    assert len(points) > 0
    log.info("at most %d", LIMIT - 1)
    if len(points) > 100:
        raise ValueError(f"{len(points) - 100} too many")
    return any(x * x > 2 for x, _ in zip(points, points, strict=True))
"""


def test_a_mutant_changes_what_something_depends_on_and_nothing_that_only_speaks_or_guards(tmp_path, monkeypatch):
    pytest.importorskip("cosmic_ray", reason="mutants are drawn with Cosmic Ray: pip install '.[dev]'")
    monkeypatch.syspath_prepend(str(FOLDER))
    import places

    (tmp_path / "module.py").write_text(SOURCE, encoding="utf-8")
    found = places.drawn(tmp_path, ["module.py"], 1, 100)
    assert {mutant.was for mutant in found} == {"LIMIT = 3", "if len(points) > 100:", SOURCE.splitlines()[-1].strip()}
    texts = [mutant.text(tmp_path) for mutant in found]
    assert all(map(ast.parse, texts))
    assert [mutant.text(tmp_path) for mutant in places.drawn(tmp_path, ["module.py"], 1, 3)] == texts[:3]
    assert all("strict=True" in text for text in texts)

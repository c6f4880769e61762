"""The JSON Schema that editors use."""

from __future__ import annotations

import runpy
from types import SimpleNamespace

import jsonschema
import pytest
from ruamel.yaml import YAML

from yid_ocp.config.reader import load_config
from yid_ocp.config.schema import config_json_schema
from yid_ocp.errors import ConfigError


@pytest.fixture(scope="module")
def maker(repository):
    """The script that makes `docs/settings.md`."""
    return SimpleNamespace(**runpy.run_path(str(repository / "docs" / "settings_page.py")))


@pytest.fixture(scope="module")
def rules():
    return jsonschema.Draft202012Validator(config_json_schema())


def test_the_page_in_the_docs_is_current(repository, maker):
    page = maker.page()
    told = "run  python docs/settings_page.py"
    assert (repository / "docs" / "settings.md").read_text(encoding="utf-8") == page, told
    for line in (
        "| `time_step` | of the integrator | a number above 0 up to 0.1 [s] | `0.01` |",
        "## solver, name: multiple_shooting",
        "## model.object.segments.NAME",
        "| `mass` | mass of the whole segment | a number above 0 [kg] | needed |",
    ):
        assert f"\n{line}\n" in page
    assert "known_initial_states" not in page
    titles = {line.removeprefix("## ") for line in page.splitlines() if line.startswith("## ")}
    assert titles == set(maker.EXAMPLES), "every section needs an example in docs/settings_page.py"


def test_every_example_of_the_page_can_be_read(maker, rules, written):
    for title, text in maker.EXAMPLES.items():
        try:
            load_config(written(text))
        except ConfigError as error:
            pytest.fail(f"{title}: {error}")
        rules.validate(YAML(typ="safe", pure=True).load(text))
        key = title.split(",")[0].split(".")[0]
        assert title == "The file" or f"{key}:" in text, title


def test_the_schema_accepts_every_configuration(repository, rules):
    rules.check_schema(rules.schema)
    files = sorted((repository / "configs").glob("*.yaml"))
    assert len(files) >= 5
    for file in files:
        rules.validate(YAML(typ="safe", pure=True).load(file.read_text()))
    described = rules.schema["properties"]["problem"]["properties"]["time_step"]
    assert (described["description"], described["default"]) == ("of the integrator [s]", 0.01)


@pytest.mark.parametrize(
    ("data", "valid"),
    [
        ({"sovler": {}}, False),
        ({"problem": {"time_step": "fast"}}, False),
        ({"problem": {"known_initial_states": {}}}, False),
        ({"model": {"object": {"kind": "cube"}}}, False),
        ({"model": {"object": {"links": 4}}}, False),
        ({"model": {"effects": [{"kind": "density"}]}}, False),
        ({"solver": {"max_iterations": -3}}, False),
        ({"solver": {"backtracking_factor": 0.3}}, False),
        ({"solver": {"name": "multiple_shooting", "first_trial_step": "last"}}, False),
        ({"compare": {"methods": {"gauss_newton": {"max_iterations": "abc"}}}}, False),
        ({"compare": {"methods": {"newton": {}}}}, False),
        ({"solver": {"name": "steepest_descent", "backtracking_factor": 0.3}}, True),
        ({"solver": {"max_iterations": 3}}, True),
        ({"compare": {"methods": {"gauss_newton": {"max_iterations": 3}, "multiple_shooting": {}}}}, True),
        ({"model": {"object": None}}, True),
    ],
)
def test_the_schema_refuses_typos(rules, data, valid):
    assert rules.is_valid(data) == valid

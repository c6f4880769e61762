"""The JSON Schema that editors use."""

from __future__ import annotations

import json

import jsonschema
import pytest
from ruamel.yaml import YAML

from yid_ocp.config.reader import load_config
from yid_ocp.config.schema import SETTINGS_EXAMPLES, config_json_schema, settings_markdown
from yid_ocp.errors import ConfigError


def test_the_one_beside_the_configurations_is_current(repository):
    kept = json.loads((repository / "configs" / "schema.json").read_text(encoding="utf-8"))
    assert kept == config_json_schema(), "regenerate it with  yid-ocp schema --out configs/schema.json"


def test_the_page_in_the_docs_is_current(repository):
    page = settings_markdown()
    assert (repository / "docs" / "settings.md").read_text(encoding="utf-8") == page, (
        "CONTRIBUTING.md says how to make it"
    )
    for line in (
        "| `time_step` | of the integrator | a number above 0 up to 0.1 [s] | `0.01` |",
        "## solver, name: multiple_shooting",
        "## model.object.segments.NAME",
        "| `mass` | mass of the whole segment | a number above 0 [kg] | needed |",
    ):
        assert f"\n{line}\n" in page
    assert "known_initial_states" not in page


def test_every_section_of_the_page_has_an_example_that_can_be_read(repository, tmp_path):
    page = (repository / "docs" / "settings.md").read_text(encoding="utf-8")
    titles = [line.removeprefix("## ") for line in page.splitlines() if line.startswith("## ")]
    assert set(titles) == set(SETTINGS_EXAMPLES), (
        "every section of docs/settings.md needs an example in config/settings_examples.py"
    )
    rules = config_json_schema()
    for title, text in SETTINGS_EXAMPLES.items():
        (tmp_path / "run.yaml").write_text(text)
        try:
            load_config(tmp_path / "run.yaml")
        except ConfigError as error:
            pytest.fail(f"{title}: {error}")
        jsonschema.validate(YAML(typ="safe", pure=True).load(text), rules)
        key = title.split(",")[0].split(".")[0]
        assert title == "The file" or f"{key}:" in text, title


def test_the_schema_accepts_every_configuration_and_refuses_typos(repository):
    rules = config_json_schema()
    jsonschema.Draft202012Validator.check_schema(rules)
    files = sorted((repository / "configs").glob("*.yaml"))
    assert len(files) >= 5
    for file in files:
        jsonschema.validate(YAML(typ="safe", pure=True).load(file.read_text()), rules)
    for wrong in (
        {"sovler": {}},
        {"problem": {"time_step": "fast"}},
        {"problem": {"known_initial_states": {}}},
        {"model": {"object": {"kind": "cube"}}},
        {"model": {"object": {"links": 4}}},
        {"model": {"effects": [{"kind": "density"}]}},
        {"solver": {"max_iterations": -3}},
        {"solver": {"backtracking_factor": 0.3}},
        {"solver": {"name": "multiple_shooting", "first_trial_step": "last"}},
        {"compare": {"methods": {"gauss_newton": {"max_iterations": "abc"}}}},
        {"compare": {"methods": {"newton": {}}}},
    ):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, rules)
    for right in (
        {"solver": {"name": "steepest_descent", "backtracking_factor": 0.3}},
        {"solver": {"max_iterations": 3}},
        {"compare": {"methods": {"gauss_newton": {"max_iterations": 3}, "multiple_shooting": {}}}},
        {"model": {"object": None}},
    ):
        jsonschema.validate(right, rules)
    described = rules["properties"]["problem"]["properties"]["time_step"]
    assert described["description"] == "of the integrator [s]"
    assert described["default"] == 0.01

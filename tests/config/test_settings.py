"""The settings: JSON Schema, page and examples; what they are without a file, and what is written back."""

import dataclasses
import re
import runpy
from types import SimpleNamespace

import jsonschema
import pytest
from ruamel.yaml import YAML

from yid_ocp.config.reader import load_config
from yid_ocp.config.schema import config_json_schema
from yid_ocp.config.settings import RunSettings, config_yaml_with_defaults
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.errors import ConfigError
from yid_ocp.model.objects import OBJECT_KINDS
from yid_ocp.model.objects.cable import CableOptions
from yid_ocp.problem import ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton

STEP_WORDS = "time step; auto halves 20 ms until halving it again hardly changes the prediction"


@pytest.fixture(scope="module")
def maker(repository):
    """The script that makes `docs/reference/settings.md`."""
    return SimpleNamespace(**runpy.run_path(str(repository / "docs" / "settings_page.py")))


@pytest.fixture(scope="module")
def rules():
    return jsonschema.Draft202012Validator(config_json_schema())


def test_the_page_in_the_docs_is_current(repository, maker):
    page = maker.page()
    told = "run  python docs/settings_page.py"
    assert (repository / "docs" / "reference" / "settings.md").read_text(encoding="utf-8") == page, told
    for line in (
        f"| `time_step` | {STEP_WORDS} | a number above 0 up to 0.1 [s] or auto | `0.01` |",
        "## solver, name: multiple_shooting",
        "## model.object.named_segments.NAME",
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
    assert (described["description"], described["default"]) == (f"{STEP_WORDS} [s]", 0.01)
    assert described["anyOf"][1]["const"] == "auto"


@pytest.mark.parametrize(
    ("data", "valid"),
    [
        ({"sovler": {}}, False),
        ({"problem": {"known_initial_states": {}}}, False),
        ({"model": {"object": {"kind": "cube"}}}, False),
        ({"model": {"effects": [{"kind": "density"}]}}, False),
        ({"solver": {"max_iterations": -3}}, False),
        ({"solver": {"name": "multiple_shooting", "first_trial_step_rule": "last"}}, False),
        ({"compare": {"methods": {"newton": {}}}}, False),
        ({"solver": {"name": "steepest_descent", "nonmonotone_memory": 3}}, True),
        ({"compare": {"methods": {"gauss_newton": {"max_iterations": 3}, "multiple_shooting": {}}}}, True),
        ({"model": {"object": None}}, True),
    ],
)
def test_the_schema_refuses_typos(rules, data, valid):
    assert rules.is_valid(data) == valid


def schema_keys(section, at=""):
    """Dotted names of all keys that a schema allows; `*` is a name that users choose."""
    for part in section.get("anyOf", []):
        yield from schema_keys(part, at)
    inner = {**section.get("properties", {}), "*": section.get("additionalProperties")}
    for name, part in [*inner.items(), ("", section.get("items"))]:
        if isinstance(part, dict):
            path = ".".join(filter(None, (at, name)))
            yield path
            yield from schema_keys(part, path)


def test_the_table_of_renamed_settings_leads_to_settings(repository, rules):
    table = re.findall(r"^\| ([\w ]+) \| `(.+?)` \| (.+) \|$", (repository / "CHANGELOG.md").read_text(), re.MULTILINE)
    settings, keys = {old: now for kind, old, now in table if kind == "setting"}, set(schema_keys(rules.schema))
    assert (len({row[:2] for row in table}), len(settings) > 200, keys & set(settings)) == (len(table), True, set())
    assert {now.split("`")[1].split(":")[0] for now in settings.values() if not now.startswith("removed")} <= keys


@pytest.mark.parametrize("name", ["dual_arm_vision", "baxter_arm", "panda_beam", "deft_bdlo1", "springs_torsion"])
def test_written_back_it_is_the_same_run(repository, tmp_path, name):
    run = load_config(repository / "configs" / f"{name}.yaml")
    (tmp_path / f"{name}.yaml").write_text(config_yaml_with_defaults(run))
    assert load_config(tmp_path / f"{name}.yaml") == run


def test_written_back_every_setting_is_there(written):
    text = "solver: {name: single_shooting, max_iterations: 3}\n"
    text += "track: {options: {filters: {max_depth_behind_robot_base: null}}}"
    run = load_config(written(f"{text}\ncompare: {{methods: {{single_shooting: {{cost_tolerance: 2}}}}}}\n"))
    told = YAML(typ="safe", pure=True).load(config_yaml_with_defaults(run))
    assert told["solver"] == {"name": "single_shooting", "max_iterations": 3, "cost_tolerance": 1e-9}
    assert told["compare"]["methods"] == {"single_shooting": {"max_iterations": 200, "cost_tolerance": 2}}
    assert told["problem"]["time_step"] == 0.01
    assert told["track"]["options"]["filters"]["max_depth_behind_robot_base"] is None
    assert not {"duration", "known_initial_states"} & set(told["problem"])
    assert not {"name", "config_file", "key_locations"} & set(told)
    assert load_config(written(config_yaml_with_defaults(run))) == run


def test_sections_are_what_their_users_take(written):
    text = "problem: {path_cutoff: 3}\ndiagnosis: {max_effects: 1}\nsensors: {points: {std: 0.1}}\n"
    run = load_config(written(text))
    assert isinstance(run.problem, ProblemOptions)
    assert run.problem.path_cutoff == 3.0
    assert isinstance(run.diagnosis, Thresholds)
    assert (run.diagnosis.max_effects, run.diagnosis.significance_level) == (1, Thresholds().significance_level)
    assert run.sensors["points"] == SensorOptions(std=0.1)


def test_no_section_repeats_the_options_of_another_package():
    run = RunSettings()
    sections = type(run.problem), type(run.diagnosis), OBJECT_KINDS["cable"]
    for section, options in zip(sections, (ProblemOptions, Thresholds, CableOptions), strict=True):
        assert not set(section.__annotations__) & {field.name for field in dataclasses.fields(options)}


def test_an_empty_file_is_all_defaults(written):
    run = load_config(written(""))
    assert (run.model.object, run.model.damping, run.solver) == (None, 0.05, GaussNewton())

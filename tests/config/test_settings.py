"""What the settings are without a file, and what is written back."""

from __future__ import annotations

import dataclasses

import pytest
from ruamel.yaml import YAML

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import DiagnosisSettings, ProblemSettings, dump_config
from yid_ocp.diagnosis import Thresholds
from yid_ocp.model.objects.cable import Cable, CableOptions
from yid_ocp.problem import ProblemOptions, SensorOptions
from yid_ocp.solvers import GaussNewton


@pytest.mark.parametrize("name", ["dual_arm_vision", "baxter_arm", "panda_beam", "deft_bdlo1", "springs_torsion"])
def test_written_back_it_is_the_same_run(repository, tmp_path, name):
    run = load_config(repository / "configs" / f"{name}.yaml")
    (tmp_path / f"{name}.yaml").write_text(dump_config(run))
    assert load_config(tmp_path / f"{name}.yaml") == run


def test_written_back_every_setting_is_there(written):
    text = (
        "solver: {name: single_shooting, max_iterations: 3}\n"
        "compare: {methods: {single_shooting: {cost_tolerance: 2}}}\n"
        "track: {options: {filters: {max_depth_behind_base: null}}}\n"
    )
    run = load_config(written(text))
    told = YAML(typ="safe", pure=True).load(dump_config(run))
    assert told["solver"] == {"name": "single_shooting", "max_iterations": 3, "cost_tolerance": 1e-9}
    assert told["compare"]["methods"] == {"single_shooting": {"max_iterations": 200, "cost_tolerance": 2}}
    assert told["problem"]["time_step"] == 0.01
    assert told["track"]["options"]["filters"]["max_depth_behind_base"] is None
    assert "duration" not in told["problem"]
    assert set(told) & {"name", "config_file", "key_locations"} == set()
    assert "known_initial_states" not in told["problem"]
    assert load_config(written(dump_config(run))) == run


def test_sections_are_what_their_users_take(written):
    run = load_config(
        written("problem: {path_cutoff: 3}\ndiagnosis: {max_effects: 1}\nsensors: {points: {std: 0.1}}\n")
    )
    assert isinstance(run.problem, ProblemOptions)
    assert run.problem.path_cutoff == 3.0
    assert isinstance(run.diagnosis, Thresholds)
    assert (run.diagnosis.max_effects, run.diagnosis.significance_level) == (1, Thresholds().significance_level)
    assert run.sensors["points"] == SensorOptions(std=0.1)


def test_no_section_repeats_the_options_of_another_package():
    for section, options in (
        (ProblemSettings, ProblemOptions),
        (DiagnosisSettings, Thresholds),
        (Cable, CableOptions),
    ):
        own = section.__annotations__
        assert not set(own) & {field.name for field in dataclasses.fields(options)}


def test_an_empty_file_is_all_defaults(written):
    run = load_config(written(""))
    assert run.model.object is None
    assert run.model.damping == 0.05
    assert run.solver == GaussNewton()

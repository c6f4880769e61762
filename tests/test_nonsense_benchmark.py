"""A part of `benchmarks/nonsense.py`: wrong recordings are named with their cause, shipped ones are not in doubt."""

from functools import cache

import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.workflow.build import build_step
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.run_inputs import resolve_recording_path

QUICK = {
    "single_arm_vision": ["effort x 0.1", "gap of 2 s", "camera mirrored", "wrist angles x 20", "a link renamed"],
    "dual_arm_vision": ["grippers exchanged"],
    "baxter_arm": ["effort flipped", "10 x fast", "stuck encoder", "clock in ms", "another robot held out"],
    "panda_beam": ["effort x 0.1", "saturated effort"],
    "deft_bdlo1": ["upside down"],
}
SLOW = pytest.mark.slow
CONFIGS = [pytest.param(name, marks=SLOW if name == "deft_bdlo1" else ()) for name in sorted(QUICK)]
CASES = [
    pytest.param(config.values[0], name, marks=config.marks) for config in CONFIGS for name in QUICK[config.values[0]]
]


@pytest.fixture(scope="module")
def benchmark(benchmark_module):
    return benchmark_module("nonsense")


@pytest.fixture(scope="module")
def step_of(repository):
    """step_of(config): the step of a configuration's model, for all of its cases."""

    @cache
    def build(config):
        return build_step(load_config(repository / "configs" / f"{config}.yaml"))

    return build


def test_there_are_at_least_forty_cases_each_with_a_name_of_its_own(benchmark):
    names = [(case.config, case.name) for case in benchmark.cases()]
    assert len(set(names)) == len(names) >= 40
    assert {config for config, _ in names} == set(QUICK)
    assert {(config, name) for config, some in QUICK.items() for name in some} <= set(names)


@pytest.mark.parametrize(("config", "name"), CASES)
def test_a_wrong_recording_is_named(benchmark, step_of, tmp_path, config, name):
    case = next(case for case in benchmark.cases() if (case.config, case.name) == (config, name))
    if benchmark.clean_recording(case) is None:
        pytest.skip(f"its recording is not here: {benchmark.REAL[config]}")
    # what a cable is made of comes from its recording
    step = None if config == "deft_bdlo1" else step_of(config)
    entry = benchmark.tried(case, tmp_path, solving=False, step=step)
    assert entry["named"], entry


EXACT = [pytest.param(name, True, id=f"{name}, exact torques") for name in ("single_arm_vision", "dual_arm_vision")]


@pytest.mark.parametrize(
    ("config", "exact"), [*(pytest.param(*c.values, False, marks=c.marks) for c in CONFIGS), *EXACT]
)
def test_shipped_recordings_are_not_in_doubt(repository, step_of, clean, config, exact):
    roles = ("estimate", "held_out") if exact else ()
    files = [f"recordings.{role}=[{clean / config}_{role}.h5]" for role in roles]
    run = load_config(repository / "configs" / f"{config}.yaml", files)
    files = [resolve_recording_path(path) for path in (*run.recordings.estimate, *run.recordings.held_out)]
    missing = [file for file in files if not file.is_file()]
    if missing:
        pytest.skip(f"its recordings are not here: {missing[0]}")
    assert build_problem(run, step_of(config)).options.data_issues == ()


@SLOW
def test_nine_of_ten_wrong_recordings_are_named_and_nothing_is_found_on_the_others(benchmark, tmp_path):
    here = [case for case in benchmark.cases() if benchmark.clean_recording(case) is not None]
    entries = [benchmark.tried(case, tmp_path / str(i)) for i, case in enumerate(here)]
    assert sum(entry["named"] for entry in entries) >= 0.9 * len(entries)
    assert not any(entry["found"] for entry in entries if not entry.get("harmless"))
    assert not any(entry.get("wrong") for entry in entries)

"""The command `diagnose`: run folder and words, interrupted runs, kept refits, noise scaled to a fraction."""

import json
from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from ruamel.yaml import YAML
from small_problems import pendulum_step

from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.diagnosis.refit import StoredFit
from yid_ocp.display import Progress
from yid_ocp.errors import ConfigError
from yid_ocp.inference.uncertainty import value_and_uncertainty_text
from yid_ocp.inference.whitening import problem_with_whitening_at, torque_biases_and_stds_per_recording
from yid_ocp.problem import EstimationProblem, ProblemOptions, SensorOptions
from yid_ocp.report.terminal import summary_blocks, summary_terminal_lines
from yid_ocp.workflow import diagnose as command
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.diagnose import _SingleJsonFileRefitStore, _with_noise_only_stds, run_diagnose
from yid_ocp.workflow.prediction_outputs import has_unused_efforts
from yid_ocp.workflow.run_folder import atomic_run_folder


def without_times(folder) -> dict:
    result = json.loads((folder / "result.json").read_text())
    result["to_use"].pop("export")  # names the folder
    return {name: value for name, value in result.items() if name not in ("seconds", "command", "date", "inputs")}


def close(one, other) -> bool:
    """Equal but for the rounding of a rollout that begins from another guess."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(close(one[name], other[name]) for name in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(close, one, other))
    return one == (pytest.approx(other, rel=1e-6, abs=1e-9) if isinstance(one, float) else other)


def counting(patch):
    """How often a refit is solved."""
    calls, module = SimpleNamespace(count=0), import_module("yid_ocp.diagnosis.refit")
    solved = module._attempt

    def counted(*arguments):
        calls.count += 1
        return solved(*arguments)

    patch.setattr(module, "_attempt", counted)
    return calls


class Interrupting(Progress):
    """Progress that presses Ctrl-C after so many refits."""

    def __init__(self, after: int) -> None:
        self.left = after

    def report_parts_done(self, done: int, total: int, text: str) -> None:
        self.left -= text.startswith("held-out chi2/n with")
        if self.left <= 0:
            raise KeyboardInterrupt


@pytest.fixture(scope="module")
def whole(rubbing, tmp_path_factory):
    """A whole diagnosis, and how often the solver of refits was called."""
    with pytest.MonkeyPatch.context() as patch:
        calls = counting(patch)
        return run_diagnose(load_config(rubbing), tmp_path_factory.mktemp("whole") / "run"), calls.count


def test_an_interrupted_diagnosis_resumes_its_finished_refits(rubbing, whole, tmp_path, monkeypatch, caplog):
    run, counted, (uninterrupted, once) = load_config(rubbing), counting(monkeypatch), whole
    with pytest.raises(KeyboardInterrupt):
        run_diagnose(run, tmp_path / "run", Interrupting(after=1))
    done, counted.count = counted.count, 0
    assert 0 < done <= once
    assert "The same command reuses them" in caplog.text
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith("run")] == ["run.partial"]
    again = run_diagnose(run, tmp_path / "run")
    assert counted.count == once - done
    assert close(without_times(again.folder), without_times(uninterrupted.folder))
    lines = [json.loads(line) for line in (again.folder / "log.jsonl").read_text().splitlines()]
    assert {"the nominal model at 0.01 s"} < {line["refit"] for line in lines if line["event"] == "resumed"}
    assert not (tmp_path / "run.partial").exists()
    assert not list(tmp_path.glob(".*"))


def test_a_spent_budget_leaves_a_whole_run_folder_that_says_so(rubbing, whole, tmp_path):
    settings = ["diagnosis.budget=1e-9", "output.write_report=true"]
    hurried = run_diagnose(load_config(rubbing, settings), tmp_path / "run")
    assert whole[0].result["untried"] == []
    result = json.loads((hurried.folder / "result.json").read_text())
    assert (result["verdict"], result["effects"]) == ("unknown", [])
    assert result.keys() == json.loads((whole[0].folder / "result.json").read_text()).keys()
    said = f"s): {result['untried'][0]}"
    assert said in result["summary"]
    assert said in (hurried.folder / "report.html").read_text("utf-8")
    assert load_config(hurried.folder / "config.yaml").diagnosis.budget == 1e-9
    both = [{path.name for path in run.folder.iterdir()} for run in (hurried, whole[0])]
    assert both[0] == both[1] | {"report.html"}
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_changed_configuration_resumes_nothing(rubbing, tmp_path, monkeypatch, caplog):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        run_diagnose(load_config(rubbing), None, Interrupting(after=1))
    assert (tmp_path / "runs" / "rubbing-diagnose.partial" / "refits.json").is_file()
    caplog.clear()
    with pytest.raises(KeyboardInterrupt):
        run_diagnose(load_config(rubbing, ["diagnosis.significance_level=0.02"]), None, Interrupting(after=1))
    assert sum("fitted again" in record.getMessage() for record in caplog.records) == 1


def test_the_result_says_how_sure_a_closure_is_and_where_the_unknown_forces_are(rubbing, whole):
    outcome = whole[0]
    assert outcome.result["command"] == f"yid-ocp diagnose {rubbing}"
    assert outcome.result["effects"] == [{"kind": "joint_coulomb", "location": "elbow"}]
    refitted = [entry for entry in outcome.result["which"] if entry["closure"] is not None]
    assert refitted
    for entry in refitted:
        low, high = entry["closure_ci"]
        assert low <= high
    unknown = [entry["closure_ci"] for entry in outcome.result["which"] if entry["closure"] is None]
    assert all(ends == [None, None] for ends in unknown)
    with h5py.File(outcome.folder / "trajectories.h5") as file:
        group = file["where/estimate"]
        names = list(group.attrs["unknowns"])
        assert group["mean"].shape == group["std"].shape == (len(group["edges"]) - 1, len(names))
        assert list(group.attrs["units"]) == ["N m"] * len(names)
        assert set(group.attrs["kinds"]) == {"force"}
        elbow = names.index("elbow")
        assert group.attrs["locations"][elbow] == "elbow"
        assert group["prior"][elbow] > 0
        # friction of 0.03 N m, part of which the damping takes for itself
        assert 0.005 < np.max(np.abs(group["mean"][:, elbow])) < 0.06


def test_the_command_that_gives_a_result_again(rubbing, tmp_path, monkeypatch):
    (here := tmp_path / "here").mkdir()
    monkeypatch.chdir(here)
    changed = load_config(rubbing, ["diagnosis.significance_level=0.02"])
    embedded = load_config(None, (), SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME)
    # another command has another embedded configuration, so the folder's is named
    for settings, out, near in ((changed, "runs/a b", "'runs/a b"), (embedded, "../a", f"{tmp_path}/a")):
        with atomic_run_folder(settings, out) as folder:
            folder.record_run_start(settings, "diagnose")
            written = folder.write_result({})["command"].removesuffix("'")
        assert written == f"yid-ocp diagnose {near}/config.yaml"


def test_a_baseline_of_the_command_line_has_its_option_as_place(rubbing, monkeypatch):
    given = []
    monkeypatch.setattr(command, "run_command_and_print", lambda _, work: work(None))
    monkeypatch.setattr(command, "run_diagnose", lambda run, *_: given.append(run))
    for overrides, flags in (([], ["--baseline"]), (["diagnosis.budget=60"], [])):
        arguments = SimpleNamespace(config=rubbing, overrides=overrides, baseline=["earlier"], out=None)
        command.run_and_return_exit_code(arguments)
        assert given[-1].setting_location("diagnosis", "baseline_run_folders") == "--baseline"
        assert command._flags(given[-1])[:1] == flags, "an overridden configuration is kept with its baseline"
    with pytest.raises(ConfigError) as caught:
        run_diagnose(load_config(rubbing, ["diagnosis.candidates=[friction]"]))
    assert "joint_coulomb" in caught.value.allowed.split(" and ")[0]


@pytest.mark.parametrize("spoil", ["nothing", "inputs", "version", "half a file", "other text"])
def test_kept_refits_count_only_for_what_they_were_made_from(spoil, rubbing, tmp_path, caplog):
    made_from = [{"a.h5": "12"}, "a: 1", {"yid-ocp": "1.0"}]
    refitted = StoredFit({"b": 0.1 + 0.2}, {"b": float("inf")}, {"b": 0.1})
    with atomic_run_folder(load_config(rubbing), tmp_path / "run") as folder:
        first = _SingleJsonFileRefitStore(folder, *made_from)
        first["joint_coulomb@elbow"] = refitted
        if spoil == "inputs":
            made_from[0] = {"a.h5": "34"}
        elif spoil == "version":
            made_from[2] = {"yid-ocp": "1.1"}
        elif spoil == "half a file":
            first.file.write_text(first.file.read_text()[:40])
        elif spoil == "other text":
            first.file.write_text("[1, 2]")
        second = _SingleJsonFileRefitStore(folder, *made_from)
        assert second.get("joint_coulomb@elbow") == (refitted if spoil == "nothing" else None)
        assert second.get("joint_viscous@elbow") is None
        assert len(caplog.records) == (0 if spoil == "nothing" else 1)
        folder.delete_resume_data(second.file)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


SHARE = 0.25
STATED = {
    "points": SensorOptions(std=0.02),
    "joints.effort": SensorOptions(std={"shoulder": 0.3}, bias_std=0.4),
    "joints.position": SensorOptions(std=1e-3),
}

MOVED = {"path_cutoff": np.inf, "initial_state": "estimated", "weak_prior_geometric_std": 7.0, "huber_threshold": 1.5}


@pytest.fixture(scope="module")
def problem_of(urdf_folder):
    """problem_of(role, sensors, ...): a pendulum whose shoulder is driven or prescribed, seen by its tip."""
    steps = {role: pendulum_step(urdf_folder, **{role: ("shoulder",)}) for role in ("driven", "prescribed")}

    def build(role, sensors=STATED, position_std=1e-3, **changed):
        t = 0.01 * np.arange(41)
        noise = {"effort_std": 0.05, "position_std": position_std}
        if role == "driven":
            noise["effort_bias_std"] = 0.1
        else:
            sensors = {name: replace(entry, bias_std=None) for name, entry in sensors.items()}
        angle, torque = 0.1 * np.sin(9 * t[:, None]), 1.0 + 0.3 * np.sin(9 * t[:, None])
        joints = JointGroup(("shoulder",), t, angle, effort=torque, **noise)
        tip = np.tile([0.0, 0.1, 0.4], (41, 1, 1)) + 0.02 * np.random.default_rng(1).standard_normal((41, 1, 3))
        recording = Recording(joints, (PointGroup("points", ("tip",), t, tip, 0.01),), name="made")
        own = {"sensors": sensors, "prior_stds": {"elbow.rest": 0.05}} | (MOVED if role == "prescribed" else {})
        options = ProblemOptions(**own | changed)
        return EstimationProblem(steps[role], [recording], ("elbow.stiffness", "elbow.rest"), options)

    return build


SETTINGS = SimpleNamespace(
    diagnosis=SimpleNamespace(noise_fraction_of_stated_std=SHARE),
    config_error=lambda what, *where, **more: ConfigError(what, where=".".join(where), **more),
)


@pytest.mark.parametrize("encoders", [False, True])
def test_errors_of_torques_shrink_like_all_other_noise(problem_of, encoders):
    position = replace(STATED["joints.position"], use=True if encoders else None)
    problem = problem_of("driven", STATED | {"joints.position": position})
    shrunk = _with_noise_only_stds(problem, SETTINGS)
    x = problem.initial_unknowns * 1.1
    both = [problem_with_whitening_at(made, x, rounds=2) for made in (problem, shrunk)]
    before, after = (made.evaluate(x) for made in both)
    assert all(made.whitening_filters[0] is not None for made in both)
    np.testing.assert_allclose(after.residual, before.residual / SHARE, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(after.jacobian, before.jacobian / SHARE, rtol=1e-6, atol=1e-6)
    (value, std), (smaller_value, smaller_std) = (torque_biases_and_stds_per_recording(made, x)[0] for made in both)
    np.testing.assert_allclose(smaller_value, value, rtol=1e-6)
    np.testing.assert_allclose(smaller_std, SHARE * std, rtol=1e-6)


def test_every_row_is_so_many_times_larger_and_the_fit_the_same(problem_of):
    problem = problem_of("prescribed")
    shrunk = _with_noise_only_stds(problem, SETTINGS)
    rows = problem.residual_rows
    assert shrunk.residual_rows == rows
    assert shrunk.options.stated_std_factor == SHARE
    assert [part.stop - part.start for part in (rows.stated_priors, rows.weak_priors)] == [3, 1]
    for seed in range(3):
        apart = np.random.default_rng(seed).uniform(-0.3, 0.3, len(problem.initial_unknowns))
        x = problem.initial_unknowns + problem.unknown_scales * apart
        one, other = problem.evaluate(x), shrunk.evaluate(x)
        np.testing.assert_allclose(other.residual, one.residual / SHARE, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(other.jacobian, one.jacobian / SHARE, rtol=1e-9, atol=1e-9)
        assert other.cost == pytest.approx(one.cost / SHARE**2)


def test_no_weak_prior_stays_none_and_encoders_without_noise_need_none(problem_of):
    sensors = {"points": STATED["points"], "joints.effort": SensorOptions(std=0.3)}
    shrunk = _with_noise_only_stds(problem_of("prescribed", sensors, None, weak_prior_geometric_std=0.0), SETTINGS)
    assert shrunk.options.weak_prior_geometric_std == 0.0
    assert shrunk.options.sensors["joints.effort"] == SensorOptions(std=0.3 * SHARE)


def test_recorded_torques_that_nothing_uses_are_told(problem_of):
    unused = {**STATED, "joints.effort": replace(STATED["joints.effort"], use=False)}
    cases = [("prescribed", unused), ("prescribed", STATED), ("driven", unused)]
    assert [has_unused_efforts(problem_of(role, sensors)) for role, sensors in cases] == [True, False, False]
    result = {"summary": "", "verdict": "no_gap", "next_plan": None, "seconds": {}, "which": [], "unused_efforts": True}
    result |= {"format": "yid-diagnosis/2", "gap": {"before": {"rmse": {}, "unit": {}}}}
    blocks = summary_blocks(result)
    assert any("set sensors.joints.effort.use: true" in line for line in summary_terminal_lines(blocks))


@pytest.mark.parametrize(
    ("role", "group", "entry", "missing"),
    [
        ("driven", "joints.effort", SensorOptions(bias_std=0.4), "std"),
        ("driven", "joints.effort", SensorOptions(std=0.2), "bias_std"),
        ("driven", "joints.position", SensorOptions(), "std"),
        *(("prescribed", group, SensorOptions(), "std") for group in STATED),
    ],
)
def test_a_fraction_of_what_is_not_stated_is_refused(problem_of, role, group, entry, missing):
    with pytest.raises(ConfigError, match=f"needs sensors.{group}.{missing}, which is not set"):
        _with_noise_only_stds(problem_of(role, STATED | {group: entry}), SETTINGS)


def test_a_diagnosis_leaves_a_run_folder(carried_out, pendulum):
    settings = ("diagnosis.candidates=[joint_coulomb, link_mass@elbow]", "output.write_report=false")
    done = carried_out("diagnose", pendulum, settings=settings)
    assert (done.result["format"], done.result["verdict"]) == ("yid-diagnosis/2", "no_gap")
    assert "Verdict: no gap" in done.out
    assert {"config.yaml", "log.jsonl", "trajectories.h5"} <= {path.name for path in done.folder.iterdir()}
    with h5py.File(done.folder / "trajectories.h5") as file:
        group = file[f"{done.result['gap']['held_out'][0]}/joints.effort"]
        assert group["before"].shape == group["after"].shape == group["measured"].shape


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("diagnosis.candidates=[joint_colomb@elbow]", "where: --set diagnosis.candidates"),
        ("diagnosis.candidates=[kelvin_voigt]", "kelvin_voigt is not possible for this model"),
        ("diagnosis.noise_fraction_of_stated_std=0.1", "set sensors.joints.effort.std"),
    ],
)
def test_what_cannot_be_diagnosed_is_said(printed, pendulum, tmp_path, setting, said):
    assert said in printed("diagnose", pendulum, "--out", tmp_path / "run", "--set", setting, code=2)
    assert not (tmp_path / "run").exists()


def test_a_deviation_that_is_mostly_the_models_error(carried_out, pendulum):
    """Deviations ten times the noise, of which a tenth is noise, are the noise again."""
    chosen = ("diagnosis.candidates=[joint_coulomb]", "output.write_report=false")
    found = []
    for std, share in ((0.01, 1.0), (0.1, 0.1)):
        settings = (f"sensors.joints.effort.std={std}", f"diagnosis.noise_fraction_of_stated_std={share}", *chosen)
        done = carried_out("diagnose", pendulum, settings=settings, out=f"run_{share}")
        found.append(done.result["gap"]["before"]["chi2_per_dof"])
    assert found[1] == pytest.approx(found[0], rel=0.01)


def merged(one: dict, other: dict) -> dict:
    return one | {k: merged(one[k], v) if isinstance(v, dict) and k in one else v for k, v in other.items()}


def test_what_is_found_is_told_as_text_that_a_configuration_takes(rubbing, whole, tmp_path, cli):
    """The numbers of a diagnosis and of the chosen friction law, where the model has neither effect nor law."""
    both = ", ".join(str(rubbing.with_name(f"{name}.h5")) for name in ("estimate", "held_out"))
    settings = ["recordings.held_out=[]", f"recordings.estimate=[{both}]", "output.write_report=true"]
    settings.append("model.friction={law: viscous, sign_smoothing_speed: 0.003}")
    done = cli("friction", rubbing, "--out", tmp_path / "law", settings=settings)
    law, diagnosis = json.loads((tmp_path / "law" / "result.json").read_text()), whole[0].result
    for result in (law, diagnosis):
        use, reader = result["to_use"], YAML(typ="safe")
        assert "elbow.tau_c = " in use["values"][-1]
        assert "frictionloss=" in use["mjcf"][-1]
        told = summary_terminal_lines(summary_blocks(result))
        assert {*use["values"], *use["mjcf"]} <= {line.strip() for line in told}
        with (tmp_path / "merged.yaml").open("w") as file:
            reader.dump(merged(reader.load(rubbing), reader.load("\n".join(use["yaml"]))), file)
        known = build_system(load_config(tmp_path / "merged.yaml")).parameters
        for name, value in (line.split(" = ") for line in use["values"]):
            assert known[name].value == pytest.approx(float(value.split()[0]), rel=1e-3)
    assert "sign_smoothing_speed: 0.003" in law["to_use"]["yaml"][1]
    fit = law["laws"][law["warranted"]]["parameters"]
    assert law["friction_parameters"] == [name for name in fit if name != "shoulder.stiffness"]
    page = (tmp_path / "law" / "report.html").read_text("utf-8")
    assert "<h3>To use these numbers</h3>" in page.partition('id="numbers"')[2]
    first_screen = page.partition('id="scene"')[0]
    shown = value_and_uncertainty_text(fit["elbow.damping"]["value"], fit["elbow.damping"]["std"])
    assert shown in first_screen
    assert shown in done.out

"""Estimates with finer links and shorter steps."""

import re
from dataclasses import replace
from functools import partial

import pytest
from made_cross import TRUTH, configuration, record

import yid_ocp as yid
from yid_ocp.analysis.discretisation import stds_with_discretisation_and_encoder_errors
from yid_ocp.config.reader import load_config
from yid_ocp.report.terminal import summary_blocks, summary_terminal_lines
from yid_ocp.virtual.injected import InjectedEffect
from yid_ocp.workflow.solve import run_solve

pytest.importorskip("mujoco", reason="virtual experiments need MuJoCo: pip install '.[blind]'")
WHOLE = ("north", "south", "east", "west")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One branch, recorded."""
    made = tmp_path_factory.mktemp("branch")
    record(made, ["north"], duration=0.8)
    return made


def judged(result, links):
    """Relative error, its standard deviation alone and with discretisation, of every free parameter."""
    found = {}
    for name, truth in TRUTH.items():
        if name in result["parameters"]:
            entry, moved = result["parameters"][name], result["discretisation"][name]
            scale = truth * links / 4
            found[name] = ((entry["value"] - scale) / scale, moved["std"] / scale, entry["std"] / scale, entry)
    return found


@pytest.fixture(scope="module")
def coarse(folder):
    """A branch of twelve links estimated with four: the file, and the result of `solve`."""
    file = configuration(folder, 4, ["north"], 1.5)
    return file, run_solve(load_config(file), folder / "run").result


def test_too_few_links_are_told_and_counted(coarse):
    """A quarter too stiff, known from the data to half a percent."""
    error, alone, counted, entry = judged(coarse[1], 4)["north.bend"]
    assert error > 0.15
    assert alone < 0.02
    assert error < 2 * counted
    # the data show it as well: the model does not explain them
    assert entry["verdict"] == "not_trusted"
    # with twice the links it is nearer to the truth by what is said
    assert -error < coarse[1]["discretisation"]["north.bend"]["links"] / TRUTH["north.bend"] < -0.4 * error
    said = "\n".join(summary_terminal_lines(summary_blocks(coarse[1])))
    assert re.search(r"Twice the links would change \d+ estimates?\sby\smore\sthan\snoise", said)
    assert re.search(r"Twice the links would remove 3\d % of the error beyond\snoise\.\sFirst\sset", said)


def test_python_and_shell_say_the_same(coarse):
    """The ± of four links for twelve is that of the links, not of the data, whoever asks."""
    file, shell = coarse
    problem = yid.load_problem(file)
    solution = yid.solve(problem)
    for name, entry in solution.parameters.items():
        said = shell["parameters"][name]
        assert (entry.verdict, entry.value) == (said["verdict"], pytest.approx(said["value"], rel=1e-6))
        assert entry.std == pytest.approx(said["std"], rel=1e-6)
    assert solution.std["north.bend"] > 5 * solution.checks.data_std["north.bend"]
    fine, known = (
        problem.with_time_step(problem.step.time_step / 2),
        (solution.evaluation, solution.checks.data_std, ()),
    )
    of_diagnosis = partial(stds_with_discretisation_and_encoder_errors, fine, solution.problem, solution.x, *known)
    std, counted = of_diagnosis(False)
    assert (std["north.bend"], counted) == (pytest.approx(solution.std["north.bend"], rel=1e-6), ("time_step", "links"))
    assert of_diagnosis(True)[0]["north.bend"] == pytest.approx(0.5 * solution.std["north.bend"], rel=0.02)
    assert "without the error" not in repr(solution)
    assert len(solution.checks.held_out_predictions) == len(problem.held_out)
    # where the model cannot be refined, the print says what its ± leaves out
    options = replace(problem.options, divided_links_model=None, checked_discretisations=("links",))
    bare = yid.solve(problem.with_options(options))
    assert bare.std == bare.checks.data_std
    assert "± without the error from the number of links and from the time step" in repr(bare)


@pytest.mark.parametrize(("setting", "tried"), [("none", set()), ("time_step", {"time_step"})])
def test_settings_say_what_is_refined(folder, tmp_path, setting, tried):
    overrides = [f"output.checked_discretisation={setting}", "solver.max_iterations=1"]
    result = run_solve(load_config(configuration(folder, 4, ["north"]), overrides), tmp_path / "run").result
    moved = result["discretisation"].get("north.bend", {})
    assert {key for key in ("links", "time_step") if moved.get(key) is not None} == tried
    assert result["parameters"]["north.bend"]["verdict"] == "not_trusted"


@pytest.mark.slow
def test_a_cross_of_few_links_is_not_called_found(tmp_path):
    """With four links both are a third too stiff and say so; with eight the error is a third of that, within its ±."""
    record(tmp_path, WHOLE)
    largest = {}
    for links in (4, 8):
        run = load_config(configuration(tmp_path, links, WHOLE, 1.2), ["problem.use_compiler=true"])
        found = judged(run_solve(run, tmp_path / f"run_{links}").result, links)
        assert set(found) == set(TRUTH)
        largest[links] = max(abs(error) for error, *_ in found.values())
        for error, _, counted, entry in found.values():
            assert abs(error) < 2 * counted
            assert not (entry["verdict"] == "identifiable" and abs(error) > 0.1)
    assert largest[4] > 0.2
    assert largest[8] < 0.5 * largest[4]


TIP = InjectedEffect("point_mass", "w_north", {"mass": 0.03})


@pytest.mark.parametrize(
    ("late", "load", "causes"), [(0.0, (), []), (0.03, (), ["camera_latency@points_mocap"]), (0.0, [TIP], [TIP.label])]
)
def test_the_error_of_few_links_is_no_gap_alone_or_beside_an_effect(tmp_path, late, load, causes):
    """Six links for twelve leave chi2/n of 2.3, and twelve none."""
    record(tmp_path, ["north"], 12, 1.2, *load)
    made = yid.read_recording(tmp_path / "cross.h5")
    shifted = replace(made, points=tuple(replace(group, t=group.t + late) for group in made.points))
    yid.write_recording(shifted, tmp_path / "cross.h5")
    file = configuration(tmp_path, 6, ["north"])
    file.write_text(file.read_text().replace("object: 0.002", "object: 0.001"))
    found = yid.diagnose(yid.load_problem(file), ("density", "camera_latency", "point_mass", "length_scale"))
    assert [effect.label for effect in found.accepted_effects] == causes
    assert (found.is_corrected_for_links, found.remaining_test.chi2_per_dof < 1.5) == (True, True)
    assert "set model.object.named_segments.north.links: 12" in " ".join(found.next_steps)
    true, fit = {"bend": 1.5 * TRUTH["north.bend"], "delay": late, "mass": 0.03}, found.final_model
    known = [(fit.values[name], fit.std[name], true[name.rpartition(".")[2]]) for name in fit.values]
    assert all(abs(value - own) < 2 * std < 0.04 * own for value, std, own in known)

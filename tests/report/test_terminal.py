"""Tables and sentences at the end of a command; a parameter's verdict reads alike wherever it stands."""

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.data import JointGroup, Recording
from yid_ocp.display import abbreviated_names_text
from yid_ocp.inference.uncertainty import VERDICT_TABLE_TEXTS, parameter_verdict
from yid_ocp.report import diagnosis_summaries, model_summaries, summaries, terminal  # noqa: F401, they register
from yid_ocp.report.terminal import CodeBlock, SummaryStatement, SummaryTable

GOOD = {"chi2_per_dof": 1.03, "p_value": 0.3, "explains": True, "data_trusted": True}
BAD = {"chi2_per_dof": 41.7, "p_value": 0.0, "explains": False, "data_trusted": True}


def parameter(said: str, value: float = 2.0) -> dict:
    return {
        "value": value, "std": 0.1, "unit": "N m/rad", "initial": 3.0, "upper": None,
        "lower": 2.0 if said == "at_bound" else 0.0,
        "free": said != "fixed", "verdict": said, "interval": (0.0, 0.5) if said == "at_bound" else None,
    }  # fmt: skip


def solved(**changes) -> dict:
    verdicts = ("identifiable", "weak", "not_identifiable", "at_bound", "fixed")
    return {
        "format": "yid-solve/1", "status": "converged", "message": "done", "iterations": 4, "evaluations": 9,
        "seconds": 1.0, "parameters": {f"p_{said}": parameter(said) for said in verdicts}, "residuals": {},
        "held_out": [], "fit": GOOD, "whitened_cost": 5.0, "wall_seconds": 1.0,
        "disagreements": [],
    } | changes  # fmt: skip


def test_without_held_out_recordings_the_fit_is_compared_with_noise_and_a_guess():
    errors = {"p.a": {"rmse": 2e-3, "expected": 1e-3, "baselines": {"stays": 0.02}, "unit": "m", "n": 9}}
    errors["p.b"] = errors["p.a"] | {"rmse": 1e-3}
    lines = told("yid-solve/1", solved(residuals=errors))
    assert line_of(lines, "p.a").split() == ["p.a", "2", "1", "20", "mm", "9"]
    assert "on fitted recordings is at most 2 times that of noise alone and 10 % of that without" in " ".join(lines)
    entry = {"recording": "r", "rmse": {"p.a": 2e-3}, "baselines": {}}
    assert "at most 2 times" not in " ".join(told("yid-solve/1", solved(residuals=errors, held_out=[entry])))


def compared(**changes) -> dict:
    return {
        "methods": {"gauss_newton": solved()}, "reference": "gauss_newton", "published": {}, "truth": {},
        "agree": True, "judged": solved(), "disturbed": False,
    } | changes  # fmt: skip


def information(**changes) -> dict:
    return {
        "status": "converged", "message": "", "parameters": {}, "directions": [], "profiles": {}, "what_if": None,
        "fit": GOOD, "at": "solution",
    } | changes  # fmt: skip


def judged(said: str) -> dict:
    return {
        "value": 2.0, "unit": "N m/rad", "std_relative": 0.5, "std_alone": 0.3,
        "verdict": said, "verdict_unknown": "weak", "interval": None, "std": 1.0,
    }  # fmt: skip


def told(form: str, result: dict) -> list[str]:
    return terminal.summary_terminal_lines(terminal.summary_blocks({**result, "format": form}))


def line_of(lines: list[str], name: str) -> str:
    return next(line for line in lines if line.startswith(f"{name} ") and "  " in line)


def test_every_verdict_has_its_words():
    possible = {parameter_verdict(1.0, std) for std in (0.01, 1.0, 100.0, float("inf"))} | {"fixed"}
    possible |= {parameter_verdict(1.0, 0.01, explains=False), parameter_verdict(1.0, 0.01, at_bound=True)}
    assert set(VERDICT_TABLE_TEXTS) == possible
    assert VERDICT_TABLE_TEXTS["identifiable"] == "found"


@pytest.mark.parametrize("said", ["identifiable", "weak", "not_identifiable", "at_bound"])
def test_a_verdict_reads_alike_in_every_command(said):
    name = f"p_{said}"
    results = {"solve": solved(), "compare": compared()}
    results |= {"identifiability": information(parameters={name: judged(said)})}
    for command, result in results.items():
        assert VERDICT_TABLE_TEXTS[said] in line_of(told(f"yid-{command}/1", result), name)


def test_a_solve_says_what_is_not_found():
    lines = told("yid-solve/1", solved())
    assert lines[0].startswith("p_at_bound ended at the lower bound"), "no value is safe"
    size, text = "chi2 per degree of freedom is 1.03; noise alone gives 1", " ".join(lines)
    assert "These recordings do not determine p_not_identifiable. `yid-ocp identifiability` shows why" in text
    assert "1 of 4 free parameters are found: their ± (one standard deviation) is at most 10 % of the value" in text
    assert "Only weakly determined (± above 10 %): p_weak. Use their 95 % intervals, which" in text
    assert f"The model explains the recordings to within their noise ({size})." in text
    assert all(fact in lines[-1] for fact in ("converged", "4 iterations", "1.0 s"))
    assert any(line.startswith("Recorded torques") for line in told("yid-solve/1", solved(unused_efforts=True)))
    assert not any("p_fixed" in line for line in lines)
    poor = {"p": parameter("not_trusted", 9.0) | {"upper": 9.0}}
    for name, side, bound, result in (
        ("p_at_bound", "lower", "2", solved()), ("p", "upper", "9", solved(parameters=poor, fit=BAD))
    ):  # fmt: skip
        said = " ".join(" ".join(told("yid-solve/1", result)).split())
        rest = ". Widen" if name == "p" else ", so values beyond it were not tried and"
        assert f"{name} ended at the {side} bound of {bound} N m/rad{rest}" in said
        assert f"Widen parameters.{name}.bounds, or" in said
    gone = " ".join(told("yid-solve/1", solved(parameters={"p": parameter("at_bound", 0.0) | {"lower": 0.0}})))
    assert "nothing of what ended at 0, its smallest value: p. Fix it there" in " ".join(gone.split())
    assert line_of(lines, "p_at_bound").split()[1:5] == ["2", "0", "to", "0.5"]
    issue = dict.fromkeys(("where", "certainty", "what", "advice", "severity"), "warning") | {"evidence": 2.0}
    issue |= {"cause": "weak_excitation", "setting": "parameters.a.free: false"}
    both = {"a": parameter("not_identifiable") | {"std": None, "upper": 2.0}, "b": parameter("identifiable")}
    lines = told("yid-solve/1", solved(parameters=both, issues=[issue]))
    said = " ".join(lines)
    assert ("Fix a at a known value" in said, "a (motion too weak). `yid-ocp" in said) == (True, True)
    clamp = {"mount.rx": parameter("weak") | {"prior_std": 0.05, "initial": 0.0}, "b": parameter("identifiable")}
    said = " ".join(told("yid-solve/1", solved(parameters=clamp, issues=[issue | {"evidence": 1.0}])))
    assert "Corrections that are not known to within 10 %: mount.rx." in said
    assert ("Only weakly" in said, "Before you use" in said, "estimate again" in said) == (False,) * 3
    more = [issue | {"where": place, "setting": f"parameters.{place}.free: false"} for place in "bcd"]
    many = told("yid-solve/1", solved(parameters=both, issues=[issue, *more]))
    assert ("Issues:" in lines, "Issues:" in many, "warning, b, c, d (warning): " in " ".join(many)) == (
        False,
        True,
        True,
    )
    at = many.index("  --set parameters.a.free=false")
    assert many[at + 1 : at + 4] == [f"  --set parameters.{own}.free=false" for own in "bcd"]
    options = " ".join(f"--set parameters.{own}.free=false" for own in "abcd")
    again = many[many.index("estimate again with the advised options:") + 1]
    assert again == f"  yid-ocp solve CONFIG {options}"
    assert line_of(lines, "a").split() == ["a", "–", "N", "m/rad", "cannot", "be", "found", "0", "to", "2"]
    said = " ".join(told("yid-solve/1", solved(status="iteration_limit", fit=BAD | {"chi2_per_dof": 2e3})))
    parts = (
        "the fit did not converge",
        "limit after 4 iterations in all starts",
        "2000 times the chi2 of the stated noise, first",
    )
    assert [part in said for part in (*parts, "do not determine", "does not explain")] == [True] * 3 + [False] * 2
    lines = told("yid-solve/1", solved(status="failed", message="step 3"))
    assert not any(word in line for line in lines for word in VERDICT_TABLE_TEXTS.values())
    assert lines[0].startswith("Do not use the values, because the fit failed: step 3. If a simulation failed, ")


def test_a_model_that_does_not_explain_the_recordings_is_the_first_thing_said():
    said = solved(fit=BAD, parameters={"a": parameter("not_trusted")})
    first = "Do not use the values yet, because the model does not explain the recordings (chi2 per degree of freedom "
    first += "is 41.7; noise alone gives 1). To find the cause, run `yid-ocp diagnose`."
    near = " ".join(
        told("yid-solve/1", solved(fit=BAD | {"chi2_per_dof": 16.0}, parameters={"a": parameter("not_trusted")}))
    )
    assert "check the stated noise (is the true noise 4 times as large?) and run `yid-ocp diagnose`" in near
    lines = told("yid-solve/1", said)
    # two things: what it does not explain, and which numbers count beyond it, by the ± that the misfit implies
    sure = "The ± of a takes the model's error as random. Until its cause is known, the values may be wrong."
    assert (" ".join(lines[:2]), lines[2]) == (first, sure)
    for std, data in ((0.21, BAD), (0.1, BAD | {"data_trusted": False})):
        unsure = solved(fit=data, parameters={"a": parameter("not_trusted") | {"std": std}})
        assert "as random" not in " ".join(told("yid-solve/1", unsure))
    lost = {"k": parameter("not_identifiable", 1.29e6) | {"initial": 1.3e6}, "b": parameter("not_identifiable")}
    for name, fraction in (("k", 1.0), ("b", 0.1)):
        still = {"cause": "weak_excitation", "setting": f"parameters.{name}.free: false", "where": "", "certainty": ""}
        issues = [still | {"severity": "warning", "evidence": 2.0, "advice": "fix it", "what": ""}]
        fit = BAD | {"noise_fraction": fraction}
        text = " ".join(told("yid-solve/1", solved(fit=fit, parameters=lost, issues=issues)))
        assert ("start values of k (1.3e+06 N m/rad): near them" in text) == (name == "b"), "k does not move"
        assert ("noise alone with 0.1 of the stated std (diagnosis" in text) == (fraction < 1)
        assert ("do not determine" in text, "--what-if" in text) == (False, False)
    lines = told("yid-compare/1", compared(methods={"gauss_newton": said}, judged=said))
    assert first in " ".join(lines[:7])
    assert "The model does not explain the recordings, so agreement of methods does not confirm the values." in lines
    assert line_of(lines, "a  ").split()[-2:] == ["in", "doubt"]
    change = {"verdict": "weak", "std_relative": 2.0, "components": {"b": 0.6, "a": -0.8, "c": 0.01}, "words": ""}
    both = {"a": judged("not_trusted"), "b": judged("not_trusted") | {"value": 0.0}}
    doubtful = information(parameters=both, fit=BAD, directions=[change], start="unknown", grasp_std=0.01)
    lines = told("yid-identifiability/1", doubtful)
    assert (" ".join(lines[:2]), "a -160 %, b +2.4 N m/rad" in lines) == (first, True)
    assert "1 N m/rad" in line_of(lines, "b"), "there is no percentage of zero"
    again = lines[lines.index("compute exact intervals, which may be asymmetric:") + 1]
    assert again.endswith(" --intervals all --unknown-grasp --unknown-start")
    assert lines[lines.index("find the cause of the model's error:") + 1] == "  yid-ocp diagnose CONFIG"


@pytest.mark.parametrize(
    ("error", "noise", "fit", "said"),
    [
        (0.012, 0.010, GOOD, None),
        (0.012, 0.002, GOOD, "points shows a gap: its held-out rms error is 12 mm, and noise alone gives 2 mm. Before"),
        (0.003, 0.002, GOOD, None),
        (0.012, 0.002, BAD, None),
    ],
)
def test_a_held_out_error_far_above_noise_is_said_first(error, noise, fit, said):
    own = "points.p"
    entry = {"recording": "r", "rmse": {own: error}, "baselines": {"stays": {own: 0.03}}, "expected": {own: noise}}
    known = {"residuals": {own: {"rmse": 0.0018, "unit": "m", "n": 9}}, "torque_offsets": {"r": {}}}
    known["parameters"], known["sensor_noise"] = {"a": parameter("identifiable")}, {own: 0.0015}
    lines = [*map(str.strip, told("yid-solve/1", solved(fit=fit, held_out=[entry], **known)))]
    text = " ".join(lines[:15])
    carried = f"noise alone gives 10 mm at {own}, of which the sensor causes 1.5 mm"
    assert (carried in " ".join(lines)) == (noise > 0.003)
    assert ("You can use these values" in text) == (fit is GOOD and error < 6 * noise)
    assert ("shows a gap" in text, (said or "") in text) == (bool(said), True)
    assert not ("does not explain" in text and "predicts them well" in text)


def test_an_interval_is_shown_of_every_number_that_is_known():
    """Where none is stated it follows from the ±, within the bounds."""
    sure, near = parameter("identifiable"), parameter("weak", 0.1)
    lines = told("yid-solve/1", solved(parameters={"a": sure, "b": near, "c": parameter("not_identifiable")}))
    assert "1.804 to 2.196" in line_of(lines, "a")
    assert "0 to 0.296" in line_of(lines, "b")
    assert line_of(lines, "c").split()[1:4] == ["–", "0.1", "N"]


def test_a_solve_says_which_estimates_a_finer_model_moves():
    changes = {"p.a": (-5.5, 0.01, 0.073), "p.b": (0.1, -0.02, 0.2), "p.c": (1e3, 1e3, None)}
    moved = {name: dict(zip(("links", "time_step", "std"), own, strict=True)) for name, own in changes.items()}
    more = {"refinement_notes": {"links": "it snaps"}, "finer_settings": {"links": ["model.object.links: 8"]}}
    lines = told("yid-solve/1", solved(discretisation=moved, **more))
    said = "Twice the links would change 1 estimate by more than noise, most of all p.a (by -5.5). The ±"
    arm = {"a": {"encoder_noise": 0.5, "std": 0.1}}
    cutoff = {"discretisation": arm, "finer_settings": {"encoder_noise": ["problem.path_cutoff: 4"]}}
    text = " ".join(told("yid-solve/1", solved(**cutoff)))
    assert "set problem.path_cutoff: 4, and solve again." in text
    assert "--set problem.path_cutoff=4 " in text, "the command has the value alone"
    rest = "Checked: half the time step would change no estimate by more than its ±."
    assert lines.index("it snaps") < (at := lines.index(said))
    cure = "For a smaller ±, set model.object.links: 8, and solve again."
    assert lines[at + 1 : at + 4] == ["includes this.", rest, cure]
    again = lines[lines.index("estimate again with the finer model:") + 1]
    assert again.endswith("--set model.object.links=8")
    assert rest not in told("yid-solve/1", solved(discretisation=moved, fit=BAD)), "it says nothing of a wrong model"
    noisy = {name: own | {"links": None, "encoder_noise": 0.01} for name, own in moved.items()}
    ends = [" ".join(told("yid-solve/1", solved(discretisation=noisy, status=s))) for s in ("converged", "stalled")]
    assert [("or additional noise of the joint" in end, "twice the links" in end) for end in ends] == [(1, 0), (0, 0)]


def test_a_comparison_without_a_parameter_that_is_found_has_nothing_to_agree_on():
    weak = solved(parameters={"a": parameter("weak")})
    methods = {"single_shooting": weak, "other": weak | {"status": "failed", "whitened_cost": None}}
    lines = told("yid-compare/1", compared(methods=methods, judged=weak, published={"a": 1.0}))
    assert any(line.startswith("Use 95 % intervals in place of values, because no ± is below 10 %.") for line in lines)
    assert line_of(lines, "cost (half the sum of (error/noise)^2)").split()[-2:] == ["5", "failed"]
    assert line_of(lines, "a").split()[1:9] == ["2", "±", "0.1", "2", "2", "±", "0.1", "1"], "of what failed no ±"
    head = line_of(lines, "parameter")
    assert ("published" in head, "truth" in head) == (True, False)
    said = "All methods agree within their ± on the parameters that are found, so you can use any column. The"
    halves = {"gauss_newton": solved(), "late": solved(status="stopped"), "short": solved(status="iteration_limit")}
    ends = line_of(told("yid-compare/1", compared(methods=halves)), "status").split()[1:]
    assert ends == ["time", "limit", "iteration", "limit", "converged"]
    assert told("yid-compare/1", compared())[0] == said


def test_verdicts_of_a_comparison_weigh_all_noise():
    """The methods themselves do not, so that nothing of theirs is to be trusted; that is said first."""
    doubtful = solved(parameters={"a": parameter("not_trusted", 7.0)}, fit=BAD)
    sure = solved(parameters={"a": parameter("identifiable", 9.0)})
    methods = {"single_shooting": doubtful, "late": doubtful | {"status": "stopped", "iterations": 0}}
    lines = told("yid-compare/1", compared(methods=methods, judged=sure, disturbed=True))
    assert lines[0].startswith("Do not use the columns single_shooting, because these methods ignore noise")
    assert line_of(lines, "parameter").split()[2:5] == ["best", "fit", "unit"], "a method without a value has no column"
    assert not any("does not explain" in line or "all methods agree" in line for line in lines)


def test_what_if_names_the_fewest_changes_or_that_there_are_none():
    base = {"words": "none (the experiment as it is)", "identifiable": 0, "gain": None, "message": "", "changes": []}
    asked = {"base": base, "singles": [base | {"words": "a camera", "gain": 2.0}], "smallest": []}
    result = information(parameters={"a": judged("weak")}, what_if=asked, fit=None)
    lines = told("yid-identifiability/1", result)
    assert "No set of up to three changes makes it possible to find all parameters." in lines
    assert "0 of 1 parameters can be determined" in lines[0]
    result["what_if"] = asked | {"smallest": [base | {"words": "a weld"}]}
    lines = told("yid-identifiability/1", result)
    assert any("All parameters would be found with: a weld." in line for line in lines)
    at = lines.index("estimate from FILE, a recording with a weld:")
    assert lines[at + 1].endswith("'recordings.estimate=[FILE]'")
    assert not any(line.startswith("plan a motion") for line in lines), "a plan may not suffice"
    for change, is_used in (("camera:tip", True), ("rate:30", False)):
        best = base | {"words": "a point, seen well", "changes": [change]}
        more = {"what_if": asked | {"smallest": [best]}, "groups_with_chosen_points": ["points"]}
        said = " ".join(told("yid-identifiability/1", result | more))
        assert ("[FILE]' --set sensors.points.used_points=null" in said) == is_used


def test_what_is_hidden_is_told_by_its_cause():
    alone = {"verdict": "not_identifiable", "std_relative": 9.0, "components": {"a": 1.0}, "words": "W"}
    alone |= {"unobserved_parameter": "", "hidden_change": "", "hidden_by": ""}
    changes = [alone | {"hidden_change": f"a change of {name}", "hidden_by": "a start"} for name in "bc"]
    found = [alone | {"unobserved_parameter": "a"}, *changes, alone]
    parameters = {name: judged("not_identifiable") for name in "abc"}
    lines = told("yid-identifiability/1", information(parameters=parameters, directions=found))
    at = lines.index("Near these values, the readings hardly depend on a.")
    said = "These recordings cannot distinguish a change of b, or a change of c from a start."
    assert lines[at + 1 : at + 3] == [said, "W."]


def test_a_simulation_that_failed_and_one_that_did_not():
    done = {"status": "done", "groups": {"joints": {"samples": 12}}, "duration": 0.5, "message": "It is short."}
    failed, good = (told("yid-simulate/1", own)[0] for own in ({"status": "failed", "message": "step 3"}, done))
    assert failed.startswith("The simulation failed: step 3. If ")
    assert good == "The file recording.h5 has 0.5 s of simulated motion. It is short."


def test_blocks_on_a_terminal():
    table = SummaryTable([("a", "b"), ("1", "2")], "T")
    assert terminal.summary_terminal_lines([]) == []
    blocks = [table, SummaryStatement("said"), table, replace(table, is_page_only=True), CodeBlock("do it\nnow")]
    assert terminal.summary_terminal_lines(blocks) == [
        "T:", "a  b", "-  -", "1  2", "", "said", "", "T:", "a  b", "-  -", "1  2", "", "  do it", "  now",
    ]  # fmt: skip
    prose = terminal.summary_terminal_lines([SummaryStatement("A sentence of some length. " * 9 + "It ends.")])
    assert max(map(len, prose)) <= 100


def test_tables_are_aligned_without_empty_columns():
    assert terminal.aligned_table_lines([("a", "b"), ("1", "")]) == ["a", "-", "1"], "a head alone is no entry"
    lines = terminal.aligned_table_lines([("a", "", "long head"), ("1", "", "x"), ("22", "", "")])
    assert lines == ["a   long head", "--  ---------", "1   x", "22"]
    recording = Recording(JointGroup(("a", "b"), np.array([0.0, 0.1]), np.zeros((2, 2))))
    *_, row = terminal.recording_summary_lines(recording)
    assert " ".join(row.split()) == "joints 2 10 0.1 0.1 position [rad] a, b"


def test_a_diagnosis_writes_a_vanishing_p_value_as_a_bound():
    parameters = {"tau": {"value": 0.05, "std": None, "unit": "s"}}
    entry = {"kind": "kelvin_voigt", "location": "T1", "closure": None, "parameters": parameters}
    which = [entry | {"location": at, "p_value": p} for at, p in (("T1", 0.0), ("T2", 0.0034), ("T3", 0.5))]
    known = {"summary": "There is a gap.", "verdict": "unknown", "next_plan": None, "seconds": {"fit": 1.0}}
    result = known | {"gap": {"before": {"rmse": {}, "unit": {}}}, "which": which}
    fitted = {"which": [*({**own, "closure": 0.5} for own in which[:2]), which[2]], "confusable": [which[1:]]}
    lines = told("yid-diagnosis/2", result | fitted)
    words = [" ".join(line_of(lines, f"kelvin_voigt@T{i}").split()[-3:]) for i in (1, 2, 3)]
    assert words == ["% < 1e-12", "% 0.0034 possible", "forecast) 0.5 possible"]
    assert "tau = 0.05 s  not fitted alone (values: forecast)" in line_of(lines, "kelvin_voigt@T3")
    assert not any("kelvin_voigt" in line for line in told("yid-diagnosis/2", result)), "none was fitted"
    unseen = ["slip@grasp", *(f"{kind}@j{i}" for kind in ("friction", "mass", "lag", "gain") for i in range(1, 8))]
    lines = told("yid-diagnosis/2", result | {"unseen": unseen})
    at = next(i for i, line in enumerate(lines) if "would not show" in line)
    assert "slip@grasp, friction@j1 and 6 other places, mass@j1" in " ".join(lines[at : at + 2])
    alike = {"which": [entry | {"closure": 0.5, "p_value": 0.0}], "effects": [entry]}
    refitted, named = (told("yid-diagnosis/2", result | alike | {"verdict": own}) for own in ("confusable", "effect"))
    assert [line_of(own, "kelvin_voigt@T1").split()[-1] for own in (refitted, named)] == ["possible", "accepted"]
    provisional = told("yid-diagnosis/2", result | alike | {"verdict": "effect", "probability": 0.4})
    assert provisional[0].startswith("Verdict (provisional): effect."), "and no meaning of the kind follows"
    assert line_of(provisional, "kelvin_voigt@T1").endswith("possible")
    beside = told("yid-diagnosis/2", result | {"effects": which[1:], "verdict": "effect"})
    assert "fitted beside others only  0.0034  " in line_of(beside, "kelvin_voigt@T2")
    assert "tau unknown" in line_of(refitted, "kelvin_voigt@T1")
    assert not any("yid-ocp plan" in line for line in lines)
    section = {"goal": "information", "effects_to_discriminate": ["density@T3", "point_mass@w_T3"]}
    section |= {"parameter_run_folder": "runs/mine"}
    command = next(line for line in told("yid-diagnosis/2", result | {"next_plan": section}) if "yid-ocp plan" in line)
    assert "'plan.effects_to_discriminate=[density@T3, point_mass@w_T3]'" in command


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ([f"a@joint{i}.tau_c" for i in range(1, 8)], "a@joint1.tau_c to a@joint7.tau_c"),
        (["T1.bend", "T2.bend"], "T1.bend, T2.bend"),
        (["j1.c", "tip.mass", "j3.c", "j2.c", "j4.c", "j6.c"], "j1.c to j4.c, tip.mass, j6.c"),
        (["T1.c", "T2.c", "T3.c"], "T1.c, T2.c, T3.c"),
        ([f"w{i}.x{j}" for i in range(2) for j in range(9, 12)], "w0.x9 to w0.x11, w1.x9 to w1.x11"),
        (["j01.c", "j02.c", "j03.c", ""], "j01.c, j02.c, j03.c, "),
        ([f"{c}.gain" for c in "abcdefghijklmnopqrst"], ", ".join(f"{c}.gain" for c in "abcdefghijkl") + " and 8 more"),
        ([], ""),
    ],
)
def test_names_with_consecutive_numbers_are_told_by_their_pattern(names, said):
    assert abbreviated_names_text(names) == said


def test_the_next_command_of_check_follows_the_advice():
    """Effects stay out of it, as the option would replace those of the configuration."""
    own = {"recording": "a", "role": "estimate", "groups": {}, "noise": {}, "grasp_gaps": {}}
    issue = dict.fromkeys(("where", "what", "advice"), "x") | {"certainty": "likely", "severity": "warning"}
    issue["evidence"] = 2.0
    issue |= {"cause": "noise_overstated", "setting": "sensors.camera.std: 0.001"}
    found = {"warnings": ["too coarse"], "links": [], "time_step": [], "message": ""}
    result = {"warnings": [], "convergence": found, "recordings": [own], "mechanics": {}}
    options = "--set output.checked_discretisation=both --set sensors.camera.std=0.001"
    late = issue | {"setting": "model.effects: [{kind: camera_latency}]"}
    for more, rest in (([], ""), ([late], ", after the advice above is followed")):
        lines = told("yid-check/1", result | {"issues": [issue, *more]})
        at = lines.index(f"estimate the free parameters with the advised options{rest}:")
        assert lines[at + 1] == f"  yid-ocp solve CONFIG {options}"


@pytest.mark.parametrize(("error", "verdict", "words"), [
    (12.4, "identifiable", "because no law explains these motions"),
    (12.4, "not_identifiable", "because no law explains these motions"),
    (1.1, "not_identifiable", "Use no friction law, because these recordings do not show friction"),
    (1.1, "identifiable", "Use the law 'viscous' for these joints: elbow, as it is the simplest law"),
])  # fmt: skip
def test_no_friction_law_is_advised_whose_error_is_far_above_noise(error, verdict, words):
    law = {"parameters": {"elbow.damping": parameter(verdict)}, "mean_error": error, "standard_error": 0.1}
    law |= {"beyond_warranted": 0.0, "beyond_warranted_standard_error": 0.0, "converged": True}
    result = {"unit": "std", "warranted": "viscous", "laws": {"viscous": law}, "joints": ["elbow"], "to_use": {}}
    lines = told("yid-friction/1", result | {"friction_parameters": ["elbow.damping"], "kinds": ["a", "b"]})
    assert words in " ".join(lines)
    assert ("  model:" in lines) == words.startswith("Use the law")
    law["parameters"]["wrist.damping"] = parameter("not_identifiable")
    more = {"friction_parameters": ["elbow.damping", "wrist.damping"], "kinds": ["a", "b"]}
    both = " ".join(told("yid-friction/1", result | more))
    assert ("Do not use wrist.damping, which" in both) == words.startswith("Use the law")

"""Objects in a line and in a notebook's cell."""

import inspect
import re
from typing import get_type_hints

import numpy as np
import pytest
from small_problems import joints, pendulum_step, recording, seen, taken

import yid_ocp as yid
from yid_ocp.analysis.step_symbols import NamedStepEquations
from yid_ocp.display import ReprMixin, ReprTexts, count_with_noun
from yid_ocp.model import FlexibleSegment, flexible_object
from yid_ocp.problem import EstimationProblem, ProblemOptions


class Thing(ReprMixin):
    def __init__(self, line, rows=()):
        self.said = ReprTexts(line, rows)

    def _summary(self):
        return self.said


def test_a_line_and_a_table():
    thing = Thing("a < b", [("name", "value"), ("x & y", "1")])
    assert repr(thing) == "<Thing: a < b>"
    table = "<table><tr><th>name</th><th>value</th></tr><tr><td>x &amp; y</td><td>1</td></tr></table>"
    assert thing._repr_html_() == f"<p><b>Thing</b>: a &lt; b</p>{table}"
    assert "<table>" not in Thing("alone", [("head",)])._repr_html_()
    text = Thing("long", [("name", "value"), *((f"r{i}", "") for i in range(35))])._repr_html_()
    assert text.count("<tr>") == 32
    assert "<td>and 5 more</td><td></td>" in text


def test_recordings_show_what_they_hold():
    t = 0.01 * np.arange(101)
    hidden = np.zeros((101, 2, 3))
    hidden[5, 1] = np.nan
    made = recording(joints(("a", "b"), t, np.zeros((101, 2)), effort=np.zeros((101, 2))), seen(("x", "y"), t, hidden))
    assert repr(made) == "<Recording: 'made', 2 joints and 2 points, 1 s>"
    assert repr(made.joints) == "<JointGroup: 2 joints, 101 samples at 100 Hz: position, effort>"
    assert repr(made.points[0]) == "<PointGroup: points, 2 points, 101 samples at 100 Hz, in world>"
    assert "<td>a, b</td><td>101 samples at 100 Hz</td><td>position, effort</td>" in made._repr_html_()
    assert "<td>y</td><td>100</td>" in made.points[0]._repr_html_()
    assert repr(recording()) == "<Recording: 'made', 0 joints and 0 points>"
    assert count_with_noun(1, "joint") == "1 joint"


@pytest.fixture(scope="module")
def shown(urdf_folder):
    """Everything that a small estimation has, by class."""
    step = pendulum_step(urdf_folder, prescribed=("shoulder",))
    made = taken(step, 1)
    options = ProblemOptions(path_cutoff=np.inf)
    problem = EstimationProblem(step, [made], ["elbow.stiffness", "elbow.damping"], options, held_out=[taken(step, 2)])
    solution = yid.solve(problem)
    tube = flexible_object([FlexibleSegment("tube", length=0.4, mass=0.1, radius=0.01, links=2)])
    system, [seen_channel, *_] = step.system, solution.channel_measurements_and_predictions()
    things = [made, step, system, system.mechanism, system.parameters, tube, problem, solution, solution.evaluation]
    things += [seen_channel, yid.identifiability(problem, solution), NamedStepEquations.from_equations(step.equations)]
    return {type(thing).__name__: thing for thing in things}


LINES = {"Recording": "1 joint and 2 points", "EstimationProblem": "2 of 6 parameters free"}
LINES |= {"System": "double_pendulum, 2 coordinates (1 prescribed, 1 passive), 0 constraints"}
LINES |= {"Step": "0.01 s, symmetric, interpreted, of double_pendulum", "Mechanism": "double_pendulum, 2 joints and"}
LINES |= {"FlexibleObject": "tube, 6 joints", "Solution": "by gauss_newton", "Evaluation": "by 2 unknowns"}
LINES |= {"ChannelPrediction": "of 'run_1'", "IdentifiabilityResult": "of 2 parameters found"}
LINES |= {"NamedStepEquations": "4 equations of a step of double_pendulum"}


@pytest.mark.parametrize(("name", "words"), LINES.items(), ids=LINES)
def test_public_objects_are_short(shown, name, words):
    text = repr(shown[name])
    assert words in text
    assert len(text) < 260
    assert "array" not in text
    assert "\n" not in text
    html = shown[name]._repr_html_()
    assert html.startswith(f"<p><b>{name}</b>: ")
    assert len(re.findall("<tr>", html)) <= 32


def test_results_state_shapes_and_units(shown):
    """Of what a function of the front door returns: in its docstring, where a notebook's help looks."""
    functions = {name: entry for name in yid.__all__ if inspect.isfunction(entry := getattr(yid, name))}
    results = {get_type_hints(entry).get("return") for entry in functions.values()} - {type(None)}
    assert {yid.Solution, yid.DiagnosisResult, yid.Recording} <= results
    settings = {"RunSettings", "Step", "NonlinearProgram", "FlexibleObject", "System", "EstimationProblem"}
    for result in results:
        if result.__name__ not in settings:
            text = inspect.getdoc(result)
            assert re.search(r"\[(1|s|m|rad|nat|N m)|unit", text), result
            if result.__name__ != "ExperimentChangesRankedByIdentifiability":  # it has no arrays
                assert re.search(r"\(\w+( \+ 1)?, ?\w*\)|shape", text), result


def test_all_public_classes_that_hold_arrays_show_themselves():
    exempt = {"Status", "YidError", "Grasp", "FlexibleSegment", "ProblemOptions", "SensorOptions"}
    exempt |= {"GaussNewton", "MultipleShooting", "SingleShooting", "SteepestDescent"}
    public = {name: getattr(yid, name) for name in yid.__all__}
    classes = {name for name, entry in public.items() if isinstance(entry, type) and not issubclass(entry, ReprMixin)}
    assert classes <= exempt
    assert set(yid.__all__) <= set(dir(yid))
    with pytest.raises(AttributeError, match="no attribute 'slove'"):
        yid.slove  # noqa: B018

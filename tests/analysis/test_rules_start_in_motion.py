"""Memory of a start in motion, rule by rule: kept where recordings left out agree, dropped where they do not."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from yid_ocp.analysis import compare as module
from yid_ocp.analysis.compare import decide_cable_memory
from yid_ocp.model.objects.cable import START_SPEED_PARAMETER


class Means:
    """One unknown measured once by every recording, and the memory of one branch, which nothing sees."""

    def __init__(self, values, speeds, names=("k", "a.memory")):
        self.values, self.unknown_names = np.array(values, float), names
        self.shared_parameters = self.free = names
        self.episodes = [self._episode(value, speed) for value, speed in zip(values, speeds, strict=True)]
        self.residual_rows = SimpleNamespace(measurements=[(slice(i, i + 1),) for i in range(len(values))])
        self.bounds = np.full(len(names), -np.inf), np.full(len(names), np.inf)
        self.unknown_scales = np.full(len(names), 100.0)
        self.predictor = SimpleNamespace(
            predict_episode=lambda episode, theta, offset, derivatives: self._predicted(theta)
        )
        self.fixed = {}

    @staticmethod
    def _episode(value, speed):
        samples = SimpleNamespace(whitened_residual=lambda predicted: predicted - value, n_residuals=1)
        start = None if speed is None else SimpleNamespace(fitted_parameters={START_SPEED_PARAMETER: speed})
        return SimpleNamespace(measurements=(samples,), fixed_initial_state=start)

    @staticmethod
    def _predicted(theta):
        return SimpleNamespace(predicted_outputs=(np.array([theta]),))

    def split(self, x, i):
        return float(x[0]), None

    def evaluate(self, x, equilibrium_guesses=None):
        jacobian = np.zeros((len(self.values), len(self.unknown_names)))
        jacobian[:, 0] = 1.0
        return SimpleNamespace(residual=x[0] - self.values, jacobian=jacobian, equilibrium_guesses=None)

    def with_free_subset(self, names):
        made = Means(self.values, [0.0] * len(self.values), tuple(names))
        made.episodes = self.episodes
        return made

    def with_parameter_values(self, values):
        self.fixed = dict(values)
        return self

    def vector(self, values):
        return np.array([values[name] for name in self.unknown_names])


def solution(x, names=("k", "a.memory")):
    return SimpleNamespace(
        unknown_names=names, x=np.array(x, float), evaluation=SimpleNamespace(equilibrium_guesses=None)
    )


@pytest.fixture
def asked(monkeypatch):
    """Makes the answer for the problem without memory, and keeps what was solved."""
    kept = SimpleNamespace(problems=[], starts=[], ok=True)

    def solve(problem, solver, start, limits):
        kept.problems.append(problem)
        kept.starts.append(start)
        found = solution(start, problem.unknown_names)
        return found if kept.ok else SimpleNamespace(evaluation=None)

    monkeypatch.setattr(module, "solve", solve)
    return kept


@pytest.mark.parametrize(
    ("names", "speeds"),
    [(("k", "m"), (0.5, 0.5, 0.5)), (("k", "a.memory"), (0.0, None, 0.005))],
    ids=["no memory", "all at rest"],
)
def test_nothing_is_asked_where_nothing_is_in_question(asked, names, speeds):
    problem, found = Means((1.0, 2.0, 3.0), speeds, names), solution((2.0, 0.5), names)
    safe = decide_cable_memory(problem, None, found)
    assert (safe.problem, safe.solution, safe.message, asked.problems) == (problem, found, "", [])


def test_a_single_recording_in_motion_bears_nothing_out(asked):
    problem = Means((1.0, 2.0, 3.0), (0.5, 0.0, None))
    safe = decide_cable_memory(problem, None, solution((2.0, 0.5)))
    assert safe.problem is asked.problems[0]
    assert (safe.problem.unknown_names, safe.problem.fixed, asked.starts) == (("k",), {"a.memory": 0.0}, [[2.0]])
    assert "too few recordings start in motion" in safe.message


@pytest.mark.parametrize(("with_memory", "kept"), [(2.0, True), (4.0, False), (3.0, False)])
def test_memory_is_kept_where_recordings_left_out_are_predicted_better_with_it(asked, monkeypatch, with_memory, kept):
    problem, found = Means((1.0, 2.0, 3.0), (0.5, 0.2, 0.0)), solution((2.0, 0.5))
    errors = {id(problem): with_memory}
    monkeypatch.setattr(module, "_left_out", lambda p, s, moving: errors.get(id(p), 3.0))
    safe = decide_cable_memory(problem, None, found)
    assert (safe.problem is problem) is kept
    assert f"memory is {'' if kept else 'not '}kept" in safe.message
    assert f"{with_memory:.3g} with it and 3 without" in safe.message


def test_what_cannot_be_solved_without_memory_keeps_it(asked):
    asked.ok = False
    problem, found = Means((1.0, 2.0, 3.0), (0.5, 0.2, 0.0)), solution((2.0, 0.5))
    assert decide_cable_memory(problem, None, found).solution is found


def test_a_recording_is_predicted_from_the_others_alone():
    problem = Means((1.0, 2.0, 6.0), (0.5, 0.0, 0.5))
    # the mean of the others is 4 for the first and 1.5 for the last, wherever the fit of all stands
    expected = np.sqrt(((4.0 - 1.0) ** 2 + (1.5 - 6.0) ** 2) / 2)
    for at in (3.0, 10.0):
        assert module._left_out(problem, solution((at, 0.5)), [0, 2]) == pytest.approx(expected, rel=1e-6)
    problem.bounds = np.array([-np.inf, 0.0]), np.array([3.0, 1.0])
    bounded = np.sqrt(((3.0 - 1.0) ** 2 + (1.5 - 6.0) ** 2) / 2)
    assert module._left_out(problem, solution((2.5, 0.5)), [0, 2]) == pytest.approx(bounded, rel=1e-6)
    problem.bounds = np.array([2.0, 0.0]), np.array([np.inf, 1.0])
    bounded = np.sqrt(((4.0 - 1.0) ** 2 + (2.0 - 6.0) ** 2) / 2)
    assert module._left_out(problem, solution((2.5, 0.5)), [0, 2]) == pytest.approx(bounded, rel=1e-6)
    problem.predictor = SimpleNamespace(predict_episode=lambda *_: "it snaps")
    assert module._left_out(problem, solution((3.0, 0.5)), [0, 2]) == np.inf


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["above", "below"])
def test_where_one_unknown_meets_its_bound_the_other_takes_the_rest(side):
    near, far = np.array([10.0 + 0.5 * side, 10.0 + 9.0 * side]), np.array([10.0 - 9.0 * side, 10.0 - 9.0 * side])
    problem = SimpleNamespace(bounds=(np.minimum(near, far), np.maximum(near, far)), unknown_scales=np.ones(2))
    jacobian, residual = np.array([[1.0, 1.0], [0.0, 0.1]]), np.array([-2.0 * side, 0.0])
    found = module._stepped(problem, np.array([10.0, 10.0]), residual, jacobian)
    np.testing.assert_allclose(found, 10.0 + side * np.array([0.5, 1.5 / 1.01]), rtol=1e-6)

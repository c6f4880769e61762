"""Memory of a cable whose recordings start in motion: kept where recordings that are left out agree with it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from yid_ocp.analysis import compare as module
from yid_ocp.analysis.compare import decide_cable_memory
from yid_ocp.model.objects.cable import START_SPEED_PARAMETER_NAME


class Means:
    """One unknown measured once by every recording, and the memory of one branch; without it predictions are off."""

    def __init__(self, values, speeds, names=("k", "a.memory"), off=0.0):
        self.values, self.unknown_names, self.off = np.array(values, float), names, off
        self.shared_parameters = self.free = names
        self.episodes = [self._episode(value, speed) for value, speed in zip(values, speeds, strict=True)]
        self.residual_rows = SimpleNamespace(measurements=[(slice(i, i + 1),) for i in range(len(values))])
        self.bounds = np.full(len(names), -np.inf), np.full(len(names), np.inf)
        self.unknown_scales = np.full(len(names), 100.0)
        self.predictor = SimpleNamespace(
            predict_episode=lambda episode, theta, offset, _: SimpleNamespace(predicted_outputs=(np.array([theta]),))
        )

    @staticmethod
    def _episode(value, speed):
        samples = SimpleNamespace(whitened_residual=lambda predicted: predicted - value, n_residuals=1)
        start = None if speed is None else SimpleNamespace(fitted_parameters={START_SPEED_PARAMETER_NAME: speed})
        return SimpleNamespace(measurements=(samples,), fixed_initial_state=start)

    def split(self, x, i):
        return float(x[0]) + (0.0 if "a.memory" in self.unknown_names else self.off), None

    def evaluate(self, x, equilibrium_guesses=None):
        jacobian = np.zeros((len(self.values), len(self.unknown_names)))
        jacobian[:, 0] = 1.0
        return SimpleNamespace(residual=x[0] - self.values, jacobian=jacobian, equilibrium_guesses=None)

    def with_free_subset(self, names):
        made = Means(self.values, [0.0] * len(self.values), tuple(names), self.off)
        made.episodes, made.bounds = self.episodes, tuple(bound[:1] for bound in self.bounds)
        return made

    def with_parameter_values(self, values):
        assert values == {"a.memory": 0.0}
        return self

    def vector(self, values):
        return np.array([values[name] for name in self.unknown_names])


def solution(x, names=("k", "a.memory")):
    return SimpleNamespace(
        unknown_names=names, x=np.array(x, float), evaluation=SimpleNamespace(equilibrium_guesses=None)
    )


@pytest.fixture
def solved(monkeypatch):
    """Solves the problem without memory where it starts, and keeps it; `ok` is whether that succeeds."""
    kept = SimpleNamespace(problems=[], ok=True)

    def solve(problem, solver, start, limits):
        kept.problems.append(problem)
        return solution(start, problem.unknown_names) if kept.ok else SimpleNamespace(evaluation=None)

    monkeypatch.setattr(module, "solve", solve)
    return kept


@pytest.mark.parametrize(
    ("names", "speeds"),
    [(("k", "m"), (0.5, 0.5, 0.5)), (("k", "a.memory"), (0.0, None, 0.005))],
    ids=["no memory", "all at rest"],
)
def test_nothing_is_asked_where_nothing_is_in_question(solved, names, speeds):
    problem, found = Means((1.0, 2.0, 3.0), speeds, names), solution((2.0, 0.5), names)
    safe = decide_cable_memory(problem, None, found)
    assert (safe.problem, safe.solution, safe.message, solved.problems) == (problem, found, "", [])


def test_a_single_recording_in_motion_bears_nothing_out(solved):
    safe = decide_cable_memory(Means((1.0, 2.0, 3.0), (0.5, 0.0, None)), None, solution((2.0, 0.5)))
    assert safe.problem is solved.problems[0]
    assert (safe.problem.unknown_names, safe.solution.x.tolist()) == (("k",), [2.0])
    assert "too few recordings start in motion" in safe.message


@pytest.mark.parametrize(
    ("off", "bounds", "at", "predicted", "kept"),
    [
        (1.0, (-np.inf, np.inf), 3.0, (4.0, 1.5), False),
        (0.0, (-np.inf, np.inf), 10.0, (4.0, 1.5), False),
        (-1.0, (-np.inf, np.inf), 3.0, (4.0, 1.5), True),
        (0.0, (-np.inf, 3.0), 2.5, (3.0, 1.5), False),
        (0.0, (2.0, np.inf), 2.5, (4.0, 2.0), False),
    ],
    ids=["worse with it", "no better", "better", "a bound above", "a bound below"],
)
def test_memory_is_kept_where_recordings_left_out_are_predicted_better_with_it(
    solved, off, bounds, at, predicted, kept
):
    """Each from the others alone: the first from a mean of 4, the last from 1.5, wherever the fit of all stands."""
    problem, found = Means((1.0, 2.0, 6.0), (0.5, 0.0, 0.5), off=off), solution((at, 0.5))
    problem.bounds = tuple(np.array([bound, side]) for bound, side in zip(bounds, (0.0, 1.0), strict=True))
    safe = decide_cable_memory(problem, None, found)
    with_it, without = (
        np.sqrt(((predicted[0] + more - 1.0) ** 2 + (predicted[1] + more - 6.0) ** 2) / 2) for more in (0.0, off)
    )
    assert (safe.problem is problem) is kept
    assert f"memory is {'' if kept else 'not '}kept" in safe.message
    assert f"{with_it:.3g} with it and {without:.3g} without" in safe.message


def test_what_cannot_be_predicted_without_memory_keeps_it(solved):
    problem, found = Means((1.0, 2.0, 3.0), (0.5, 0.2, 0.0)), solution((2.0, 0.5))
    problem.predictor.predict_episode = lambda *_: "it snaps"
    assert "inf with it and" in decide_cable_memory(problem, None, found).message
    solved.ok = False
    assert decide_cable_memory(problem, None, found).solution is found

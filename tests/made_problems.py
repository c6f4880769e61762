"""A made-up problem for the tests of what all solvers share: nothing is rolled out for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace

import numpy as np
from made_series import samples

from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation, ResidualVectorLayout
from yid_ocp.problem.options import ProblemOptions
from yid_ocp.solvers.base import Iterate, SolverResult, Status


def linear(matrix, residual=None):
    """Rows of a linear model about zero."""
    matrix = np.array(matrix, float)
    offset = np.zeros(len(matrix)) if residual is None else np.array(residual, float)
    return lambda x, duration: (offset + matrix @ x, matrix)


class MadeUp:
    """A problem of shared parameters, whose residual and Jacobian are functions of them.

    `rows` gives both from x and the horizon [s], or None where the rollout fails; the last `stated` and `weak` rows are
    priors. `count` of all rows is needed where the start fails; `priors` are standard deviations by name.
    """

    guess: str | None = "warm"

    def __init__(
        self,
        rows: Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray] | None],
        start: Sequence[float] = (1.0,),
        *,
        stated: int = 0,
        weak: int = 0,
        noise: float = 1.0,
        weighting: str = "whitened",
        lower: float = 0.0,
        upper: float = np.inf,
        scales: Sequence[float] | None = None,
        fixed: Sequence[float] = (),
        duration: float = 10.0,
        count: int | None = None,
        priors: Mapping[str, float] | None = None,
    ) -> None:
        self._rows, self._stated, self._weak, self.duration = rows, stated, weak, duration
        self.stated_rms_noise_of_data_residuals = noise
        self.initial_unknowns = np.array(start, float)
        size = len(self.initial_unknowns)
        self.unknown_names = tuple(f"k{i}" for i in range(size))
        self.shared_parameters, self.local_parameters = self.unknown_names, ()
        self.bounds = np.full(size, lower), np.full(size, upper)
        self.unknown_scales = np.abs(self.initial_unknowns) if scales is None else np.array(scales, float)
        self.options = ProblemOptions(weighting=weighting, prior_stds=dict(priors or {}), path_cutoff=np.inf)
        self.has_process_noise = False
        values = [*self.initial_unknowns, *fixed]
        entries = [Parameter(f"k{i}", v, "N m/rad", lower, upper, "made up") for i, v in enumerate(values)]
        self.system = SimpleNamespace(parameters=Parameters(entries[::-1]), effects=(), prescribed=())
        self.theta = np.array(values[::-1])
        self.step = SimpleNamespace(time_step=0.1)
        self._count = len(rows(self.initial_unknowns, duration)[0]) if count is None else count
        self.episodes = tuple(self._episode(i, round(duration / period)) for i, period in enumerate((0.2, 0.1)))
        self.asked: list[tuple[np.ndarray, bool, object]] = []

    def _episode(self, i: int, steps: int) -> SimpleNamespace:
        """A recording; the first one has all the measurements, evenly in time."""
        data = (self._count - self._stated - self._weak) if i == 0 else 0
        node = np.linspace(0, steps, data).astype(int)
        group = samples(
            ("points.tip",), np.full((data, 1), self.stated_rms_noise_of_data_residuals),
            positive_weight_mask=np.ones((data, 1), bool), value=np.zeros((data, 1)), node=node,
            fraction=np.zeros(data), n_residuals=data,
        )  # fmt: skip
        grid = SimpleNamespace(steps=steps, time_step=0.1)
        recording = SimpleNamespace(points=())
        usual = {"grid": grid, "measurements": (group,), "has_biases_treated_as_noise": False}
        return SimpleNamespace(name=f"run {i}", recording=recording, **usual)

    @property
    def positive_unknowns_mask(self) -> np.ndarray:
        return (self.bounds[0] >= 0) & (self.initial_unknowns > 0)

    pack_unknowns = EstimationProblem.pack_unknowns

    @property
    def residual_rows(self) -> ResidualVectorLayout:
        return ResidualVectorLayout.from_episodes(self.episodes, self._stated, self._weak)

    def unpack_episode_unknowns(self, x: np.ndarray, episode: int) -> tuple[np.ndarray, np.ndarray]:
        theta = self.theta.copy()
        theta[len(theta) - len(x) :] = x[::-1]
        return theta, np.zeros(0)

    def evaluate(self, x: np.ndarray, derivatives: bool = True, equilibrium_guesses: object = None) -> Evaluation:
        self.asked.append((np.array(x), derivatives, equilibrium_guesses))
        found = self._rows(np.asarray(x), self.duration)
        if found is None:
            return Evaluation(np.inf, np.zeros(0), None, False, "it snaps", ())
        residual, jacobian = found
        data = np.asarray(residual)[self.residual_rows.data, None]
        parts = (data, data[:0])[: len(self.episodes)]
        done = tuple(SimpleNamespace(predicted_outputs=(part,), equilibrium_guess=self.guess) for part in parts)
        cost = 0.5 * float(residual @ residual)
        return Evaluation(cost, residual, jacobian if derivatives else None, True, "", done)

    def with_episodes(self, episodes: Sequence[SimpleNamespace], held_out: Sequence[SimpleNamespace]) -> MadeUp:
        return self

    def with_options(self, options: ProblemOptions) -> MadeUp:
        lower, upper = self.bounds
        bounds = {"lower": lower[0], "upper": upper[0]}
        return MadeUp(self._rows, self.initial_unknowns, **bounds, duration=options.duration, count=self._count)


class Steps:
    """A solver that goes where it is told, along a path in every run; remembers where it began, over which horizon."""

    name = "made_up"

    def __init__(self, *paths: Sequence[Sequence[float]], status: Status = Status.CONVERGED) -> None:
        self._paths, self._status = list(paths), status
        self.runs: list[tuple[list[float], float]] = []

    def minimize_cost(
        self, problem: MadeUp, start: np.ndarray, callback: Callable[[Iterate], None] | None
    ) -> SolverResult:
        self.runs.append((start.tolist(), problem.duration))
        path = self._paths.pop(0) if self._paths else [start]
        history = tuple(Iterate(i, 1.0, np.array(x, float), 0.0, i + 1, 0.0) for i, x in enumerate(path))
        for entry in history:
            if callback is not None:
                callback(entry)
        end = np.array(path[-1], float)
        return SolverResult(self._status, f"run {len(self.runs)}", end, history, len(path), "warm")

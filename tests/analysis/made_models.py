"""Made-up problems for the tests of analysis: a residual that is a formula of named unknowns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace

import casadi as ca
import numpy as np
from made_series import samples

from yid_ocp.inference.uncertainty import GoodnessOfFit, ParameterEstimate
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.problem.evaluation import Evaluation, ResidualVectorLayout
from yid_ocp.problem.options import MultivariateGaussianPrior
from yid_ocp.solvers.base import Solution, Status

_BY_NAME = ("prior_stds", "known_initial_states", "parameters_by_recording")  # options that nobody set


class Formula:
    """A problem whose residual is a CasADi expression of its unknowns.

    `rows` lead from symbols by name to the residual's rows: data, then so many `stated` priors, then `weak` ones;
    `fails` from values by name to whether the rollout fails.
    """

    def __init__(
        self,
        rows: Callable[[Mapping[str, ca.SX]], Sequence[ca.SX]],
        start: Mapping[str, float],
        *,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        scales: Mapping[str, float] | None = None,
        units: Mapping[str, str] | None = None,
        stated: int = 0,
        weak: int = 0,
        noise: float = 1.0,
        fails: Callable[[dict[str, float]], bool] | None = None,
    ) -> None:
        self.unknown_names = tuple(start)
        self.free = tuple(name for name in self.unknown_names if not name.startswith("start."))
        self.initial_unknowns = np.array(list(start.values()))
        x = ca.SX.sym("x", len(self.unknown_names))
        residual = ca.vertcat(ca.SX(0, 1), *rows({name: x[i] for i, name in enumerate(self.unknown_names)}))
        self._function = ca.Function("rows", [x], [residual, ca.jacobian(residual, x)])
        limits = dict.fromkeys(self.unknown_names, (0.0, np.inf)) | dict(bounds or {})
        self.bounds = tuple(np.array([limits[name][side] for name in self.unknown_names]) for side in (0, 1))
        sizes = dict(zip(self.unknown_names, np.abs(self.initial_unknowns), strict=True)) | dict(scales or {})
        self.unknown_scales = np.array([sizes[name] or 1.0 for name in self.unknown_names])
        data = residual.numel() - stated - weak
        self.residual_rows = ResidualVectorLayout(
            ((slice(0, data),),), slice(0, data), slice(data, data + stated), slice(data + stated, data + stated + weak)
        )
        self.rms_noise_of_data_residuals, self._fails = noise, fails or (lambda values: False)
        self.whitening_filters, self.has_process_noise = (None,), False
        weighting, empty = "paper" if noise != 1 else "whitened", {name: {} for name in _BY_NAME}
        common = {"multivariate_prior": MultivariateGaussianPrior(), "path_cutoff": np.inf, "data_issues": ()}
        common |= {"no_data_issue_exceeds_warning": True, "initial_state": "equilibrium", "stated_std_factor": 1.0}
        self.options = SimpleNamespace(weighting=weighting, **common, **empty)
        everything = samples(
            ("points.tip",), np.full((data, 1), noise), positive_weight_mask=np.ones((data, 1), bool),
            value=np.zeros((data, 1)), node=np.arange(data), fraction=np.zeros(data), count=data,
        )  # fmt: skip
        grid = SimpleNamespace(steps=data, time_step=0.1)
        self.episodes = (SimpleNamespace(name="run", grid=grid, measurements=(everything,)),)
        self.step = SimpleNamespace(time_step=0.1)
        self.shared_parameters = tuple(name for name in self.free if "[" not in name)
        self.local_parameters = tuple(dict.fromkeys(name.split("[")[0] for name in self.free if "[" in name))
        kinds = dict(units or {})
        names = dict.fromkeys(name.split("[")[0] for name in self.unknown_names)
        entries = Parameters(Parameter(name, 1.0, kinds.get(name, "N m/rad")) for name in names)
        self.system = SimpleNamespace(parameters=entries)
        self.asked: list[tuple[float, ...]] = []

    def theta_and_initial_state_deviation(self, x: np.ndarray, episode: int) -> tuple[np.ndarray, np.ndarray]:
        values = dict(zip((name.split("[")[0] for name in self.unknown_names), np.asarray(x, float), strict=True))
        return np.array([values[name] for name in self.system.parameters.names]), np.zeros(0)

    @property
    def theta(self) -> np.ndarray:
        return self.theta_and_initial_state_deviation(self.initial_unknowns, 0)[0]

    @property
    def positive_unknowns_mask(self) -> np.ndarray:
        return (self.bounds[0] >= 0) & (self.initial_unknowns > 0)

    def evaluate(self, x: np.ndarray, derivatives: bool = True, equilibrium_guesses: object = None) -> Evaluation:
        x = np.asarray(x, float)
        self.asked.append(tuple(x))
        if self._fails(dict(zip(self.unknown_names, x, strict=True))):
            return Evaluation(np.inf, np.zeros(0), None, False, "it snaps", ())
        residual, jacobian = (np.array(ca.densify(part)) for part in self._function(x))
        residual = residual.ravel()
        done = (SimpleNamespace(predicted_outputs=(residual[self.residual_rows.data, None],), equilibrium_guess=None),)
        cost = 0.5 * float(residual @ residual)
        return Evaluation(cost, residual, jacobian if derivatives else None, True, "", done)


GOOD = GoodnessOfFit(1.0, 0.5, True)


def estimate(value, std=0.1, verdict="identifiable", free=True, initial=1.0) -> ParameterEstimate:
    return ParameterEstimate(value, std, "N m/rad", initial, 0.0, np.inf, free, verdict)


def solution(method="gauss_newton", status=Status.CONVERGED, cost=1.0, **parameters: ParameterEstimate) -> Solution:
    """What a method found; names are written with underscores for dots."""
    named = {name.replace("_", "."): entry for name, entry in parameters.items()}
    x = np.array([entry.value for entry in named.values()])
    return Solution(status, "done", tuple(named), x, np.eye(len(x)), named, cost, GOOD, (), 1, 0.1, None, method)

"""Made-up problems for the tests of analysis: a residual that is a formula of named unknowns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import casadi as ca
import numpy as np
from made_problems import MadeUp

from yid_ocp.inference.uncertainty import GoodnessOfFit, ParameterEstimate
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.solvers.base import Solution, Status


class Formula(MadeUp):
    """A problem whose residual is a CasADi expression of its unknowns.

    `rows` lead from symbols by name to the residual's rows: data, then so many `stated` priors, then `weak` ones;
    `fails` from values by name to whether the rollout fails.
    """

    guess = None

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
        fails: Callable[[dict[str, float]], bool] = lambda values: False,
    ) -> None:
        names = tuple(start)
        x = ca.SX.sym("x", len(names))
        residual = ca.vertcat(ca.SX(0, 1), *rows({name: x[i] for i, name in enumerate(names)}))
        function = ca.Function("rows", [x], [residual, ca.jacobian(residual, x)])

        def found(x: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray] | None:
            values, slopes = (np.array(ca.densify(part)) for part in function(x))
            return None if fails(dict(zip(names, x, strict=True))) else (values.ravel(), slopes)

        sizes = {name: abs(value) for name, value in start.items()} | dict(scales or {})
        more = {"scales": [sizes[name] or 1.0 for name in names], "weighting": "paper" if noise != 1 else "whitened"}
        more |= {"duration": 0.2 * (residual.numel() - stated - weak), "count": residual.numel(), "lower": -np.inf}
        super().__init__(found, list(start.values()), stated=stated, weak=weak, noise=noise, **more)
        self.unknown_names, self.episodes, self.whitening_filters = names, self.episodes[:1], (None,)
        self.episodes[0].name = "run"
        self.free = tuple(name for name in names if not name.startswith("start."))
        limits = dict.fromkeys(names, (0.0, np.inf)) | dict(bounds or {})
        self.bounds = tuple(np.array([limits[name][side] for name in names]) for side in (0, 1))
        self.shared_parameters = tuple(name for name in self.free if "[" not in name)
        self.local_parameters = tuple(dict.fromkeys(name.split("[")[0] for name in self.free if "[" in name))
        kinds, whole = dict(units or {}), dict.fromkeys(name.split("[")[0] for name in names)
        self.system.parameters = Parameters(Parameter(name, 1.0, kinds.get(name, "N m/rad")) for name in whole)
        self.theta, _ = self.unpack_episode_unknowns(self.initial_unknowns, 0)

    @property
    def points(self) -> list[tuple[float, ...]]:
        """Where it was evaluated."""
        return [tuple(x) for x, *_ in self.asked]

    def unpack_episode_unknowns(self, x: np.ndarray, episode: int) -> tuple[np.ndarray, np.ndarray]:
        values = dict(zip((name.split("[")[0] for name in self.unknown_names), np.asarray(x, float), strict=True))
        return np.array([values[name] for name in self.system.parameters.names]), np.zeros(0)


GOOD = GoodnessOfFit(1.0, 0.5, True)


def estimate(value, std=0.1, verdict="identifiable", free=True, initial=1.0) -> ParameterEstimate:
    return ParameterEstimate(value, std, "N m/rad", initial, 0.0, np.inf, free, verdict)


def solution(method="gauss_newton", status=Status.CONVERGED, cost=1.0, **parameters: ParameterEstimate) -> Solution:
    """What a method found; names are written with underscores for dots."""
    named = {name.replace("_", "."): entry for name, entry in parameters.items()}
    x = np.array([entry.value for entry in named.values()])
    return Solution(status, "done", tuple(named), x, np.eye(len(x)), named, cost, GOOD, (), 1, 0.1, None, method)

"""Shift of estimates with finer links or shorter time steps, and standard deviations that include it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.inference.linearized_residual import bounded_least_squares_step
from yid_ocp.inference.uncertainty import ParameterEstimate, verdict_by_relative_std
from yid_ocp.inference.whitening import whitened_at
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import EquilibriumGuesses, Evaluation
from yid_ocp.problem.unknown_vector import INITIAL_STATE_PREFIX

Array = NDArray[np.float64]

_START_ANGLE_PREFIX = f"{INITIAL_STATE_PREFIX}q."
_NORMAL_QUANTILE_95 = 1.96
_EXTRAPOLATION_FACTOR = 2.0
"""Distance to the limit of many links or short steps over the move of one halving, where the error falls as their size:
m + m/2 + m/4 + ... What falls faster has less to go."""


@dataclass(frozen=True)
class DiscretisationShift:
    """Shift of one estimate under a finer discretisation, in its own unit.

    Attributes
    ----------
    links : float or None
        With every link divided in two; None where not tried or where the finer model could not be rolled out.
    time_step : float or None
        With half the time step.
    """

    links: float | None = None
    time_step: float | None = None

    def inflated_std(self, std: float) -> float:
        """Standard deviation combined, in quadrature, with the shifts that exceed it.

        Such a shift counts `_EXTRAPOLATION_FACTOR` times: the extrapolated distance from the limit of a fine model.
        """
        found = [move for move in (self.links, self.time_step) if move is not None and abs(move) > std]
        return math.hypot(std, *(_EXTRAPOLATION_FACTOR * move for move in found)) if found else std


@dataclass(frozen=True)
class RefinedProblem:
    """An estimation problem with a finer discretisation, and how its unknowns map to the coarse ones.

    Attributes
    ----------
    problem : EstimationProblem
    parameter_factors : mapping of str to float
        Factor from a coarse parameter to the same physical object in the finer model; 1 for absent names.
    subdivided_joints : mapping of str to tuple of str
        For each joint of a divided link, the fine joints that share its angle.
    """

    problem: EstimationProblem
    parameter_factors: Mapping[str, float] = field(default_factory=dict)
    subdivided_joints: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def parameter_factor(self, name: str) -> float:
        """Coarse-to-fine factor of an unknown, whose name may include its recording."""
        return float(self.parameter_factors.get(name.split("[")[0], 1.0))

    def unknowns_from_coarse(self, names: Sequence[str], x: Array) -> Array:
        """The fine problem's unknowns that correspond to a coarse unknown vector, clipped to the bounds.

        In an estimated initial state, divided links share their angle and begin at rest.
        """
        made, at = self.problem.initial_unknowns, {name: i for i, name in enumerate(self.problem.unknown_names)}
        for name, value in zip(names, x, strict=True):
            base, bracket, recording = name.partition("[")
            parts = (
                self.subdivided_joints.get(base.rpartition(".")[2]) if base.startswith(INITIAL_STATE_PREFIX) else None
            )
            if parts is None and name in at:
                made[at[name]] = value * self.parameter_factor(name)
            elif parts is not None and base.startswith(_START_ANGLE_PREFIX):
                for part in parts:
                    made[at[f"{_START_ANGLE_PREFIX}{part}{bracket}{recording}"]] = value / len(parts)
        return np.clip(made, *self.problem.bounds)

    def equilibrium_guesses_from_coarse(self, coarse: System, found: EquilibriumGuesses) -> EquilibriumGuesses:
        """Initial guesses for the fine model's equilibria, from the coarse ones."""
        return tuple(None if q is None else self._shape(coarse, q) for q in found)

    def _shape(self, coarse: System, q: Array) -> Array:
        tree = self.problem.system.mechanism
        fine = np.zeros(len(tree.joints))
        for name, angle in zip(coarse.mechanism.joint_names, q, strict=True):
            parts = self.subdivided_joints.get(name, (name,))
            fine[[tree.joint_index(part) for part in parts]] = angle / len(parts)
        return fine


def joint_subdivision(coarse: System, fine: System) -> dict[str, tuple[str, ...]]:
    """For each divided joint of the coarse model, the names of the fine joints that replace it."""
    found = {}
    for segment in coarse.segment_layouts:
        links = fine.segment_layout(segment.name).link_joints
        times = len(links) // len(segment.link_joints)
        for i, joints in enumerate(segment.link_joints):
            for axis, joint in enumerate(joints):
                found[joint] = tuple(links[times * i + k][axis] for k in range(times))
    return {joint: parts for joint, parts in found.items() if len(parts) > 1}


def discretisation_shifts(
    refined: RefinedProblem,
    coarse: EstimationProblem,
    x: Array,
    at_x: Evaluation,
    *,
    model_difference_only: bool = False,
) -> dict[str, float] | str:
    """Shift of each shared free parameter by one Gauss-Newton step of a finer model from the coarse unknowns.

    Data, bounds and priors are those of the coarse problem. With `model_difference_only` the coarse model's prediction replaces
    the data, so that away from an estimate only the difference between the two models counts.

    Parameters
    ----------
    refined : Refined
    coarse : EstimationProblem
    x : ndarray, shape (nx,)
    at_x : Evaluation
        Of the coarse problem at `x`.
    model_difference_only : bool

    Returns
    -------
    dict of str to float, or str
        In the coarse parameters' units; a message where the step cannot be made.
    """
    point, warm = (
        refined.unknowns_from_coarse(coarse.unknown_names, x),
        refined.equilibrium_guesses_from_coarse(coarse.system, at_x.equilibrium_guesses),
    )
    weighted = any(own is not None for own in coarse.whitening_filters)
    problem = whitened_at(refined.problem, point, warm, rounds=2) if weighted else refined.problem
    evaluation = problem.evaluate(point, equilibrium_guesses=warm)
    if not evaluation.ok or evaluation.jacobian is None:
        return evaluation.message
    residual = evaluation.residual
    if model_difference_only:
        if problem.residual_rows != coarse.residual_rows:
            return "the finer model is compared at other samples"
        residual = residual - at_x.residual
    lower, upper = (bound - point for bound in problem.bounds)
    scale = problem.unknown_scales
    step = scale * bounded_least_squares_step(evaluation.jacobian * scale, residual, 0.0, lower / scale, upper / scale)
    at = {name: i for i, name in enumerate(problem.unknown_names)}
    return {name: float(step[at[name]]) / refined.parameter_factor(name) for name in problem.shared_parameters}


def inflate_estimates(
    estimates: Mapping[str, ParameterEstimate],
    found: Mapping[str, DiscretisationShift],
    sizes: Mapping[str, float] | None = None,
) -> dict[str, ParameterEstimate]:
    """Estimates whose standard deviation, interval and verdict include their discretisation shift.

    A verdict is only ever lowered.

    Parameters
    ----------
    estimates : mapping of str to Estimate
    found : mapping of str to Moves
    sizes : mapping of str to float, optional
        Typical size of each parameter, as in `inference.uncertainty.parameter_verdict`.
    """
    counted = dict(estimates)
    for name, own in found.items():
        entry = counted[name]
        std = own.inflated_std(entry.std)
        if not entry.free or not std > entry.std:
            continue
        said = _worse_verdict(entry.verdict, verdict_by_relative_std(entry.value, std, (sizes or {}).get(name, 0.0)))
        interval = entry.interval
        if interval is not None:
            further = _NORMAL_QUANTILE_95 * math.sqrt(std**2 - entry.std**2)
            low, high = interval
            low = None if low is None else max(low - further, entry.lower)
            interval = low, None if high is None else min(high + further, entry.upper)
        counted[name] = replace(entry, std=std, verdict=said, interval=interval)
    return counted


def _worse_verdict(before: str, after: str) -> str:
    """The worse of two verdicts; `before` where either is not one of the three ranked ones."""
    ranks = ("identifiable", "weak", "not_identifiable")
    if before not in ranks or after not in ranks:
        return before
    return max(before, after, key=ranks.index)

"""Shift of estimates with finer links or shorter time steps, and standard deviations that include it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation, WarmStart
from yid_ocp.problem.unknowns import START
from yid_ocp.solvers.judgement import Estimate, by_size
from yid_ocp.solvers.linear_model import bounded_step

Array = NDArray[np.float64]

ANGLE = f"{START}q."
NORMAL_95 = 1.96
REMAINING = 2.0
"""Distance to the limit of many links or short steps over the move of one halving, where the error falls as their size:
m + m/2 + m/4 + ... What falls faster has less to go."""


@dataclass(frozen=True)
class Moves:
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

    def counted(self, std: float) -> float:
        """Standard deviation combined, in quadrature, with the shifts that exceed it.

        Such a shift counts `REMAINING` times: the extrapolated distance from the limit of a fine model.
        """
        found = [move for move in (self.links, self.time_step) if move is not None and abs(move) > std]
        return math.hypot(std, *(REMAINING * move for move in found)) if found else std


@dataclass(frozen=True)
class Refined:
    """An estimation problem with a finer discretisation, and how its unknowns map to the coarse ones.

    Attributes
    ----------
    problem : EstimationProblem
    factors : mapping of str to float
        Factor from a coarse parameter to the same physical object in the finer model; 1 for absent names.
    divided : mapping of str to tuple of str
        For each joint of a divided link, the fine joints that share its angle.
    """

    problem: EstimationProblem
    factors: Mapping[str, float] = field(default_factory=dict)
    divided: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def factor(self, name: str) -> float:
        """Coarse-to-fine factor of an unknown, whose name may include its recording."""
        return float(self.factors.get(name.split("[")[0], 1.0))

    def point(self, names: Sequence[str], x: Array) -> Array:
        """The fine problem's unknowns that correspond to a coarse unknown vector, clipped to the bounds.

        In an estimated initial state, divided links share their angle and begin at rest.
        """
        made, at = self.problem.start, {name: i for i, name in enumerate(self.problem.names)}
        for name, value in zip(names, x, strict=True):
            base, bracket, recording = name.partition("[")
            parts = self.divided.get(base.rpartition(".")[2]) if base.startswith(START) else None
            if parts is None and name in at:
                made[at[name]] = value * self.factor(name)
            elif parts is not None and base.startswith(ANGLE):
                for part in parts:
                    made[at[f"{ANGLE}{part}{bracket}{recording}"]] = value / len(parts)
        return np.clip(made, *self.problem.bounds)

    def warm(self, coarse: System, found: WarmStart) -> WarmStart:
        """Initial guesses for the fine model's equilibria, from the coarse ones."""
        return tuple(None if q is None else self._shape(coarse, q) for q in found)

    def _shape(self, coarse: System, q: Array) -> Array:
        tree = self.problem.system.mechanism
        fine = np.zeros(len(tree.joints))
        for name, angle in zip(coarse.mechanism.joint_names, q, strict=True):
            parts = self.divided.get(name, (name,))
            fine[[tree.joint_index(part) for part in parts]] = angle / len(parts)
        return fine


def divided_joints(coarse: System, fine: System) -> dict[str, tuple[str, ...]]:
    """For each divided joint of the coarse model, the names of the fine joints that replace it."""
    found = {}
    for segment in coarse.segments:
        links = fine.segment(segment.name).links
        times = len(links) // len(segment.links)
        for i, joints in enumerate(segment.links):
            for axis, joint in enumerate(joints):
                found[joint] = tuple(links[times * i + k][axis] for k in range(times))
    return {joint: parts for joint, parts in found.items() if len(parts) > 1}


def moves(
    refined: Refined, coarse: EstimationProblem, x: Array, at_x: Evaluation, *, models_alone: bool = False
) -> dict[str, float] | str:
    """Shift of each shared free parameter by one Gauss-Newton step of a finer model from the coarse unknowns.

    Data, bounds and priors are those of the coarse problem. With `models_alone` the coarse model's prediction replaces
    the data, so that away from an estimate only the difference between the two models counts.

    Parameters
    ----------
    refined : Refined
    coarse : EstimationProblem
    x : ndarray, shape (nx,)
    at_x : Evaluation
        Of the coarse problem at `x`.
    models_alone : bool

    Returns
    -------
    dict of str to float, or str
        In the coarse parameters' units; a message where the step cannot be made.
    """
    point, warm = refined.point(coarse.names, x), refined.warm(coarse.system, at_x.warm)
    weighted = any(own is not None for own in coarse.innovations)
    problem = refined.problem.weighted_at(point, warm, rounds=2) if weighted else refined.problem
    evaluation = problem.evaluate(point, warm=warm)
    if not evaluation.ok or evaluation.jacobian is None:
        return evaluation.message
    residual = evaluation.residual
    if models_alone:
        if problem.rows != coarse.rows:
            return "the finer model is compared at other samples"
        residual = residual - at_x.residual
    lower, upper = (bound - point for bound in problem.bounds)
    scale = problem.scales
    step = scale * bounded_step(evaluation.jacobian * scale, residual, 0.0, lower / scale, upper / scale)
    at = {name: i for i, name in enumerate(problem.names)}
    return {name: float(step[at[name]]) / refined.factor(name) for name in problem.shared}


def counting(
    estimates: Mapping[str, Estimate], found: Mapping[str, Moves], sizes: Mapping[str, float] | None = None
) -> dict[str, Estimate]:
    """Estimates whose standard deviation, interval and verdict include their discretisation shift.

    A verdict is only ever lowered.

    Parameters
    ----------
    estimates : mapping of str to Estimate
    found : mapping of str to Moves
    sizes : mapping of str to float, optional
        Typical size of each parameter, as in `solvers.judgement.verdict`.
    """
    counted = dict(estimates)
    for name, own in found.items():
        entry = counted[name]
        std = own.counted(entry.std)
        if not entry.free or not std > entry.std:
            continue
        said = lower_of(entry.verdict, by_size(entry.value, std, (sizes or {}).get(name, 0.0)))
        interval = entry.interval
        if interval is not None:
            further = NORMAL_95 * math.sqrt(std**2 - entry.std**2)
            low, high = interval
            low = None if low is None else max(low - further, entry.lower)
            interval = low, None if high is None else min(high + further, entry.upper)
        counted[name] = replace(entry, std=std, verdict=said, interval=interval)
    return counted


def lower_of(before: str, after: str) -> str:
    """The worse of two verdicts; `before` where either is not one of the three ranked ones."""
    ranks = ("identifiable", "weak", "not_identifiable")
    if before not in ranks or after not in ranks:
        return before
    return max(before, after, key=ranks.index)

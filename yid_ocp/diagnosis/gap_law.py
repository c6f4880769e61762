"""Estimation of a torque law, a smooth function of known quantities, for a gap that no accepted effect explains."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg

from yid_ocp.analysis.discretisation import problem_with_data_of
from yid_ocp.arrays import Array
from yid_ocp.diagnosis.events import EventSet, problem_corrected_for_events
from yid_ocp.diagnosis.hypotheses import KEPT_HELD_OUT_FRACTIONS, AllCandidatesProblem
from yid_ocp.diagnosis.refit import RefitContext, RefittedModel, refit_with_effects
from yid_ocp.effects import EffectBase
from yid_ocp.effects.law import (
    TORQUE_LAW_QUANTITY_UNITS,
    TorqueLaw,
    TorqueLawTable,
    allowed_torque_law_quantity_names,
    torque_law_from_tables,
    torque_law_quantity_at_midpoints,
)
from yid_ocp.inference import null_test
from yid_ocp.inference.linearized_residual import residual_and_jacobian_with_stated_priors
from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import MultivariateGaussianPrior

_N_KNOTS = 12
_MAX_PLACES = 3  # largest number of gap locations at which a law is estimated
_MAX_REFITS = 3  # largest number of refitted families; includes the torque over time
_ROUGHNESS_WEIGHTS = tuple(10.0**power for power in range(-3, 5))  # curvature weights; the evidence chooses among them
_RIDGE_STD_RATIO = 3.0  # prior std of the torque at a knot (apart from curvature) over the std of torques there
_MIN_KNOT_RANGE = 1e-3  # smallest range of knots, for a quantity that hardly changes [unit of the quantity]
_EVEN_STD_RATIO = 1 / 300  # std of f(x) + f(-x) over the prior's width, for a drive: its law is nearly odd
_MIN_VISITED_PART = 0.7  # fraction of the knots' range that a fitted law must visit to keep its knots
_MIN_CLOSURE = 0.05  # fraction of the gap that a law must close, and a second quantity beside the first
_MIN_LEFTOVER_CLOSURE = 0.2  # fraction that a law must close of the gap that accepted effects leave


@dataclass(frozen=True)
class NonparametricLaw:
    """A torque law for the gap, or for the part of it that accepted effects leave, with its closure."""

    location: str
    tables: tuple[TorqueLawTable, ...]  # one table per quantity
    visited_range: Mapping[str, tuple[float, float]]  # range of every quantity in the estimation recordings
    closure: null_test.HeldOutGapClosure  # closure of the held-out gap of the model without the law
    runner_up: tuple[str, str, float] | None  # location, quantities and closure of the second best law
    model: RefittedModel  # the fitted model with the accepted effects and the law, which is the last effect

    @property
    def depends_on(self) -> str:
        """The quantities on which the torque depends, joined with `+`."""
        return "+".join(table.quantity for table in self.tables)

    @property
    def sentence(self) -> str:
        """A sentence about the law that states its location, quantity and size, and the closed fraction of the gap."""
        names, is_over_time = " and ".join(t.quantity for t in self.tables), self.depends_on == "time"
        words = "time" if is_over_time else f"the {names} of {self.location}"
        sizes = []
        for table in self.tables:
            low, high = self.visited_range[table.quantity]
            seen = (table.knots >= low) & (table.knots <= high)
            at, torque, unit = table.knots[seen], table.torque[seen], TORQUE_LAW_QUANTITY_UNITS[table.quantity]
            if len(torque):
                ends = (f"{torque[i]:.2g} N m at {at[i]:.2g} {unit}" for i in (torque.argmin(), torque.argmax()))
                sizes.append(f"from {' to '.join(ends)}")
        gap = f"error beyond noise{' that the effects leave' * (len(self.model.effects) > 1)} on held-out motions"
        head = f"The error looks like a torque at {self.location} that depends on {words} ({', '.join(sizes)})."
        closed = f"It would remove {100 * self.closure.fraction:.3g} % of the {gap}. No accepted effect describes it."
        outside = "It may come from outside the model, because no law of motion or load predicts it better."
        end = outside if is_over_time else "law.csv of the run folder adds it to the model (docs/howto/law.md)."
        return f"{head} {closed} {end}"

    def to_dict(self) -> dict[str, Any]:
        """Convert the law to a dictionary with location, depends_on, table, closure, visited_range and runner_up."""
        rows = [
            {"quantity": t.quantity, "unit": TORQUE_LAW_QUANTITY_UNITS[t.quantity], "at": x, "torque": f, "std": s}
            for t in self.tables
            for x, f, s in zip(t.knots, t.torque, t.torque_std, strict=True)
        ]
        rival = self.runner_up and dict(zip(("location", "depends_on", "closure"), self.runner_up, strict=True))
        return {
            "location": self.location,
            "depends_on": self.depends_on,
            "table": rows,
            **self.closure.to_dict(),
            "visited_range": self.visited_range,
            "runner_up": rival,
            "sentence": self.sentence,
        }


@dataclass(frozen=True)
class _Family:
    """A candidate law: a function of some quantities at one location, with the results of a linearised fit."""

    law: TorqueLaw  # restricted to the quantities
    log_evidence: float
    values: dict[str, float]  # values of the linearised fit at the knots
    precision: Array  # inverse prior covariance of these values, in the order of the law's parameters


def find_gap_law(
    search: RefitContext, problem: EstimationProblem, last: RefittedModel, places: Sequence[str], events: EventSet
) -> NonparametricLaw | None:
    """Estimate a torque law for the remaining gap. Returns None if no law is possible, or none closes enough of it.

    `problem` is that of the nominal model, without candidates. `last` is the fitted model with the accepted effects, or
    the nominal one. `places` are the locations of the gap, the most likely first.
    """
    places = [p for p in dict.fromkeys(places) if allowed_torque_law_quantity_names(problem.system, p)][:_MAX_PLACES]
    if not places or search.is_skipped_past_deadline("a torque law"):
        return None
    if (h := last.problem.step.time_step) != problem.step.time_step:
        problem = problem.with_time_step(h)
    search.progress.begin_stage(f"estimating a torque law at {' or '.join(places)}", 3.0, 2.5)
    # a torque over time would interpolate the held-out blocks
    left_out = ("time",) if search.problem.is_split_in_blocks else ()
    laws = []
    for place in places:
        quantities = [q for q in allowed_torque_law_quantity_names(problem.system, place) if q not in left_out]
        laws.append(_neutral_law(last, place, quantities))
    before, found = _refitted_families(search, problem, last, laws, events)
    if before is None or not found:
        return None
    found.sort(key=lambda entry: entry.loss.chi2_per_sample)
    # if one quantity predicts as well as two, one is used
    slack = _MIN_CLOSURE * before.held_out_loss.excess_chi2_per_sample
    found = sorted(found, key=lambda entry: not _is_simplest_of_the_best(entry, found, slack))
    best, *others = found
    runner_up = None
    if others:
        rival, closed = others[0].law, null_test.held_out_gap_closure(before.held_out_loss, others[0].loss)
        runner_up = (rival.location, "+".join(rival.quantities), closed.fraction)
    # the model without the law may move far beyond the recorded range: new knots for the visited range
    visited = {quantity: _visited_range(best.fit, best.law.location, quantity) for quantity in best.law.quantities}
    before_knots = best.law.knots or {}
    if any(np.ptp(ends) < _MIN_VISITED_PART * np.ptp(before_knots[name]) for name, ends in visited.items()):
        finer = _neutral_law(best.fit, best.law.location, best.law.quantities, last.problem.system)
        again, better = _refitted_families(search, problem, last, [finer], events, best.law.quantities)
        if again is not None and better and better[0].loss.chi2_per_sample <= best.loss.chi2_per_sample:
            best = better[0]
    closure = null_test.held_out_gap_closure(before.held_out_loss, best.loss)
    least = _MIN_LEFTOVER_CLOSURE if last.effects else _MIN_CLOSURE
    gained, error = null_test.chi2_per_sample_decrease_and_std_error(before.held_out_loss, best.loss)
    if not (gained > error and closure.ci_low > least):
        return None
    ranges = {name: _visited_range(best.fit, best.law.location, name) for name in best.law.quantities}
    curves = []
    for quantity, knots in (best.law.knots or {}).items():
        names = best.law.knot_parameter_names(quantity)
        torque, std = (np.array([own[name] for name in names]) for own in (best.fit.values, best.fit.std))
        curves.append(TorqueLawTable(quantity, knots, torque, std))
    return NonparametricLaw(best.law.location, tuple(curves), ranges, closure, runner_up, best.fit)


@dataclass(frozen=True)
class _RefittedLaw:
    law: TorqueLaw
    fit: RefittedModel
    loss: null_test.HeldOutLoss  # of `fit`, without the chi2 of the law's prior


def _refitted_families(
    search: RefitContext,
    problem: EstimationProblem,
    last: RefittedModel,
    laws: Sequence[TorqueLaw],
    events: EventSet,
    only: Sequence[str] = (),
) -> tuple[RefittedModel | None, list[_RefittedLaw]]:
    """Return a refit of the model without a law, and refits with each of the best laws, in one compiled step."""
    # data are corrected for links and events, and recordings truncated, as in the diagnosis
    held_out = [] if search.problem.is_split_in_blocks else [e.recording for e in search.problem.problem.held_out]
    composed = AllCandidatesProblem.from_problem(problem, (*last.effects, *laws), held_out)
    corrected = problem_corrected_for_events(problem_with_data_of(composed.problem, last.problem), events)
    composed = replace(composed, problem=corrected, refit_solver=search.problem.refit_solver)
    start = {name: value for name, value in last.values.items() if not name.startswith("start.")}
    composed, _ = composed.truncate_failing_held_out_recordings(start, KEPT_HELD_OUT_FRACTIONS[0])
    composed = composed.with_whitening_linearized_at(last.values, last.effects)
    before = refit_with_effects(replace(search, problem=composed, store={}), last.effects, last.values)
    if before is None:
        return None, []
    composed = replace(composed, problem=before.problem.with_free_parameters_without_recompiling(problem.free))
    found = []
    for family in _ranked_families(composed, before, laws):
        fit = None if only and family.law.quantities != tuple(only) else _refitted(composed, before, family, search)
        if fit is not None and np.isfinite(fit.held_out_loss.total_chi2):
            loss = replace(fit.held_out_loss, baseline_chi2=before.held_out_loss.baseline_chi2)
            found.append(_RefittedLaw(family.law, fit, loss))
    return before, found


def _is_simplest_of_the_best(entry: _RefittedLaw, found: Sequence[_RefittedLaw], slack: float) -> bool:
    """Return whether a refit predicts about as well as the best (the first), with the fewest quantities of such."""

    def is_as_good(own: _RefittedLaw) -> bool:
        gained, error = null_test.chi2_per_sample_decrease_and_std_error(own.loss, found[0].loss)
        return gained <= max(2 * error, slack)

    fewest = min(len(own.law.quantities) for own in found if is_as_good(own))
    return is_as_good(entry) and len(entry.law.quantities) == fewest


def _neutral_law(model: RefittedModel, place: str, names: Sequence[str], system: System | None = None) -> TorqueLaw:
    """Return a law with zero torque at a location: a sum of functions of each quantity, with knots over its range."""
    tables, zeros = [], np.zeros(_N_KNOTS)
    for quantity in names:
        low, high = _visited_range(model, place, quantity)
        if quantity == "command":
            low, high = min(low, -high), max(high, -low)
        room = max(high - low, _MIN_KNOT_RANGE) / (_N_KNOTS - 3)
        # knots reach half an interval beyond the range, so that its ends are estimated
        tables.append(TorqueLawTable(quantity, np.linspace(low - room / 2, high + room / 2, _N_KNOTS), zeros, zeros))
    # std of the torque of springs or through the joint [N m]
    size = float(np.std(_visited(model, place, "load"))) or 1.0
    return torque_law_from_tables(place, system or model.problem.system, tables, _RIDGE_STD_RATIO * size)


def _visited(model: RefittedModel, place: str, quantity: str) -> Array:
    """Return the values (samples,) of a quantity in all estimation recordings."""
    problem, x, found = model.problem, model.unknowns, []
    for i, (episode, result) in enumerate(zip(problem.episodes, model.evaluation.episode_predictions, strict=True)):
        theta = problem.predictor.theta_with_episode_values(episode, problem.unpack_episode_unknowns(x, i)[0])
        nodes = {name: getattr(result.rollout, name) for name in ("state", "torque", "multipliers")}
        nodes["time_step"] = np.array(episode.grid.time_step)
        found.append(torque_law_quantity_at_midpoints(problem.system, place, quantity, theta, nodes).ravel())
    values = np.concatenate(found)
    return values[np.isfinite(values)]


def _visited_range(model: RefittedModel, place: str, quantity: str) -> tuple[float, float]:
    values = _visited(model, place, quantity)
    return (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)


def _ranked_families(composed: AllCandidatesProblem, before: RefittedModel, laws: Sequence[TorqueLaw]) -> list[_Family]:
    """Return the laws to refit, ordered by the evidence of a fit that is linearised about the model without a law."""
    own = composed.problem_with_effects_and_relinearized_filters((*before.effects, *laws), before.values)
    evaluation = own.evaluate(own.pack_unknowns(before.values), True, before.evaluation.equilibrium_guesses)
    if not evaluation.ok or evaluation.jacobian is None:
        return []
    residual, jacobian = residual_and_jacobian_with_stated_priors(own, evaluation)
    names = list(own.unknown_names)
    ours = {name for law in laws for name in law.parameters.names}
    basis, _ = np.linalg.qr(jacobian[:, [i for i, name in enumerate(names) if name not in ours]])
    residual = residual - basis @ (basis.T @ residual)
    families = []
    for law in laws:

        def family(*quantities: str, law: TorqueLaw = law) -> _Family:
            part = law.restricted_to_quantities(quantities)
            at = [names.index(name) for name in part.parameters.names]
            return _family(part, residual, jacobian[:, at] - basis @ (basis.T @ jacobian[:, at]))

        single = list(map(family, law.quantities))
        both = [family("angle", "speed")] if {"angle", "speed"} <= set(law.quantities) else []
        # two quantities are refitted only if their evidence is above that of each alone
        families += [*single, *(own for own in both if own.log_evidence > max(one.log_evidence for one in single))]
    families.sort(key=lambda family: -family.log_evidence)
    over_time = [family for family in families if family.law.quantities == ("time",)]
    return [*[family for family in families if family.law.quantities != ("time",)][: _MAX_REFITS - 1], *over_time[:1]]


def _family(law: TorqueLaw, residual: Array, slopes: Array) -> _Family:
    """Return evidence, values and prior of one law, at the curvature weight and noise level of largest evidence."""
    n, gram, pull = len(residual), slopes.T @ slopes, slopes.T @ residual
    total = float(residual @ residual)
    families = []
    for weight in _ROUGHNESS_WEIGHTS:
        precision = _prior_precision(law, weight)
        matrix = gram + precision
        values = np.asarray(-np.linalg.solve(matrix, pull), float)
        left = max(total + float(pull @ values), 1e-12 * total, 1e-300)
        shrink = np.linalg.slogdet(precision)[1] - np.linalg.slogdet(matrix)[1]
        evidence = -0.5 * n * math.log(left / n) + 0.5 * float(shrink)
        by_name = dict(zip(law.parameters.names, values.tolist(), strict=True))
        families.append(_Family(law, evidence, by_name, precision))
    return max(families, key=lambda family: family.log_evidence)


def _prior_precision(law: TorqueLaw, roughness_weight: float) -> Array:
    """Return the inverse prior covariance of a law's values at its knots, for their curvature and their size."""
    blocks = []
    for quantity in law.quantities:
        count = len(law.knot_parameter_names(quantity))
        width = law.prior_ranges[law.knot_parameter_names(quantity)[0]][1]
        bends = np.diff(np.eye(count), n=2, axis=0) * (_RIDGE_STD_RATIO / width)
        block = roughness_weight * bends.T @ bends + np.eye(count) / width**2
        if quantity == "command":
            even = (np.eye(count) + np.eye(count)[::-1]) / (_EVEN_STD_RATIO * width)
            block += even.T @ even
        blocks.append(block)
    return np.asarray(scipy.linalg.block_diag(*blocks), float)


def _refitted(
    composed: AllCandidatesProblem, before: RefittedModel, family: _Family, search: RefitContext
) -> RefittedModel | None:
    """Return a refit of the model with a law, whose values at the knots have a prior. None if it fails."""
    known = composed.problem.options.multivariate_prior
    names = (*known.parameter_names, *family.law.parameters.names)
    prior = MultivariateGaussianPrior(names, scipy.linalg.block_diag(known.covariance, np.linalg.inv(family.precision)))
    with_prior = replace(composed, problem=composed.problem.with_replaced_multivariate_prior(prior))
    context = replace(search, problem=with_prior, store={})
    effects: tuple[EffectBase, ...] = (*before.effects, family.law)
    return refit_with_effects(context, effects, {**before.values, **family.values})

"""What does the real servo lack beyond friction: a torque as a function of which quantity?

    python benchmarks/servo_law.py [QUANTITY ...] [--friction load_stribeck]

The recordings of `configs/servo_pendulum.yaml` have a friction law in the model and a law of one quantity beside it.
Each kind of motion is left out in turn and predicted; the error is the mean over kinds. Values of the law beyond what
the other kinds visit stay what they are at the end of that.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from yid_ocp.analysis import friction_law_comparison as ladder
from yid_ocp.arrays import Array
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import FrictionLawSettings
from yid_ocp.diagnosis import gap_law
from yid_ocp.effects.law import (
    TorqueLaw,
    TorqueLawTable,
    torque_law_from_tables,
    torque_law_quantity_at_midpoints,
)
from yid_ocp.inference.linearized_residual import residual_and_jacobian_with_stated_priors
from yid_ocp.integrator.step import compile_step_like
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.options import MultivariateGaussianPrior
from yid_ocp.solvers import GaussNewton, Solution, fit_problem
from yid_ocp.workflow.build_problem import build_problem

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "servo_pendulum.yaml"
JOINT, N_KNOTS = "joint", 12
QUANTITIES = ("angle", "speed", "load", "command", "time")
TORQUE_STD = 0.3  # expected of the law [N m]
FLAT_STD = 1e-3  # of differences between neighbouring knots where no other kind of motion went [N m]
MAX_ITERATIONS = 40


def visited(problem: EstimationProblem, solution: Solution, quantity: str) -> dict[str, Array]:
    """Values of a quantity in the fit's rollout of every recording."""
    found = {}
    for i, (episode, result) in enumerate(zip(problem.episodes, solution.evaluation.episode_predictions, strict=True)):
        deviated, _ = problem.unpack_episode_unknowns(solution.x, i)
        theta = problem.predictor.theta_with_episode_values(episode, deviated)
        own = result.rollout
        nodes = {"state": own.state, "torque": own.torque, "multipliers": own.multipliers}
        nodes["time_step"] = np.array(episode.grid.time_step)
        values = torque_law_quantity_at_midpoints(problem.system, JOINT, quantity, theta, nodes).ravel()
        found[episode.name] = values[np.isfinite(values)]
    return found


def with_prior(problem: EstimationProblem, law: TorqueLaw, precision: Array) -> EstimationProblem:
    known = problem.options.multivariate_prior
    count, names = len(known.parameter_names), (*known.parameter_names, *law.parameters.names)
    covariance = np.zeros((len(names),) * 2)
    covariance[:count, :count], covariance[count:, count:] = known.covariance, np.linalg.inv(precision)
    return problem.with_replaced_multivariate_prior(MultivariateGaussianPrior(names, covariance))


def left_out_errors(
    base: EstimationProblem, solution: Solution, quantity: str, kinds: Mapping[str, Sequence[str]]
) -> dict[str, float]:
    """Errors of recordings, each predicted by fits without its kind, with a law of one quantity in the model."""
    values = visited(base, solution, quantity)
    low, high = np.quantile(np.concatenate(list(values.values())), [0.005, 0.995])
    if quantity == "command":
        low, high = min(low, -high), max(high, -low)
    room, zeros = (high - low) / (N_KNOTS - 3), np.zeros(N_KNOTS)
    knots = np.linspace(low - room / 2, high + room / 2, N_KNOTS)
    law = torque_law_from_tables(JOINT, base.system, [TorqueLawTable(quantity, knots, zeros, zeros)], TORQUE_STD)
    names, known = law.parameters.names, base.unknowns.named_values(solution.x)
    step = compile_step_like(base.step, base.system.with_effects([law]))
    nominal = dict(zip(base.system.parameters.names, map(float, base.theta), strict=True))
    recordings = [episode.recording for episode in base.episodes]
    problem = EstimationProblem(step, recordings, (*base.free, *names), base.options, nominal)
    evaluation = problem.evaluate(problem.pack_unknowns(known))
    residual, jacobian = residual_and_jacobian_with_stated_priors(problem, evaluation)
    at = [problem.unknown_names.index(name) for name in names]
    basis, _ = np.linalg.qr(np.delete(jacobian, at, axis=1))
    rest, slopes = (x - basis @ (basis.T @ x) for x in (residual, jacobian[:, at]))
    family = gap_law._family(law, rest, slopes)
    whole = with_prior(problem, law, family.precision)
    fitted = GaussNewton(max_iterations=MAX_ITERATIONS).minimize_cost(
        whole, whole.pack_unknowns(known | family.values), None
    )
    errors = dict[str, float]()
    for kind, own in kinds.items():
        others = np.concatenate([x for name, x in values.items() if name not in own])
        first, last = np.quantile(others, [0.002, 0.998])
        slope = np.diff(np.eye(N_KNOTS), axis=0)[(knots[:-1] < first) | (knots[1:] > last)] / FLAT_STD
        fold = with_prior(problem, law, family.precision + slope.T @ slope)
        start = replace(solution, x=fitted.x, parameters={})
        errors |= ladder.cross_validate_law_by_motion_kind("", fold, start, {kind: own}).left_out_errors
    return errors


def main() -> int:
    parser = argparse.ArgumentParser(description="A law of one quantity beside the friction of a real servo.")
    parser.add_argument("quantities", nargs="*", default=QUANTITIES, help=", ".join(QUANTITIES))
    parser.add_argument("--friction", default="load_stribeck", help="law of friction in the model")
    arguments = parser.parse_args()
    run = load_config(CONFIG)
    friction = FrictionLawSettings(law=arguments.friction, joints=None)
    model = replace(run.model, friction=friction)
    base = ladder.problem_estimating_from_all_recordings(build_problem(replace(run, model=model)))
    kinds, solution = ladder.recording_names_by_name_stem(base), fit_problem(base, run.solver, restarts=False)
    print("| law of | error on kinds left out [rad] | " + " | ".join(n for own in kinds.values() for n in own) + " |")
    for quantity in (None, *arguments.quantities):
        if quantity is None:
            errors = dict(ladder.cross_validate_law_by_motion_kind("", base, solution, kinds).left_out_errors)
        else:
            errors = left_out_errors(base, solution, quantity, kinds)
        mean, std = ladder.mean_and_std_error_over_motion_kinds(errors, kinds)
        singles = " | ".join(f"{errors[name]:.3f}" for own in kinds.values() for name in own)
        print(f"| {quantity or 'none'} | {mean:.4f} ± {std:.4f} | {singles} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

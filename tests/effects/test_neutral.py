"""At neutral parameters every effect, alone and all together, leaves the nominal model as it is."""

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.effects import EFFECTS, SENSOR_KINDS, candidate_effects, make_effect
from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.statics import EquilibriumSolver
from yid_ocp.integrator.step import compile_step
from yid_ocp.virtual.experiment import baxter_foam_y_system

POSTURE = (-0.55, -1.0, -0.2, 1.3, -0.1, 1.1, 0.0)


def largest(difference, reference) -> float:
    return float(np.max(np.abs(difference)) / np.max(np.abs(reference)))


@pytest.mark.parametrize("mode", ["driven", "prescribed"])
def test_all_together_change_nothing(mode, benches, all_effects, sensors) -> None:
    bench = benches[mode]
    effects = all_effects(bench.system)
    plain, full = bench.run(bench.plain), bench.run(bench.step(*effects))
    assert full.rollout.status.is_converged
    assert full.rollout.status.newton_iterations <= 1.5 * plain.rollout.status.newton_iterations
    assert largest(bench.nominal_part(full) - bench.nominal_part(plain), bench.nominal_part(plain)) < 1e-10
    assert largest(full.rollout.multipliers - plain.rollout.multipliers, plain.rollout.multipliers) < 1e-10
    watched = [sensors.camera, sensors.arm] + ([sensors.effort] if mode == "prescribed" else [])
    for sensor in watched:
        nominal = bench.reading(plain, sensor)
        assert largest(bench.reading(full, sensor) - nominal, nominal) < 1e-10


@pytest.mark.parametrize("kind", [kind for kind in EFFECTS if not kind.startswith("servo_")])
def test_alone_it_changes_nothing_and_has_a_slope(kind, benches) -> None:
    bench = benches["driven"]
    places = [place for k, place in candidate_effects(bench.system, SENSOR_KINDS) if k == kind]
    assert places, f"{kind} fits nowhere"
    effect = make_effect(kind, places[-1], bench.system)
    assert effect.neutral_values == {entry.name: entry.value for entry in effect.parameters}
    step = bench.step(effect)
    plain, run = bench.run(bench.plain, steps=3), bench.run(step, names=effect.parameters.names, steps=3)
    assert run.rollout.status.is_converged
    assert largest(bench.nominal_part(run) - bench.nominal_part(plain), bench.nominal_part(plain)) < 1e-10
    assert np.all(np.isfinite(run.rollout.state_sensitivity))
    q, p, z = np.split(run.start, [step.sizes["n"], 2 * step.sizes["n"]])
    a, _, _ = step.jacobians(q, p, bench.torque[0], run.theta, internal=z)
    assert np.max(np.abs(a)) < 1e6


def test_the_papers_system_with_all_candidates(all_effects) -> None:
    system = baxter_foam_y_system(1)
    everything = system.with_effects(all_effects(system))
    assert everything.mechanism.joint_names[:7] == system.driven
    results = []
    for one in (system, everything):
        step = compile_step(one, 0.01, use_compiler=False)
        theta = one.parameters.vector()
        rest = EquilibriumSolver(step).solve(POSTURE, theta)
        assert rest.is_converged
        torque = np.tile(rest.holding_torque, (5, 1)) + np.linspace(0, 1, 5)[:, None]
        rollout = simulate(step, theta, rest.state, 5, torque)
        assert rollout.status.is_converged
        names = one.mechanism.joint_names
        results.append(rollout.state[:, [names.index(name) for name in system.mechanism.joint_names]])
    assert largest(results[1] - results[0], results[0]) < 1e-10

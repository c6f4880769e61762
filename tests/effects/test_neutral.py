"""At neutral parameters every effect, alone and all together, leaves the nominal model as it is."""

from __future__ import annotations

import numpy as np
import pytest

from yid_ocp.effects import _SENSOR_KINDS, candidate_kinds_and_locations, make_effect


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


# those that add joints or coordinates, or have an infinite neutral value
STRUCTURAL = ("grasp_compliance", "grasp_slip", "hysteresis", "joint_presliding", "junction_compliance")
STRUCTURAL += ("length_scale", "mount_compliance", "payload", "standard_linear_solid")


@pytest.mark.parametrize("kind", STRUCTURAL)
def test_alone_it_changes_nothing_and_has_a_slope(kind, benches) -> None:
    bench = benches["driven"]
    places = [place for k, place in candidate_kinds_and_locations(bench.system, _SENSOR_KINDS) if k == kind]
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

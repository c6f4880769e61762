"""All effects at once: nothing at neutral parameters, and sensitivities that are central differences'."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.integrator.compiler import _compiler_path
from yid_ocp.integrator.step import compile_step
from yid_ocp.sensors import sensor_reading_function

STEPS = 4


def somewhere(effect) -> dict[str, float]:
    """Values well inside the expected ranges, away from neutral."""
    values = {}
    for i, (name, (low, high)) in enumerate(effect.prior_ranges.items()):
        share = (0.3, 0.65, 0.8)[i % 3]
        values[name] = low + share * (high - low)
    return values


def at(bench, step, effects, where: str) -> SimpleNamespace:
    names = tuple(name for effect in effects for name in effect.parameters.names)
    values = {}
    for effect in effects if where == "away" else ():
        values |= somewhere(effect)
    start = bench.start(step)
    run = bench.run(step, values, names, start, STEPS)
    assert run.rollout.status.is_converged, run.rollout.status.message
    widths = {name: high - low for effect in effects for name, (low, high) in effect.prior_ranges.items()}
    return SimpleNamespace(bench=bench, step=step, names=names, values=values, start=start, run=run, widths=widths)


@pytest.fixture(scope="module")
def cases(benches, all_effects):
    @cache
    def built(mode: str):
        effects = all_effects(benches[mode].system)
        return benches[mode], benches[mode].step(*effects), effects

    return cache(lambda mode, where: at(*built(mode), where))


@pytest.mark.parametrize("where", ["neutral", "away"])
@pytest.mark.parametrize("mode", ["driven", "prescribed"])
def test_sensitivities_agree_with_differences(mode, where, cases) -> None:
    """Kind by kind, along a direction in which all its parameters move."""
    case, rng = cases(mode, where), np.random.default_rng(4)
    centre = {name: case.step.system.parameters[name].value for name in case.names} | case.values
    for kind in {name.partition("@")[0] for name in case.names}:
        own = [name for name in case.names if name.startswith(f"{kind}@")]
        way = {name: case.widths[name] * rng.choice([-1, 1]) * rng.uniform(0.5, 1) for name in own}
        weights = np.array([way.get(name, 0.0) for name in case.names])
        ends = ({n: centre[n] + sign * 4e-5 * way[n] for n in own} for sign in (1, -1))
        above, below = (case.bench.run(case.step, case.values | e, (), case.start, STEPS).rollout for e in ends)
        for field in ("state", "multipliers", "effort"):
            exact = getattr(case.run.rollout, f"{field}_sensitivity") @ weights
            if exact.size == 0:
                continue
            numeric = (getattr(above, field) - getattr(below, field)) / 8e-5
            floor = 1e-9 * np.max(np.abs(getattr(case.run.rollout, field))) / 4e-5
            error = np.max(np.abs(exact - numeric))
            assert error <= 2e-5 * np.max(np.abs(exact)) + floor, (kind, field, error, np.max(np.abs(exact)))


@pytest.mark.parametrize("which", ["camera", "effort"])
def test_readings_have_exact_slopes(which, prescribed, all_effects, sensors) -> None:
    effects = all_effects(prescribed.system)
    system = prescribed.system.with_effects(effects)
    names = tuple(name for effect in effects for name in effect.parameters.names)
    function = sensor_reading_function(system, getattr(sensors, which), names)
    values = {}
    for effect in effects:
        values |= somewhere(effect)
    theta = system.parameters.vector(values)
    rng = np.random.default_rng(0)
    at = {name: rng.normal(size=function.numel_in(name)) for name in ("q", "z", "load")}
    exact = np.array(ca.densify(function(**at, theta=theta)["by_theta"]))
    for column, name in enumerate(names):
        shift = 1e-6 * np.eye(len(theta))[system.parameters.index(name)]
        above, below = (np.array(function(**at, theta=theta + sign * shift)["y"]) for sign in (1, -1))
        assert np.allclose(exact[:, column], (above - below).ravel() / 2e-6, rtol=1e-6, atol=1e-8), name


@pytest.mark.skipif(_compiler_path() is None, reason="no C compiler")
def test_compiled_and_interpreted_agree_with_every_effect(cases) -> None:
    case = cases("driven", "away")
    bench = case.bench
    step = compile_step(case.step.system, case.step.time_step)
    assert step.is_compiled
    fast, slow = bench.run(step, case.values, case.names, case.start, STEPS).rollout, case.run.rollout
    for field in ("state", "multipliers", "state_sensitivity", "multipliers_sensitivity"):
        one, other = getattr(fast, field), getattr(slow, field)
        assert np.max(np.abs(one - other)) <= 1e-8 * np.max(np.abs(other)), field
    weight = np.random.default_rng(1).normal(size=slow.state.shape)
    exact = np.einsum("kx,kxd->d", weight, slow.state_sensitivity)
    for s, rollout in ((step, fast), (case.step, slow)):
        gradient = s.kernel.adjoint_gradient(case.run.theta, rollout, None, case.names, (weight, None, None))
        assert gradient.by_theta == pytest.approx(exact, rel=1e-6, abs=1e-8 * np.max(np.abs(exact)))


def largest(difference, reference) -> float:
    return float(np.max(np.abs(difference)) / np.max(np.abs(reference)))


@pytest.mark.parametrize("mode", ["driven", "prescribed"])
def test_at_neutral_parameters_they_change_nothing(mode, benches, all_effects, sensors) -> None:
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

"""Forward sensitivities by every effect's parameters, all effects at once, beside central differences."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from yid_ocp.effects import EFFECTS
from yid_ocp.integrator.compiler import _compiler_path
from yid_ocp.integrator.rollout import adjoint_gradient
from yid_ocp.integrator.step import compile_step
from yid_ocp.sensors import sensor_function

STEPS = 4


def somewhere(effect) -> dict[str, float]:
    """Values well inside the expected ranges, away from neutral."""
    values = {}
    for i, (name, (low, high)) in enumerate(effect.prior_ranges.items()):
        share = (0.3, 0.65, 0.8)[i % 3]
        values[name] = low + share * (high - low)
    return values


def at(bench, effects, where: str) -> SimpleNamespace:
    step = bench.step(*effects)
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
    made: dict[tuple[str, str], SimpleNamespace] = {}

    def case(mode: str, where: str) -> SimpleNamespace:
        if (mode, where) not in made:
            bench = benches[mode]
            made[mode, where] = at(bench, all_effects(bench.system), where)
        return made[mode, where]

    return case


@pytest.mark.parametrize("where", ["neutral", "away"])
@pytest.mark.parametrize("mode", ["driven", "prescribed"])
@pytest.mark.parametrize("kind", [kind for kind in EFFECTS if not kind.startswith("servo_")])
def test_sensitivities_agree_with_differences(kind, mode, where, cases) -> None:
    case = cases(mode, where)
    for column, name in enumerate(case.names):
        if name.partition("@")[0] != kind:
            continue
        width = 4e-5 * case.widths[name]
        centre = case.step.system.parameters[name].value if where == "neutral" else case.values[name]
        above, below = (
            case.bench.run(case.step, case.values | {name: centre + sign * width}, (), case.start, STEPS).rollout
            for sign in (1, -1)
        )
        rollout = case.run.rollout
        for field, by in (
            ("state", "state_sensitivity"),
            ("multipliers", "multipliers_sensitivity"),
            ("effort", "effort_sensitivity"),
        ):
            numeric = (getattr(above, field) - getattr(below, field)) / (2 * width)
            exact = getattr(rollout, by)[..., column]
            if exact.size == 0:
                continue
            floor = 1e-9 * np.max(np.abs(getattr(rollout, field))) / width
            error = np.max(np.abs(exact - numeric))
            assert error <= 2e-5 * np.max(np.abs(exact)) + floor, (name, field, error, np.max(np.abs(exact)))


@pytest.mark.parametrize("which", ["camera", "effort"])
def test_readings_have_exact_slopes(which, prescribed, all_effects, sensors) -> None:
    effects = all_effects(prescribed.system)
    system = prescribed.system.with_effects(effects)
    names = tuple(name for effect in effects for name in effect.parameters.names)
    function = sensor_function(system, getattr(sensors, which), names)
    values = {}
    for effect in effects:
        values |= somewhere(effect)
    theta = system.parameters.vector(values)
    rng = np.random.default_rng(0)
    q, z, effort = (rng.normal(size=function.numel_in(i)) for i in range(3))
    exact = np.array(ca.densify(function(q, z, effort, theta)[4]))
    for column, name in enumerate(names):
        shift = np.zeros(len(theta))
        shift[system.parameters.index(name)] = 1e-6
        above, below = (np.array(function(q, z, effort, theta + sign * shift)[0]) for sign in (1, -1))
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
        gradient = adjoint_gradient(s, case.run.theta, rollout, case.names, weight)
        assert gradient.by_theta == pytest.approx(exact, rel=1e-6, abs=1e-8 * np.max(np.abs(exact)))

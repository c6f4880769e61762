"""At neutral parameters every effect, alone and all together, leaves the nominal model as it is."""

from __future__ import annotations

import numpy as np
import pytest


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

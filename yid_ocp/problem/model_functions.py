"""Compiled functions of a model (sensors, equilibrium, input corrections) that many estimation problems share.

They are differentiated by every parameter that may become free; each problem takes the columns that it needs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.lqr import arms_only_step
from yid_ocp.integrator.mapped_function import MappedFunction
from yid_ocp.integrator.momentum_shift import MomentumShift
from yid_ocp.integrator.statics import Equilibrium, EquilibriumSolver
from yid_ocp.integrator.step import Step
from yid_ocp.parallel import LockedCache
from yid_ocp.problem.initial_state_fit import InitialStateFitter
from yid_ocp.problem.input_corrections import InputCorrections
from yid_ocp.sensors import Sensor, sensor_function

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _SelectedDerivatives:
    """A compiled sensor function that returns derivatives by a subset of its parameters.

    Attributes
    ----------
    all_derivatives : Mapped
        Its last output has one column for every parameter.
    """

    all_derivatives: MappedFunction
    columns: tuple[int, ...]

    def __call__(self, *inputs: Array) -> list[Array]:
        """Evaluate the sensor and keep the chosen columns of the parameter derivative."""
        *rest, by_theta = self.all_derivatives(*inputs)
        return [*rest, by_theta[:, :, list(self.columns)]]


class ModelFunctions:
    """Compiled functions of one step's system: sensors, equilibrium, initial state fit and input corrections.

    Parameters
    ----------
    parameter_names : tuple of str
        Parameters by which derivatives may be asked for.
    start_parameters : tuple of str
        Parameters fitted along with a start from points.
    """

    def __init__(self, step: Step, names: tuple[str, ...], start_parameters: tuple[str, ...] = ()) -> None:
        self.step = step
        self.parameter_names = names
        self.input_corrections = InputCorrections(step.system, names, step.is_compiled)
        self._start_parameters = start_parameters
        self._statics: LockedCache[None, EquilibriumSolver] = LockedCache(lambda _: EquilibriumSolver(step))
        self._start_fit: LockedCache[None, InitialStateFitter] = LockedCache(
            lambda _: InitialStateFitter(step, start_parameters)
        )
        self._arms: LockedCache[None, Step] = LockedCache(lambda _: arms_only_step(step))
        self._momentum: LockedCache[None, MomentumShift] = LockedCache(lambda _: MomentumShift(step))
        self._sensors: LockedCache[tuple[Sensor, bool], MappedFunction] = LockedCache(self._compiled)

    @property
    def equilibrium_solver(self) -> EquilibriumSolver:
        """Solver of the system's equilibrium equations."""
        return self._statics(None)

    @property
    def initial_state_fitter(self) -> InitialStateFitter:
        """Fitter of an initial state to the first measured points."""
        return self._start_fit(None)

    @property
    def arms_only_step(self) -> Step:
        """Compiled step of the arms alone, for which the tracking filter's gains are computed."""
        return self._arms(None)

    @property
    def momentum_shift(self) -> MomentumShift:
        """Momenta that effects add to those that the tracking filter follows."""
        return self._momentum(None)

    def compiled_sensor(self, sensor: Sensor, wanted: tuple[str, ...]) -> MappedFunction | _SelectedDerivatives:
        """Compiled function of a sensor's readings, with derivatives by the parameters `wanted`."""
        if not wanted or wanted == self.parameter_names:
            return self._sensors((sensor, bool(wanted)))
        return _SelectedDerivatives(self._sensors((sensor, True)), self.parameter_columns(wanted))

    def find_equilibrium(
        self, posture: Array, theta: Array, torque: Array | None, guess: Array | None, wanted: tuple[str, ...]
    ) -> Equilibrium:
        """Equilibrium at known joint coordinates, differentiated by the parameters `wanted`."""
        return self.equilibrium_solver.solve(posture, theta, torque, guess, wanted)

    def parameter_columns(self, wanted: tuple[str, ...]) -> tuple[int, ...]:
        """Column indices of the parameters `wanted` in `parameter_names`."""
        return tuple(self.parameter_names.index(name) for name in wanted)

    def _compiled(self, key: tuple[Sensor, bool]) -> MappedFunction:
        sensor, differentiated = key
        function = sensor_function(self.step.system, sensor, self.parameter_names if differentiated else ())
        return MappedFunction(function, shared_inputs=(3,), use_compiler=self.step.is_compiled)

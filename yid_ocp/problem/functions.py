"""Compiled functions of a model (sensors, equilibrium, input corrections) that many estimation problems share.

They are differentiated by every parameter that may become free; each problem takes the columns that it needs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yid_ocp.integrator.lqr import arms_alone
from yid_ocp.integrator.mapped import Mapped
from yid_ocp.integrator.momentum import MomentumShift
from yid_ocp.integrator.statics import Rest, Statics
from yid_ocp.integrator.step import Step
from yid_ocp.parallel import Once
from yid_ocp.problem.corrections import InputCorrections
from yid_ocp.problem.start import StartFit
from yid_ocp.sensors import Sensor, sensor_function

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MaskedMap:
    """A compiled sensor function that returns derivatives by a subset of its parameters.

    Attributes
    ----------
    whole : Mapped
        Its last output has one column for every parameter.
    columns : tuple of int
    """

    whole: Mapped
    columns: tuple[int, ...]

    def __call__(self, *inputs: Array) -> list[Array]:
        """Evaluate the sensor and keep the chosen columns of the parameter derivative."""
        *rest, by_theta = self.whole(*inputs)
        return [*rest, by_theta[:, :, list(self.columns)]]


class ModelFunctions:
    """Compiled functions of one step's system: sensors, equilibrium, initial state fit and input corrections.

    Parameters
    ----------
    step : Step
    names : tuple of str
        Parameters by which derivatives may be asked for.
    start_parameters : tuple of str
        Parameters fitted along with a start from points.
    """

    def __init__(self, step: Step, names: tuple[str, ...], start_parameters: tuple[str, ...] = ()) -> None:
        self.step = step
        self.names = names
        self.corrections = InputCorrections(step.system, names, step.compiled)
        self._start_parameters = start_parameters
        self._statics: Once[None, Statics] = Once(lambda _: Statics(step))
        self._start_fit: Once[None, StartFit] = Once(lambda _: StartFit(step, start_parameters))
        self._arms: Once[None, Step] = Once(lambda _: arms_alone(step))
        self._momentum: Once[None, MomentumShift] = Once(lambda _: MomentumShift(step))
        self._sensors: Once[tuple[Sensor, bool], Mapped] = Once(self._compiled)

    @property
    def statics(self) -> Statics:
        """Solver of the system's equilibrium equations."""
        return self._statics(None)

    @property
    def start_fit(self) -> StartFit:
        """Fitter of an initial state to the first measured points."""
        return self._start_fit(None)

    @property
    def arms(self) -> Step:
        """Compiled step of the arms alone, for which the tracking filter's gains are computed."""
        return self._arms(None)

    @property
    def momentum_shift(self) -> MomentumShift:
        """Momenta that effects add to those that the tracking filter follows."""
        return self._momentum(None)

    def sensor(self, sensor: Sensor, wanted: tuple[str, ...]) -> Mapped | MaskedMap:
        """Compiled function of a sensor's readings, with derivatives by the parameters `wanted`."""
        if not wanted or wanted == self.names:
            return self._sensors((sensor, bool(wanted)))
        return MaskedMap(self._sensors((sensor, True)), self.columns(wanted))

    def rest(
        self, posture: Array, theta: Array, torque: Array | None, guess: Array | None, wanted: tuple[str, ...]
    ) -> Rest:
        """Equilibrium at known joint coordinates, differentiated by the parameters `wanted`."""
        return self.statics.solve(posture, theta, torque, guess, wanted)

    def columns(self, wanted: tuple[str, ...]) -> tuple[int, ...]:
        """Column indices of the parameters `wanted` in `names`."""
        return tuple(self.names.index(name) for name in wanted)

    def _compiled(self, key: tuple[Sensor, bool]) -> Mapped:
        sensor, differentiated = key
        function = sensor_function(self.step.system, sensor, self.names if differentiated else ())
        return Mapped(function, shared=(3,), use_compiler=self.step.compiled)

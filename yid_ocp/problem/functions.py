"""What a problem compiles once: sensors, statics, corrections, differentiated by all that may ever be free.

A problem that frees part of it takes the columns that it needs, so that any number of problems share one compilation.
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
    """A compiled sensor with the derivatives by some of its parameters only.

    Attributes
    ----------
    whole : Mapped
        Its last output has one column for every parameter.
    columns : tuple of int
    """

    whole: Mapped
    columns: tuple[int, ...]

    def __call__(self, *inputs: Array) -> list[Array]:
        """See `Mapped`."""
        *rest, by_theta = self.whole(*inputs)
        return [*rest, by_theta[:, :, list(self.columns)]]


class ModelFunctions:
    """Compiled functions of one step's system; nothing in it depends on what was evaluated before.

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
        """The equilibrium equations of the system."""
        return self._statics(None)

    @property
    def start_fit(self) -> StartFit:
        """The fit of a start to points."""
        return self._start_fit(None)

    @property
    def arms(self) -> Step:
        """The step of the driven joints alone, about which the tracking filter is worked out."""
        return self._arms(None)

    @property
    def momentum_shift(self) -> MomentumShift:
        """What effects add to the momenta that the tracking filter follows."""
        return self._momentum(None)

    def sensor(self, sensor: Sensor, wanted: tuple[str, ...]) -> Mapped | MaskedMap:
        """Compiled readings of a sensor, with derivatives by some of `names`."""
        if not wanted or wanted == self.names:
            return self._sensors((sensor, bool(wanted)))
        return MaskedMap(self._sensors((sensor, True)), self.columns(wanted))

    def rest(
        self, posture: Array, theta: Array, torque: Array | None, guess: Array | None, wanted: tuple[str, ...]
    ) -> Rest:
        """The equilibrium at a posture, differentiated by named parameters; see `Statics.solve`."""
        return self.statics.solve(posture, theta, torque, guess, wanted)

    def columns(self, wanted: tuple[str, ...]) -> tuple[int, ...]:
        """Places of some of `names`."""
        return tuple(self.names.index(name) for name in wanted)

    def _compiled(self, key: tuple[Sensor, bool]) -> Mapped:
        sensor, differentiated = key
        function = sensor_function(self.step.system, sensor, self.names if differentiated else ())
        return Mapped(function, shared=(3,), use_compiler=self.step.compiled)

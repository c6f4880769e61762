"""Everything about an estimation problem that is neither the model nor the data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from numpy.typing import ArrayLike

from yid_ocp.model.cable import ClampPath
from yid_ocp.problem.measurements import Weighting

StartKind = Literal["equilibrium", "estimated", "fitted_to_points"]


@dataclass(frozen=True)
class SensorOptions:
    """How one group of a recording is used.

    Attributes
    ----------
    use : bool
        Whether the estimation sees it at all.
    std : float or mapping of name to float, optional
        Noise deviation in the group's unit, instead of the recorded one.
    frames : mapping of point to frame
        Frame that a point marks where the two have different names.
    points : tuple of str, optional
        Points to use; all that the model has when absent.
    position_std : float or mapping of joint to float, optional
        Deviation of the encoders that give a prescribed motion, instead of the recorded one [rad]; the accelerations
        worked out from it add to the deviation of predicted efforts.
    """

    use: bool = True
    std: float | Mapping[str, float] | None = None
    frames: Mapping[str, str] = field(default_factory=dict)
    points: tuple[str, ...] | None = None
    position_std: float | Mapping[str, float] | None = None


@dataclass(frozen=True)
class ProblemOptions:
    """Everything about an estimation problem that is neither the model nor the data.

    Attributes
    ----------
    initial_state : "equilibrium", "estimated" or "fitted_to_points"
        Rest at the first posture (depends on theta); that plus a free deviation with a prior; or fixed at the
        configuration that fits the first measured points.
    feedback : "none", "proportional" or "lqr"
        Tracking filter of driven arms.
    gains : sequence of float
        Proportional gains of one arm or of all driven joints [N m/rad].
    weighting : "whitened" or "paper"
    huber_threshold : float
        Huber scale in standard deviations; infinite for squares.
    path_cutoff : float
        Low-pass cutoff of prescribed paths and of the efforts compared with them [Hz].
    sensors : mapping of group to SensorOptions
    clamps : tuple of ClampPath
    local : tuple of str
        Free parameters with a value of their own in every recording.
    priors : mapping of parameter to deviation
        Gaussian priors about the initial value, in the parameter's unit.
    weak_prior_factor : float
        Every other free parameter that is positive by nature gets a prior that calls this factor up or down one
        standard deviation (log-normal about its start), so that one that the data do not inform stays near its start;
        zero for none. Not used with the paper's weighting.
    configuration_std, velocity_std : float
        Prior of an estimated initial state [rad], [rad/s].
    duration : float, optional
        Use only the first seconds of every recording [s].
    start_window : float
        How long the measured points that fix a fitted start may reach [s].
    start_std : float, optional
        Noise deviation of the points in the fit of a fitted start, where the sensors' one stands for the model's error
        as well [m].
    start_parameters : tuple of str
        Parameters that are fitted along with a fitted start in every recording, held-out ones included, from these
        first points alone; none of them may be free.
    recording_values : mapping of recording to mapping of parameter to value
        Known values of parameters that differ from recording to recording, such as where markers sit.
    known_start : mapping of recording to array_like, shape (nx,)
        State (q, p, z) in which a recording starts, in place of rest or of the fit; an `estimated` start deviates from
        it.
    """

    initial_state: StartKind = "equilibrium"
    feedback: Literal["none", "proportional", "lqr"] = "lqr"
    gains: tuple[float, ...] = (80.0, 80.0, 60.0, 60.0, 15.0, 15.0, 8.0)
    weighting: Weighting = "whitened"
    huber_threshold: float = float("inf")
    path_cutoff: float = 10.0
    sensors: Mapping[str, SensorOptions] = field(default_factory=dict)
    clamps: tuple[ClampPath, ...] = ()
    local: tuple[str, ...] = ()
    priors: Mapping[str, float] = field(default_factory=dict)
    weak_prior_factor: float = 10.0
    configuration_std: float = 0.05
    velocity_std: float = 0.2
    duration: float | None = None
    start_window: float = 0.02
    start_std: float | None = None
    start_parameters: tuple[str, ...] = ()
    recording_values: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    known_start: Mapping[str, ArrayLike] = field(default_factory=dict)

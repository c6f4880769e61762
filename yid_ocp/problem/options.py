"""Settings of an estimation problem: initial state, noise, priors, tracking filter, sensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Len
from numpy.typing import ArrayLike, NDArray

from yid_ocp.data.doubt import Doubt
from yid_ocp.model.cable import ClampPath
from yid_ocp.options import About
from yid_ocp.problem.measurements import Weighting
from yid_ocp.sensors.base import EffortKind

StartKind = Literal["equilibrium", "estimated", "fitted_to_points"]
Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]


@dataclass(frozen=True)
class SensorOptions:
    """How one sensor group of a recording is used: points, points_NAME, joints.position or joints.effort."""

    use: Annotated[
        bool | None,
        About(
            "whether the estimation sees it; when absent yes, but for joints.position: the encoders of driven joints "
            "are measurements where no points of the arm are, never beside them"
        ),
    ] = None
    std: Annotated[
        Positive | Mapping[str, Positive] | None,
        About("noise standard deviation instead of the recorded one, by name where they differ", "m, rad or N m"),
    ] = None
    frames: Annotated[
        Mapping[str, str], About("frame of the model that a point marks, or T1:40%, where the two have different names")
    ] = field(default_factory=dict)
    points: Annotated[tuple[str, ...] | None, About("points to use; all that the model has when absent")] = None
    bias_std: Annotated[
        NotNegative | Mapping[str, NotNegative] | None,
        About(
            "standard deviation of a constant error in each joint's torque, another in every recording, instead of the "
            "recorded one (joints.effort only)",
            "N m",
        ),
    ] = None
    kind: Annotated[
        EffortKind | None,
        About(
            "what recorded efforts are of the torque that acts, instead of what the recording says (joints.effort only)"
        ),
    ] = None


@dataclass(frozen=True)
class JointPrior:
    """Multivariate Gaussian prior of shared parameters about their initial values, such as an earlier estimate.

    Attributes
    ----------
    names : tuple of str, length n
    covariance : ndarray, shape (n, n)
        Positive definite, in the parameters' units.
    """

    names: tuple[str, ...] = ()
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)), compare=False)

    def scaled(self, factors: Mapping[str, float]) -> JointPrior:
        """Prior of the parameters multiplied by given factors; parameters without a factor are unchanged."""
        by = np.array([factors.get(name, 1.0) for name in self.names])
        return JointPrior(self.names, self.covariance * np.outer(by, by))

    def of(self, names: Sequence[str]) -> JointPrior:
        """Marginal prior of the named parameters, in the given order."""
        at = [self.names.index(name) for name in names if name in self.names]
        return JointPrior(tuple(self.names[i] for i in at), self.covariance[np.ix_(at, at)])


@dataclass(frozen=True)
class ProblemOptions:
    """Settings of an estimation problem: everything but model and data.

    Attributes
    ----------
    sensors : mapping of group to SensorOptions
    clamps : tuple of ClampPath
    local : tuple of str
        Free parameters with a value of their own in every recording.
    priors : mapping of parameter to standard deviation
        Gaussian priors about the initial value, in the parameter's unit.
    joint_prior : JointPrior
        Correlated prior of several parameters, in place of entries of `priors`.
    recording_values : mapping of recording to mapping of parameter to value
        Known values of parameters that differ from recording to recording, such as where markers sit.
    known_start : mapping of recording to array_like, shape (nx,)
        State (q, p, z) in which a recording starts, in place of equilibrium or of the fit.
    doubts : tuple of Doubt
        Data quality issues found in the recordings.
    """

    initial_state: Annotated[
        StartKind,
        About(
            "at rest at the first posture; that plus a free offset with a prior; fitted to the first measured points"
        ),
    ] = "equilibrium"
    feedback: Annotated[
        Literal["none", "proportional", "lqr"], About("tracking filter of driven arms; arms with servos have none")
    ] = "lqr"
    gains: Annotated[
        tuple[Annotated[float, Ge(0)], ...],
        Len(1),
        About("of the proportional filter, of one arm or of all driven joints", "N m/rad"),
    ] = (80.0, 80.0, 60.0, 60.0, 15.0, 15.0, 8.0)
    weighting: Annotated[Weighting, About("cost in standard deviations, or the paper's")] = "whitened"
    huber_threshold: Annotated[
        float, Gt(0), About("residual, in standard deviations, from which the cost grows linearly; .inf for squares")
    ] = float("inf")
    path_cutoff: Annotated[
        float, Gt(0), About("low-pass cutoff of prescribed paths and of the efforts compared with them", "Hz")
    ] = 10.0
    sensors: Mapping[str, SensorOptions] = field(default_factory=dict)
    clamps: tuple[ClampPath, ...] = ()
    local: tuple[str, ...] = ()
    priors: Mapping[str, float] = field(default_factory=dict)
    joint_prior: JointPrior = field(default_factory=JointPrior)
    weak_prior_factor: Annotated[
        float,
        Ge(0),
        About(
            "factor up or down that is one standard deviation of the weak prior, which keeps positive parameters "
            "without a prior near their start where nothing informs them; 0 for none; the paper's weighting has none"
        ),
    ] = 10.0
    configuration_std: Annotated[float, Gt(0), About("standard deviation of an estimated start", "rad")] = 0.05
    velocity_std: Annotated[float, Gt(0), About("standard deviation of an estimated start", "rad/s")] = 0.2
    duration: Annotated[float | None, Gt(0), About("use only the first seconds of every recording", "s")] = None
    start_window: Annotated[
        float, Gt(0), About("how long the measured points that fix a fitted start may reach", "s")
    ] = 0.02
    start_std: Annotated[
        float | None,
        Gt(0),
        About("noise standard deviation of these points, where the sensors' one stands for the model's error too", "m"),
    ] = None
    start_parameters: Annotated[
        tuple[str, ...],
        About(
            "fitted along with a fitted start in every recording, held-out ones too, from these points alone; not free"
        ),
    ] = ()
    recording_values: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    known_start: Mapping[str, ArrayLike] = field(default_factory=dict)
    doubts: tuple[Doubt, ...] = ()

    @property
    def believed(self) -> bool:
        """Whether the recordings have no data quality issue graver than a warning."""
        return all(doubt.weight == "warning" for doubt in self.doubts)

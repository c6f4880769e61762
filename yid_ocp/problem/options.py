"""The settings of an estimation problem: initial state, noise, priors and tracking filter."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Len
from numpy.typing import ArrayLike

from yid_ocp.arrays import Array
from yid_ocp.data.channel_checks import Issue
from yid_ocp.effects.base import EffectBase
from yid_ocp.integrator.step import Step
from yid_ocp.model.objects.base import CableVertices, ClampPosePointNames
from yid_ocp.options import OptionInfo
from yid_ocp.problem.measurements import ResidualWeightingName
from yid_ocp.sensors import SensorOptions as SensorOptions

RefinementKind = Literal["links", "time_step"]


@dataclass(frozen=True)
class MultivariateGaussianPrior:
    """A Gaussian prior of several shared parameters about their initial values, such as an earlier estimate.

    The covariance (n, n) is positive definite, in the parameters' units.
    """

    parameter_names: tuple[str, ...] = ()
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)), compare=False)

    def with_parameters_scaled_by(self, factors: Mapping[str, float]) -> MultivariateGaussianPrior:
        """Return the prior of the parameters multiplied by `factors`. Parameters without a factor are unchanged."""
        by = np.array([factors.get(name, 1.0) for name in self.parameter_names])
        return MultivariateGaussianPrior(self.parameter_names, self.covariance * np.outer(by, by))

    def restricted_to(self, names: Sequence[str]) -> MultivariateGaussianPrior:
        """Return the prior of the named parameters alone, in the given order. Names without this prior are omitted."""
        at = [self.parameter_names.index(name) for name in names if name in self.parameter_names]
        return MultivariateGaussianPrior(tuple(self.parameter_names[i] for i in at), self.covariance[np.ix_(at, at)])


@dataclass(frozen=True)
class ExcessResidualCriteria:
    """The criteria by which a residual exceeds its noise: chi2 is significant, and chi2/n - 1 is at least a minimum.

    The stated standard deviations times `noise_fraction_of_stated_std` are the noise; the rest of them is model error.
    """

    significance_level: float = 0.01
    min_excess_chi2_per_dof: float = 0.1
    noise_fraction_of_stated_std: float = 1.0


@dataclass(frozen=True)
class DividedLinksModel:
    """A model of the object with each link divided in two. `parameter_factors` on parameters keep the stiffness."""

    build_step: Callable[[bool, Sequence[EffectBase]], Step]  # of whether it is compiled, and of further effects
    parameter_factors: Mapping[str, float]
    settings: tuple[str, ...] = ()  # with keys and values, which divide the links


@dataclass(frozen=True)
class ProblemOptions:
    """The settings of an estimation problem besides model and data, such as initial states, weighting and priors.

    Attributes
    ----------
    local_parameters : tuple of str
        Free parameters with one value per recording.
    prior_stds : mapping of parameter to standard deviation
        Gaussian priors about the initial value, in the parameter's unit.
    multivariate_prior : MultivariateGaussianPrior
        Correlated prior of several parameters, in place of entries of `prior_stds`.
    stated_std_factor : float
        Ratio of the standard deviations of noise and priors here to the stated ones; below 1 to exclude model error.
    parameters_by_recording : mapping of recording to mapping of parameter to value
        Known values of parameters that differ between recordings, such as marker positions.
    known_initial_states : mapping of recording to array_like, shape (nx,)
        Known initial state (q, p, z) of a recording, in place of an equilibrium or a fit.
    has_uncertain_point_clocks : bool
        Whether clocks of point groups have an unknown offset (half a sample period) if damping parameters are free.
    data_issues : tuple of Issue
        Data quality issues found in the recordings.
    excess_residual_criteria : ExcessResidualCriteria
        Criteria for a residual that exceeds noise.
    checked_discretisations : tuple of str
        Discretisation errors that the standard deviations include: `links`, `time_step`.
    divided_links_model : DividedLinksModel, optional
        Model with divided links, required to check `links`.
    cable_vertices : CableVertices, optional
        Topology of a cable held by clamps, for its baselines.
    sampling_time_step : float
        Time step whose nodes give the samples of filtered signals, if it exceeds the time step [s].
    """

    initial_state: Annotated[
        Literal["equilibrium", "estimated", "fitted_to_points"],
        OptionInfo(
            "equilibrium at the first posture; estimated: the equilibrium plus a free offset with a prior; "
            "fitted_to_points: fitted to the first measured points"
        ),
    ] = "equilibrium"
    arm_tracking_feedback: Annotated[
        Literal["none", "proportional", "lqr"], OptionInfo("tracking filter of driven arms; arms with servos have none")
    ] = "lqr"
    arm_proportional_gains: Annotated[
        tuple[Annotated[float, Ge(0)], ...],
        Len(1),
        OptionInfo("gains of the filter `proportional`, for one arm or for all driven joints", "N m/rad"),
    ] = (80.0, 80.0, 60.0, 60.0, 15.0, 15.0, 8.0)
    weighting: Annotated[ResidualWeightingName, OptionInfo("residual weights; paper: Caldwell et al.")] = "whitened"
    huber_threshold: Annotated[
        float,
        Gt(0),
        OptionInfo("residual in standard deviations above which the cost is linear; .inf for least squares"),
    ] = float("inf")
    path_cutoff: Annotated[
        float,
        Ge(0),
        OptionInfo(
            "low-pass cutoff of prescribed paths and of compared efforts; 0: the lowest of 10, 20, 40 Hz, ... above "
            "which recorded angles are noise",
            "Hz",
        ),
    ] = 0.0
    sensors: Mapping[str, SensorOptions] = field(default_factory=dict)
    clamp_pose_point_names: tuple[ClampPosePointNames, ...] = ()
    local_parameters: tuple[str, ...] = ()
    prior_stds: Mapping[str, float] = field(default_factory=dict)
    multivariate_prior: MultivariateGaussianPrior = field(default_factory=MultivariateGaussianPrior)
    stated_std_factor: float = 1.0
    weak_prior_geometric_std: Annotated[
        float,
        Ge(0),
        OptionInfo(
            "one standard deviation of the weak prior, as a factor on the initial value (10: a tenth to ten times); it "
            "holds positive parameters that neither recordings nor a prior determine; 0 or weighting paper: none"
        ),
    ] = 10.0
    initial_configuration_prior_std: Annotated[
        float, Gt(0), OptionInfo("standard deviation of an estimated initial configuration", "rad")
    ] = 0.05
    initial_velocity_prior_std: Annotated[float, Gt(0), OptionInfo("velocity std of an estimated start", "rad/s")] = 0.2
    duration: Annotated[
        float | None, Gt(0), OptionInfo("number of seconds from the start of every recording that are used", "s")
    ] = None
    initial_state_fit_window: Annotated[
        float, Gt(0), OptionInfo("duration of the measured points used for a fitted initial state", "s")
    ] = 0.02
    start_point_noise_std: Annotated[
        float | None,
        Gt(0),
        OptionInfo("noise standard deviation of these points, if the sensors' value includes model error", "m"),
    ] = None
    initial_state_fit_parameters: Annotated[
        tuple[str, ...],
        OptionInfo("parameters fitted with a fitted initial state in every recording, held-out ones too; not free"),
    ] = ()
    parameters_by_recording: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    known_initial_states: Mapping[str, ArrayLike] = field(default_factory=dict)
    has_uncertain_point_clocks: bool = False
    data_issues: tuple[Issue, ...] = ()
    excess_residual_criteria: ExcessResidualCriteria = ExcessResidualCriteria()
    checked_discretisations: tuple[RefinementKind, ...] = ("links", "time_step")
    divided_links_model: DividedLinksModel | None = field(default=None, compare=False, repr=False)
    cable_vertices: CableVertices | None = field(default=None, compare=False, repr=False)
    sampling_time_step: float = 0.0

    @property
    def has_no_data_issue_above_warning(self) -> bool:
        """Whether no data quality issue is more severe than a warning."""
        return all(issue.severity == "warning" for issue in self.data_issues)

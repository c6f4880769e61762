"""Errors of the recorded torques and angles that drive a rollout: noise levels and what is known of their values."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.recording import Recording
from yid_ocp.model.system import System
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.options import SensorOptions
from yid_ocp.problem.time_grid import TimeGrid
from yid_ocp.sensors.joints import (
    EFFORT_GROUP,
    POSITION_GROUP,
    PositionSensor,
    is_noise_std_stated,
    joint_angle_noise_std,
    joint_torque_bias_std,
    joint_torque_noise_std,
)

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

_MIN_TORQUE_ERROR_FRACTION = 1e-3
"""Least error of a torque beside encoders, in parts of how far it varies: nothing that is computed follows them for
seconds without correction."""


@dataclass(frozen=True)
class InputErrors:
    """Noise levels and current estimates of the torque and angle errors that drive one recording's rollout.

    Attributes
    ----------
    torque_std, torque_bias_std, angle_std : ndarray, shape (nu,)
        Of w in a step and of b [N m], of v [rad].
    sample_of_step : ndarray of int, shape (N,)
        Recorded sample that each step's torque comes from: w is the same in all its steps.
    encoder_noise_steps : float
        Number of steps that share one encoder sample's noise through interpolation.
    has_encoder_measurements : bool
        Whether the encoders are measurements.
    torque_bias : ndarray, shape (nu,)
        Value of b that is subtracted from the recorded torque [N m].
    torque_noise : ndarray, shape (N, nu)
        Value of w that is subtracted in every step [N m].
    recorded_torque_noise : ndarray, shape (N, nu)
        Noise of the recorded torque that w implies, subtracted before effects on torques apply [N m].
    transmitted_torque_noise : ndarray, shape (N, nu)
        Part of w that subtracting `recorded_torque_noise` already removes from the acting torque [N m].
    smoothed_reference : ndarray, shape (N, nb), or None
        Smoothed reference of the tracking filter in place of the measured motion.
    """

    torque_std: Array
    torque_bias_std: Array
    angle_std: Array
    sample_of_step: NDArray[np.int64]
    encoder_noise_steps: float
    has_encoder_measurements: bool
    torque_bias: Array
    torque_noise: Array
    recorded_torque_noise: Array
    transmitted_torque_noise: Array
    smoothed_reference: Array | None = None

    @property
    def total_torque_error(self) -> Array:
        """Total error subtracted from the torque of every step, b + w, shape (N, nu) [N m]."""
        return self.torque_bias + self.torque_noise

    @property
    def remaining_torque_error(self) -> Array:
        """Error still to be subtracted after effects on torques, shape (N, nu) [N m]."""
        return self.total_torque_error - self.transmitted_torque_noise

    @property
    def with_bias_only(self) -> InputErrors:
        """The same errors with the constant offset alone; torques and angles otherwise as recorded."""
        none = np.zeros_like(self.torque_noise)
        return replace(
            self, torque_noise=none, recorded_torque_noise=none, transmitted_torque_noise=none, smoothed_reference=None
        )

    def first_steps(self, steps: int) -> InputErrors:
        """The errors of the first `steps` steps."""
        first = {
            name: getattr(self, name)[:steps]
            for name in ("sample_of_step", "torque_noise", "recorded_torque_noise", "transmitted_torque_noise")
        }
        return replace(
            self,
            **first,
            smoothed_reference=None if self.smoothed_reference is None else self.smoothed_reference[:steps],
        )


def recorded_input_errors(
    recording: Recording,
    system: System,
    grid: TimeGrid,
    sensors: Mapping[str, SensorOptions],
    samples: Sequence[Measurements],
) -> InputErrors | None:
    """Error levels of the torques and angles that drive a recording's rollout; None where there are none.

    Parameters
    ----------
    samples : sequence of Measurements
        Of the recording.
    """
    joints, driven = recording.joints, system.driven
    if joints is None or joints.effort is None or not driven or system.servos:
        return None
    effort, position = (sensors.get(group, SensorOptions()) for group in (EFFORT_GROUP, POSITION_GROUP))
    std = joint_torque_noise_std(joints, driven, effort, recording.name)
    bias = joint_torque_bias_std(joints, driven, effort)
    encoders = any(isinstance(entry.sensor, PositionSensor) for entry in samples)
    if not encoders and not np.any(std > 0) and not np.any(bias > 0):
        return None
    angle = joint_angle_noise_std(joints, driven, position, recording.name)
    for group, choice, level, unit in ((EFFORT_GROUP, effort, std, "N m"), (POSITION_GROUP, position, angle, "rad")):
        if not is_noise_std_stated(joints, group, choice):
            words = "%s: the noise of %s is neither recorded nor configured; %.2g to %.2g %s estimated from its fastest"
            log.warning(words + " changes", recording.name, group, level.min(), level.max(), unit)
    if encoders:
        columns = [joints.names.index(name) for name in driven]
        std = np.maximum(std, _MIN_TORQUE_ERROR_FRACTION * np.maximum(np.std(joints.effort[:, columns], axis=0), 1e-3))
    period = float(np.median(np.diff(joints.t)))
    middle = grid.node_times[:-1] + grid.time_step / 2
    sample = np.clip(np.searchsorted(joints.t, middle, "right") - 1, 0, len(joints.t) - 1)
    return InputErrors(
        # a step that spans several samples averages them
        std * min(1.0, np.sqrt(period / grid.time_step)),
        bias,
        angle,
        sample.astype(np.int64),
        max(1.0, period / grid.time_step),
        encoders,
        np.zeros(len(driven)),
        *(np.zeros((grid.steps, len(driven))) for _ in range(3)),
    )

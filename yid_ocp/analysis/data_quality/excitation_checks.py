"""Checks whether recorded motion is strong enough, relative to sensor noise, to be informative."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.data_quality.effort_checks import VISCOUS_FRICTION_FRACTION
from yid_ocp.analysis.data_quality.recorded_joints import (
    MOTION_BANDWIDTH_HZ,
    RecordedJointsModel,
    smoothed_joint_motion,
)
from yid_ocp.data.channel_checks import white_noise_std
from yid_ocp.data.issues import QUALITY_LIMITS, Issue, median_sample_period
from yid_ocp.data.recording import JointGroup, Recording
from yid_ocp.sensors.base import SensorUsage
from yid_ocp.sensors.joints import EFFORT_GROUP, POSITION_GROUP, values_by_joint

Array = NDArray[np.float64]

_MIN_SIGNAL_STDS = 5.0
"""Standard deviations from which on a signal counts as seen, all samples and joints together."""


def check_dynamic_excitation(arm: RecordedJointsModel, recording: Recording, effort: SensorUsage) -> Iterator[Issue]:
    """Issue where efforts due to speed and acceleration do not exceed the noise of measured efforts.

    Weight and stiffness can be found from static configurations; damping, friction and inertia only from these efforts,
    taken from inverse dynamics and friction of a typical size.

    Parameters
    ----------
    arm : Arm
    recording : Recording
        In which the arm `is_recorded_in`.
    effort : Choice
        How efforts are used; states their noise or leaves it to the recording.
    """
    joints = recording.joints
    motion = None if joints is None else smoothed_joint_motion(joints, arm.joint_names)
    if joints is None or motion is None or motion.effort is None or effort.use is False:
        return
    if float(np.max(np.ptp(motion.q, axis=0))) < QUALITY_LIMITS.min_joint_motion:
        return  # it stands still, which is said already
    noise = _noise(joints, arm.joint_names, effort)
    if not np.all(noise > 0):
        return
    still = np.zeros_like(motion.q)
    moving = arm.inverse_dynamics(motion.q, motion.v, motion.a) - arm.inverse_dynamics(motion.q, still, still)
    limit = np.array([joint.effort_limit for joint in arm.joints])
    friction = np.where(np.isfinite(limit), VISCOUS_FRICTION_FRACTION * limit, 0.0) * motion.v
    # noise beyond the band of motion is smoothed away, so that so many samples count as one
    apart = max(1.0, 1 / (2 * MOTION_BANDWIDTH_HZ * median_sample_period(joints.t)))
    samples = len(joints.t) / apart
    band = noise / math.sqrt(apart)
    size = np.sqrt(np.mean(moving**2 + friction**2, axis=0))
    seen = float(np.sqrt(samples * np.sum((size / band) ** 2)))
    if seen < _MIN_SIGNAL_STDS:
        j = int(np.argmax(size / band))
        yield Issue(
            "weak_excitation",
            f"speed and acceleration ask {arm.joint_names[j]} for {size[j]:.2g} N m (rms), beside noise of {noise[j]:.2g} "
            "N m from sample to sample; no joint tells more",
            "warning",
            _MIN_SIGNAL_STDS / max(seen, 1e-9),
            "move faster; from postures alone weight and stiffness can be found, no damping, friction or inertia",
            recording.name,
            "joints",
            "position",
        )


def _noise(joints: JointGroup, names: Sequence[str], effort: SensorUsage) -> Array:
    """White noise of efforts, as stated, else as seen, shape (k,) [N m]."""
    given = effort.std if effort.std is not None else joints.effort_std
    if given is not None:
        return values_by_joint(given, joints.names, names, f"sensors.{EFFORT_GROUP}.std")
    assert joints.effort is not None
    return np.array([white_noise_std(joints.t, joints.effort[:, joints.names.index(name)]) for name in names])


def check_joint_excitation(
    recordings: Sequence[Recording], asked: Mapping[str, Sequence[str]], position: SensorUsage
) -> Iterator[Issue]:
    """Issues of joints that have free parameters but hardly move in any recording.

    Parameters
    ----------
    recordings : sequence of Recording
        All that are estimated on.
    asked : mapping of str to sequence of str
        Free parameters of each joint.
    position : Choice
        How angles are used.
    """
    for joint, parameters in asked.items():
        widest, limit, name = 0.0, QUALITY_LIMITS.min_joint_motion, ""
        for recording in recordings:
            joints = recording.joints
            if joints is None or joint not in joints.names:
                continue
            angle = joints.position[:, joints.names.index(joint)]
            given = position.std if position.std is not None else joints.position_std
            if given is not None:
                limit = max(
                    limit, 6 * float(values_by_joint(given, joints.names, (joint,), f"sensors.{POSITION_GROUP}.std")[0])
                )
            limit = max(limit, 6 * white_noise_std(joints.t, angle))
            width = float(np.ptp(angle))
            if not name or width > widest:
                widest, name = width, recording.name
        if name and widest < limit:
            yield Issue(
                "weak_excitation",
                f"{joint} turns by {widest:.2g} rad at most, in {name}; {limit:.2g} rad is the least that tells "
                f"{', '.join(parameters)} from a constant effort",
                "warning",
                limit / max(widest, 1e-9),
                f"record a motion that turns {joint}, or fix {parameters[0]}",
                name,
                "joints",
                f"position.{joint}",
                setting="; ".join(f"parameters.{parameter}.free: false" for parameter in parameters),
            )

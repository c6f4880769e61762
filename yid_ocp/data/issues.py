"""Data quality issues of a recording: cause, place and severity, and the limits of the checks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.sensors import SensorOptions

Severity = Literal["warning", "not_trusted", "refused"]

MAX_EVIDENCE_RATIO = 1e3
"""Largest value of `Issue.evidence_ratio`; larger ratios are clipped."""
DEGREES_PER_RADIAN = math.degrees(1.0)
MIN_DIFFERENCES_FOR_NOISE_STD = 30
"""Smallest number of differences between samples from which a channel's noise is estimated."""


@dataclass(frozen=True)
class _QualityLimits:
    """Limits beyond which a check of a recording reports an issue."""

    max_joint_period: float = 0.5
    max_point_period: float = 30.0
    max_missing_fraction: float = 0.2
    max_clock_mismatch_fraction: float = 0.2
    max_rate_ratio: float = 1.3
    max_noise_ratio: float = 3.0
    max_overstatement_ratio: float = 5.0
    min_stuck_time: float = 0.3
    min_stuck_samples: int = 12
    max_unseen_rotation: float = 0.03
    min_clipped_samples: int = 8
    min_samples: int = 4
    min_joint_motion: float = 0.01
    min_point_travel: float = 0.002
    min_shared_samples: int = 50
    max_chance_of_shared_run: float = 1e-6


QUALITY_LIMITS = _QualityLimits()


@dataclass(frozen=True)
class Issue:
    """One data quality issue of a recording: cause, severity, evidence, advice, and where and when it occurs."""

    cause: str  # what is wrong, in one word of `ISSUE_CAUSE_DESCRIPTIONS`
    what: str  # the same in one sentence, with numbers
    # whether a run goes on as it would (and says so), goes on but says of no number that it is found, or stops
    weight: Severity
    evidence_ratio: float  # observed value over the detection limit, 1 to `MAX_EVIDENCE_RATIO`
    advice: str  # what to do
    # where; empty for all of them
    recording: str
    group: str = ""
    channel: str = ""
    # stretch of time on the group's clock [s]; all of it when absent
    begin: float | None = None
    end: float | None = None
    setting: str = ""  # line of configuration that repairs or describes it, where there is one

    def __post_init__(self) -> None:
        if self.cause not in ISSUE_CAUSE_DESCRIPTIONS:
            raise ValueError(f"there is no cause '{self.cause}'")
        object.__setattr__(self, "evidence_ratio", float(min(max(self.evidence_ratio, 1.0), MAX_EVIDENCE_RATIO)))

    @property
    def certainty_word(self) -> str:
        """Certainty of the issue in one word: `perhaps`, `likely` or `certain`."""
        return "perhaps" if self.evidence_ratio < 1.5 else "likely" if self.evidence_ratio < 3 else "certain"

    @property
    def where(self) -> str:
        """Text that locates the issue: recording, group, channel and time."""
        place = "/".join(part for part in (self.recording, self.group, self.channel) if part)
        span = "" if self.begin is None or self.end is None else f", {self.begin:.4g} to {self.end:.4g} s"
        return place + span


ISSUE_CAUSE_DESCRIPTIONS: Mapping[str, str] = {
    "time_unit": "times are not in seconds",
    "time_scale": "the clock runs too fast or too slowly",
    "clock_base": "clocks of two groups have nothing in common",
    "clock_offset": "the clock of one group is late or early",
    "clock_drift": "the clocks of two groups run apart",
    "clock_jump": "the clock jumps",
    "gap": "a gap in what drives the model",
    "dropped_samples": "many samples are missing",
    "few_samples": "too few samples",
    "standstill": "nothing moves",
    "stuck": "a channel repeats one value",
    "quantised": "a channel has steps larger than its noise",
    "saturated": "a channel is cut off at its extreme",
    "noise": "more noise than stated",
    "noise_overstated": "less noise than stated",
    "same_data": "the same data twice",
    "degrees": "angles are in degrees",
    "angle_scale": "an angle is multiplied by something",
    "angle_sign": "an angle has the wrong sign",
    "swapped_joints": "two joints are exchanged",
    "angle_limits": "angles are beyond the joint's limits",
    "speed_limits": "joints turn faster than they can",
    "effort_zero": "efforts are zero",
    "effort_sign": "an effort has the wrong sign",
    "effort_gain": "an effort is multiplied by something",
    "effort_offset": "an effort's zero is off",
    "effort_lag": "efforts are late",
    "effort_limits": "efforts are larger than the joint can bear",
    "effort_unlike": "efforts are not those of this robot",
    "point_scale": "lengths are not in metres",
    "point_mirrored": "points are mirrored or their axes exchanged",
    "point_frame": "points are in another frame",
    "point_swapped": "two points are exchanged",
    "point_reach": "points are where the object cannot be",
    "encoder_offset": "an encoder's zero is off",
    "point_unlike": "points are not where the robot holds them",
    "weak_excitation": "the motion is too weak to tell what is asked",
    "worse_than_guess": "a prediction without a model is nearer",
}
"""Description of every cause of an issue, as shown in tables."""

SensorOptionsLookup = Callable[[str], SensorOptions]


def median_sample_period(t: Array) -> float:
    """Median time between samples [s] of the times `t`; zero for fewer than two samples."""
    return float(np.median(np.diff(t))) if len(t) > 1 else 0.0

"""Calibration of the camera of a sequence: pose, depth scale and offset, and clock.

The robot is the calibration target: all ten numbers are estimated together from the arm in a sample of the frames
(`registration`), from starts that are looked for about what is told. Priors about that are wide; they decide where the
arm's motion informs of nothing. What stays uncertain is an error common to all frames, and enters the standard
deviation of every point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from numpy.typing import NDArray

from yid_ocp.errors import DataError
from yid_ocp.options import About, check
from yid_ocp.vision.clock import ClockOptions, Usual, agreed, own_offset
from yid_ocp.vision.registration import (
    CLOCK,
    DRIFT,
    FEWEST,
    SCALE,
    SHIFT,
    SIZE,
    TURN,
    Arm,
    CameraState,
    Clouds,
    Glimpse,
    Presence,
    RobustSum,
    improved,
    robust_sum,
    starts,
)

Array = NDArray[np.float64]

_LEAST_FRAMES = 3
_START_FRAMES = 6  # in which starts are tried
_STARTS = 4
_ENOUGH = 0.9  # of the arm is where a start has led: others are not tried
_WIDE = (0.08, 0.06, 0.045)  # reach of nearest surfaces, from stage to stage [m]
_REACH = 0.035  # along the camera's rays [m]
_ROUNDS, _LAST_ROUNDS = 3, 15
_THIN = 5000  # points of a frame among which starts are tried
_FEW, _MANY = 250, 700  # of them, near the arm
_SETTLED = 1e-5  # of a step: [rad], [m], [s]
_AROUND = 0.3  # of the directions to the arm that are looked at, to every side, as x/z and y/z
_NOTED = 0.006  # displacement of the arm that is worth a word [m]
_CONTRADICTED = 3.0  # standard deviations


@dataclass(frozen=True)
class CalibrationOptions:
    """Priors of the camera calibration, and how the visible arm is used for it."""

    fix_pose: Annotated[
        bool,
        About(
            "whether the told pose and depth are kept, those of a hand-eye calibration for example; the arm then finds "
            "the clock and checks the rest"
        ),
    ] = False
    frames: Annotated[int, Ge(_LEAST_FRAMES), About("so many, spread over the sequence, are compared with the arm")] = (
        24
    )
    turn_std: Annotated[float, Gt(0), About("standard deviation of the told directions, about each axis", "rad")] = 0.06
    shift_std: Annotated[float, Gt(0), About("standard deviation of the told place, along each axis", "m")] = 0.04
    scale_std: Annotated[float, Gt(0), About("standard deviation of the scale of its depth")] = 0.03
    depth_std: Annotated[float, Gt(0), About("standard deviation of an offset of its depth", "m")] = 0.01
    least_seen: Annotated[
        float,
        Gt(0),
        Le(1),
        About(
            "of the arm's surface that the camera should see and nothing hides, at least this share must be in the "
            "clouds where the calibration has it"
        ),
    ] = 0.6

    def __post_init__(self) -> None:
        check(self, "calibration options")

    def precision(self, clock: ClockOptions) -> Array:
        """Inverse covariance of the prior, shape (10, 10)."""
        std = [*[self.turn_std] * 3, *[self.shift_std] * 3, self.scale_std, self.depth_std]
        # a uniform distribution over what is searched; taken as it is where nothing is
        return np.diag(np.array([*std, max(clock.search / math.sqrt(3.0), 1e-6), clock.drift_std]) ** -2)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated camera of a sequence.

    Attributes
    ----------
    state : CameraState
        What is used: pose, depth, clock.
    told : CameraState
    usual : Usual or None
        Of frames by themselves; None where the clock was not compared.
    covariance : ndarray, shape (10, 10)
        Of `state`, in the order of `CameraState.minus`; zero where nothing was estimated.
    beside : ndarray, shape (10,)
        What the arm says less what is used: of a pose that was to be kept.
    presence : Presence or None
        How much of the arm was seen where it is.
    frames : int
        From which it was estimated.
    message : str
        In words.
    """

    state: CameraState
    told: CameraState
    usual: Usual | None
    covariance: Array
    beside: Array
    presence: Presence | None
    frames: int
    message: str

    @property
    def camera(self) -> Array:
        """The camera's position, shape (3,) [m]."""
        return self.state.pose[:3, 3]

    def common_std(self, points: Array, velocity: Array, stamps: Array) -> Array:
        """Standard deviations of points due to uncertainty of the camera's pose, depth and clock.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            In the world [m].
        velocity : ndarray, shape (N, 3)
            [m/s]
        stamps : ndarray, shape (N,)
            [s]

        Returns
        -------
        ndarray, shape (N, 3)
            [m]; the same error for all of them, as far as they stand at one place.
        """
        slopes = np.empty((len(points), 3, SIZE))
        slopes[:, :, :CLOCK] = self.state.slopes(points)
        # a point that is dated too early is where it came to be later
        slopes[:, :, CLOCK] = velocity
        slopes[:, :, DRIFT] = velocity * (stamps - self.state.about)[:, None]
        variance = np.einsum("nij,jk,nik->ni", slopes, self.covariance, slopes)
        # a shape that is held by the gripper and seen elsewhere gives way in any direction
        beside = slopes @ self.beside
        evenly = np.linalg.norm(beside, axis=1, keepdims=True) / math.sqrt(3.0)
        return np.asarray(np.sqrt(variance + np.maximum(np.abs(beside), evenly) ** 2))


def as_given(pose: Array, options: ClockOptions, reason: str = "") -> Calibration:
    """Camera calibration taken from the frames and settings without estimation, with the reason."""
    text = f"clock offset {1e3 * options.offset:.0f} ms as given" + (f": {reason}" if reason else "")
    state = CameraState(pose, offset=options.offset)
    return Calibration(state, state, None, np.zeros((SIZE, SIZE)), np.zeros(SIZE), None, 0, text)


def calibrate(
    arm: Arm,
    glimpses: Sequence[Glimpse],
    pose: Array,
    rng: np.random.Generator,
    options: CalibrationOptions,
    clock: ClockOptions,
    source: str = "sequence",
) -> Calibration:
    """Calibrate the camera of a sequence from some of its frames.

    Parameters
    ----------
    arm : Arm
    glimpses : sequence of Glimpse
        Thinned, the robot and what is about it among the points.
    pose : ndarray, shape (4, 4)
        Camera in the world, as far as known.
    rng : Generator
    options : CalibrationOptions
    clock : ClockOptions
    source : str
        Where the frames come from, for messages.

    Returns
    -------
    Calibration

    Raises
    ------
    DataError
        The arm is not seen, does not lie where the camera sees something, or moves too little to tell the time.
    """
    about = float(np.mean([g.stamp for g in glimpses])) if glimpses else 0.0
    told = CameraState(pose, offset=clock.offset, about=about)
    try:
        return _Calibrator(arm, glimpses, told, rng, options, clock).run()
    except _UntoldError as reason:
        if options.fix_pose and clock.search == 0:
            return as_given(pose, clock, str(reason))
        known = "track.options.calibration.fix_pose: true and track.options.clock.search: 0"
        raise DataError(
            f"the camera cannot be calibrated by the arm: {reason}",
            where=source,
            hint=f"{reason.hint}; with pose and clock known, set {known}",
        ) from None


class _UntoldError(Exception):
    """Why the arm does not tell."""

    def __init__(self, reason: str, hint: str) -> None:
        super().__init__(reason)
        self.hint = hint


class _Calibrator:
    """What one call of `calibrate` needs."""

    def __init__(
        self,
        arm: Arm,
        glimpses: Sequence[Glimpse],
        told: CameraState,
        rng: np.random.Generator,
        options: CalibrationOptions,
        clock: ClockOptions,
    ) -> None:
        self.arm, self.told, self.rng, self.options, self.clock = arm, told, rng, options, clock
        self.precision = options.precision(clock)
        self.glimpses = [g for g in (self._about_the_arm(g) for g in glimpses) if g is not None]

    def run(self) -> Calibration:
        if len(self.glimpses) < _LEAST_FRAMES:
            raise _UntoldError(
                f"it is in view in {len(self.glimpses)} frames, {_LEAST_FRAMES} are needed",
                "turn the camera so that it sees the arm, or record for longer",
            )
        state, chosen = self._start(), self.glimpses
        for _ in range(2):  # once more without the frames that were stamped late
            state, found, used = self._settled(state, chosen)
            own = [own_offset(self.arm, state, g.stamp, state.world(g.points), self.rng) for g in used]
            usual = agreed(own)
            chosen = [used[i] for i in usual.on_time]
            if len(chosen) < _LEAST_FRAMES:
                raise _UntoldError("its frames do not agree on one time", "check the time stamps")
        presence = Clouds(chosen).presence(self.arm, state, _REACH)
        self._check_presence(presence)
        covariance = found.covariance(self.precision)
        std = math.sqrt(covariance[CLOCK, CLOCK])
        if self.clock.search > 0 and not std < self.clock.determined:
            raise _UntoldError(
                f"it moves too little to tell the time: its clock is known to {1e3 * std:.0f} ms only",
                "record a livelier motion, or give the clock's offset with track.options.clock.offset and search: 0",
            )
        used_state, beside = state, np.zeros(SIZE)
        if self.options.fix_pose:
            used_state = replace(self.told, offset=state.offset, drift=state.drift)
            beside = state.minus(used_state)
        text = _message(state, used_state, self.told, covariance, presence, self.arm, chosen, self.clock)
        return Calibration(used_state, self.told, usual, covariance, beside, presence, len(chosen), text)

    def _about_the_arm(self, glimpse: Glimpse) -> Glimpse | None:
        """The points in the directions where the arm is, as far as told; None where it is out of view."""
        own = self.told.measured(self.arm.visible(self.told, glimpse.stamp)[0])
        points = glimpse.points[glimpse.points[:, 2] > 0]
        if len(own) < FEWEST or not len(points):
            return None
        at, towards = points[:, :2] / points[:, 2:], own[:, :2] / own[:, 2:]
        kept = ((at > towards.min(axis=0) - _AROUND) & (at < towards.max(axis=0) + _AROUND)).all(axis=1)
        return Glimpse(glimpse.stamp, points[kept]) if np.count_nonzero(kept) >= FEWEST else None

    def _thinned(self, glimpse: Glimpse) -> Glimpse:
        count = len(glimpse.points)
        return replace(glimpse, points=glimpse.points[self.rng.choice(count, min(count, _THIN), replace=False)])

    def _start(self) -> CameraState:
        """The state near which most of the arm is where the camera sees something."""
        few = [self._thinned(glimpse) for glimpse in _some(self.glimpses, _START_FRAMES)]
        tried = starts(self.arm, few, self.told, self.clock.search, _STARTS)
        if not tried:
            raise _UntoldError("it is hardly in view", "turn the camera so that it sees more of the arm")
        clouds, best, most = Clouds(few), tried[0], -1.0
        for trial in tried:
            for reach in _WIDE:
                trial = self._rounds(trial, few, reach, False, _FEW, _ROUNDS)[0]
            presence = clouds.presence(self.arm, trial, 0.5 * _REACH)
            if presence.there - presence.through > most:
                best, most = trial, presence.there - presence.through
            if most > _ENOUGH:
                break
        return best

    def _settled(self, state: CameraState, glimpses: Sequence[Glimpse]) -> tuple[CameraState, RobustSum, list[Glimpse]]:
        state = self._rounds(state, glimpses, _WIDE[-1], True, _FEW, _ROUNDS)[0]
        return self._rounds(state, glimpses, _REACH, True, _MANY, _LAST_ROUNDS)

    def _rounds(
        self, state: CameraState, glimpses: Sequence[Glimpse], reach: float, along: bool, most: int, rounds: int
    ) -> tuple[CameraState, RobustSum, list[Glimpse]]:
        """The state after some steps on at most so many points of each frame, the sum there, and those points."""
        chosen = []
        for glimpse in glimpses:
            points = state.world(glimpse.points)
            near = np.flatnonzero(self.arm.near(points, float(state.time(glimpse.stamp)), 1.5 * reach))
            if len(near) > most:
                near = self.rng.choice(near, most, replace=False)
            if len(near) >= FEWEST:
                chosen.append(Glimpse(glimpse.stamp, glimpse.points[near]))
        if len(chosen) < _LEAST_FRAMES:
            raise _UntoldError(
                "what the camera sees does not lie on it", "check the told pose and the unit of the clouds"
            )
        for _ in range(rounds):
            found = robust_sum([self.arm.rows(state, g, reach, along) for g in chosen], reach)
            state, step = improved(state, found, self.told, self.precision)
            if np.abs(step).max() < _SETTLED:
                break
        return state, robust_sum([self.arm.rows(state, g, reach, along) for g in chosen], reach), chosen

    def _check_presence(self, presence: Presence) -> None:
        free = presence.there + presence.through
        if not presence.there >= self.options.least_seen * free:
            raise _UntoldError(
                f"the camera sees through {100 * presence.through / max(free, 1e-9):.0f} % of its surface, wherever"
                " camera and clock are put",
                "check the told pose, the robot's description and which recording belongs to the frames",
            )


def _message(
    state: CameraState,
    used: CameraState,
    told: CameraState,
    covariance: Array,
    presence: Presence,
    arm: Arm,
    glimpses: Sequence[Glimpse],
    clock: ClockOptions,
) -> str:
    """What the arm says, in words."""
    words = []
    std = math.sqrt(covariance[CLOCK, CLOCK])
    if clock.search > 0:
        words.append(f"clock offset {1e3 * state.offset:.1f} ms ± {1e3 * std:.1f} ms (stamp minus joint time)")
    else:
        words.append(f"clock offset {1e3 * state.offset:.1f} ms as given")
    drift = math.sqrt(covariance[DRIFT, DRIFT])
    if abs(state.drift) > 2 * drift:
        words.append(f"its drift {1e3 * state.drift:.2f} ms in a second ± {1e3 * drift:.2f}")
    middle = glimpses[len(glimpses) // 2]
    points = arm.visible(state, middle.stamp)[0].mean(axis=0, keepdims=True)
    away = np.linalg.norm(state.world(told.measured(points)) - points)
    change = state.minus(told)
    turn, shift = math.degrees(float(np.linalg.norm(change[TURN]))), float(np.linalg.norm(change[SHIFT]))
    if used is not state:
        slopes = state.slopes(points)[0]
        spread = slopes @ covariance[:CLOCK, :CLOCK] @ slopes.T
        gap = slopes @ change[:CLOCK]
        size = float(gap @ np.linalg.solve(spread + 1e-6 * np.eye(3), gap))
        if size > _CONTRADICTED**2 * 3 and away > _NOTED:
            words.append(
                f"the arm contradicts the pose that is kept: it is seen {1e3 * away:.0f} mm from where the joints have"
                " it, which the standard deviations count"
            )
    elif away > _NOTED:
        words.append(
            f"the told camera sees the arm {1e3 * away:.0f} mm from where the joints have it: turned by {turn:.1f}"
            f" degrees, shifted by {1e3 * shift:.0f} mm, depth scaled by {math.exp(-change[SCALE]):.3f}"
        )
    words.append(f"from {len(glimpses)} frames, with {100 * presence.there:.0f} % of the arm's surface in the clouds")
    return "; ".join(words)


def _some(glimpses: Sequence[Glimpse], most: int) -> list[Glimpse]:
    if len(glimpses) <= most:
        return list(glimpses)
    return [glimpses[int(k)] for k in np.linspace(0, len(glimpses) - 1, most).round()]

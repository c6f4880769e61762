"""The weak-constraint smoother: which unknown forces, grasp offsets and sensor biases would explain the residual.

About the rollout of a fitted model every DEL row gets an unknown generalized force, every grasp an unknown offset and
every output of a point sensor an unknown bias. To first order

    x_{k+1} = A_k x_k + E_k d_j,   y_k = C_k x_k + b_j + noise,   d_{j+1} = a d_j + sqrt(1 - a^2) s eta_j,

with unknowns d (and b alike) that are constant over an interval j and forget with the time constant `MEMORY`; this is
|d|^2_Q + gamma |d_{j+1} - d_j|^2 of a weak constraint with Q and gamma stated as a deviation s and a memory. States
inside an interval are eliminated, so that the cost is linear in the number of intervals (Kalman filter, disturbance
smoother: de Jong 1989, doi:10.2307/2290075). Free parameters are regression effects of the filter, so that whatever
they can explain is left to them. Groups of unknowns (a segment's forces, a joint's, a camera's biases, ...) are taken
in one after the other, that which raises the evidence most first, their deviations s being those of the largest
evidence (MacKay 1992, doi:10.1162/neco.1992.4.3.415): the fewest places that explain the residual.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import casadi as ca
import numpy as np
import scipy.linalg
import scipy.optimize
import threadpoolctl
from numpy.typing import NDArray

from yid_ocp.effects.base import grasp_names, robot_joints
from yid_ocp.integrator.step_model import Rollout
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, apparent_inertia
from yid_ocp.problem.measurements import huber
from yid_ocp.problem.problem import Evaluation
from yid_ocp.sensors import EffortSensor, Sensor

Array = NDArray[np.float64]
Kind = Literal["force", "offset", "bias"]

MEMORY = 0.5
"""Time in which an unknown forgets its value [s]."""
INTERVAL = 0.1
"""Shortest time over which unknowns are constant [s]."""
INTERVALS = 150
"""Number of intervals of a long recording, beyond which they become longer."""
ITERATIONS = 12
"""Fixed-point iterations on the deviations."""
VARIANCES = (1e-6, 1e7)
"""Range of the variances, in units of the squared reference."""
WORTH = 5.0
"""Rise of the log evidence for which a group of unknowns is taken in: odds of 150 to 1."""
NOTICED = 10.0
"""Rise of r'r by which unknowns would be noticed."""
PLACES = 4
"""Groups taken in at most."""
LATER = 6
"""Groups tried after the first round, the most promising ones by their scores."""
FORCE = 0.1
"""Reference deviation of an unknown force, as a part of the load that its place carries."""
OFFSET = 2e-3
"""Reference deviation of a grasp's unknown offset [m]."""
BIAS = 3.0
"""Reference deviation of a sensor's unknown bias, in deviations of its noise."""


@dataclass(frozen=True)
class Source:
    """Unknowns that share a place and a deviation.

    Attributes
    ----------
    location : str
    kind : "force", "offset" or "bias"
    read : bool
        Whether a bias of an effort sensor would be the same: a force at a prescribed joint whose effort is measured.
    """

    location: str
    kind: Kind
    read: bool = False


@dataclass(frozen=True)
class Interval:
    """One interval's share of the linear model.

    Attributes
    ----------
    observed : ndarray, shape (r, 1 + ntheta)
        Whitened residual with the opposite sign, then its derivative by the free parameters, with that sign too.
    by_state : ndarray, shape (r, ns)
        Its derivative by the state at the interval's beginning.
    by_unknown : ndarray, shape (r, nd)
    transition : ndarray, shape (ns, ns)
        State at the end by that at the beginning.
    drive : ndarray, shape (ns, nd)
    rest : ndarray, shape (1 + ntheta, 1 + ntheta)
        Products of what no state or unknown can reach.
    samples : int
        Before rows were compressed.
    """

    observed: Array
    by_state: Array
    by_unknown: Array
    transition: Array
    drive: Array
    rest: Array
    samples: int


@dataclass(frozen=True)
class Linear:
    """The linear model of one recording.

    Attributes
    ----------
    recording : str
    intervals : tuple of Interval
    edges : ndarray, shape (J + 1,)
        Beginnings of the intervals and the end [s].
    unknowns : tuple of str
        Coordinate, grasp or channel of each of the nd unknowns.
    sources : tuple of Source
        That each of the nd unknowns belongs to.
    reference : ndarray, shape (nd,)
        Reference deviation of each; the matrices are by unknowns in this unit.
    at_rest : ndarray, shape (ns, nd)
        How the first state follows the first unknowns.
    loose : ndarray, shape (ns,)
        Deviation of the first state beside that.
    decay : float
        Correlation of an unknown with itself one interval later.
    """

    recording: str
    intervals: tuple[Interval, ...]
    edges: Array
    unknowns: tuple[str, ...]
    sources: tuple[Source, ...]
    reference: Array
    at_rest: Array
    loose: Array
    decay: float


@dataclass(frozen=True)
class Trace:
    """Unknowns of one recording as the smoother finds them.

    Attributes
    ----------
    recording : str
    edges : ndarray, shape (J + 1,)
        [s]
    unknowns : tuple of str
    sources : tuple of Source
    reference : ndarray, shape (nd,)
        [N m, N or m]
    mean, std : ndarray, shape (J, nd)
        In units of the reference.
    """

    recording: str
    edges: Array
    unknowns: tuple[str, ...]
    sources: tuple[Source, ...]
    reference: Array
    mean: Array
    std: Array


@dataclass(frozen=True)
class Smoothed:
    """What the smoother says.

    Attributes
    ----------
    traces : tuple of Trace
    variance : dict of Source to float
        Of every group, in units of its squared reference, at the largest evidence.
    weight : dict of Source to float
        Fall of the log evidence when the group is left out.
    detectable : dict of Source to float
        Smallest deviation of every group's unknowns that would be noticed, in units of the reference, from the model
        alone.
    before, after : float
        r'r, after the free parameters' refit, without and with the unknowns.
    degrees_before, degrees_after : float
        Measurements less what the parameters, and the unknowns, take of the noise.
    evidence : dict of str to float
        Log evidence of unknown forces and offsets alone ("plant"), of biases alone ("sensor"), of both, above that of
        neither ("none" is 0).
    """

    traces: tuple[Trace, ...]
    variance: dict[Source, float]
    weight: dict[Source, float]
    detectable: dict[Source, float]
    before: float
    after: float
    degrees_before: float
    degrees_after: float
    evidence: dict[str, float]

    @property
    def explainable(self) -> float:
        """Part of the gap G = max(0, chi2/n - 1) that unknown forces, offsets and biases can explain at all."""
        gap = self.before / self.degrees_before - 1
        rest = max(self.after / self.degrees_after - 1, 0.0)
        return float(np.clip(1 - rest / gap, 0.0, 1.0)) if gap > 0 else 0.0

    @property
    def side(self) -> str:
        """Whether the gap lies in the plant, in the sensors or in both, by evidence; "either" where it cannot tell."""
        if max(self.evidence.values()) <= 0:
            return "none"
        heaviest = max(self.weight, key=lambda source: self.weight[source])
        if heaviest.read:
            return "either"
        # both must beat either alone by more than chance
        alone = max(("plant", "sensor"), key=lambda name: self.evidence[name])
        return "both" if self.evidence["both"] - self.evidence[alone] > WORTH else alone


# -- the linear model -------------------------------------------------------------------------------------------------


def linear_model(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> tuple[Linear, ...]:
    """Linearise a problem about its rollouts at the unknowns `x`, with unknown forces, offsets and biases.

    Parameters
    ----------
    problem : EstimationProblem
    x : ndarray, shape (nx,)
    evaluation : Evaluation
        At `x`, with its Jacobian.
    """
    assert evaluation.jacobian is not None
    scale = problem.scales
    found, row = [], 0
    residual, slopes = problem.prior(x)
    stated = slice(0, problem.stated_prior_rows)
    prior = -np.column_stack([residual[stated], slopes[stated] * scale])
    for i, (episode, result) in enumerate(zip(problem.episodes, evaluation.episodes, strict=True)):
        theta = problem.own_theta(episode, problem.split(x, i)[0])
        count = sum(int(np.count_nonzero(s.weight > 0)) for s in episode.samples)
        rows = slice(row, row + count)
        observed = -np.column_stack([evaluation.residual[rows], evaluation.jacobian[rows] * scale])
        row += count
        found.append(_Builder(problem, episode, theta, result.rollout, result.predicted).build(observed))
    # stated priors of the free parameters are observations that no unknown reaches
    first, *later = found[0].intervals
    first = replace(first, rest=first.rest + prior.T @ prior)
    return (replace(found[0], intervals=(first, *later)), *found[1:])


class _Builder:
    """Makes the linear model of one recording."""

    def __init__(
        self,
        problem: EstimationProblem,
        episode: Episode,
        theta: Array,
        rollout: Rollout,
        predicted: Sequence[Array],
    ) -> None:
        self.problem, self.episode, self.theta, self.rollout, self.predicted = (
            problem,
            episode,
            theta,
            rollout,
            predicted,
        )
        self.step, self.system = problem.step, problem.system
        sizes = self.step.sizes
        self.n, self.nz, self.m, self.nx = sizes["n"], sizes["nz"], sizes["m"], sizes["nx"]
        self.h = self.step.time_step
        self.free = np.array(self.system.free_indices, int)
        self.fixed = np.array(self.system.prescribed_indices, int)
        self.kept = np.concatenate([self.free, np.arange(self.n, self.n + self.nz + self.m)]).astype(int)
        self.states = np.arange(self.nx)
        steps = episode.grid.steps
        length = int(max(round(INTERVAL / self.h), math.ceil(steps / INTERVALS), 1))
        self.edges = np.unique(np.append(np.arange(0, steps, length), steps))
        self.feedback = problem.feedback(episode)
        self._sources()

    def _sources(self) -> None:
        """Which coordinates, grasps and channels get an unknown, and how large it may be."""
        system, names = self.system, self.system.mechanism.joint_names
        place = {joint: s.name for s in system.segments for link in s.links for joint in link}
        place |= {joint: joint for joint in robot_joints(system)}
        measured = {
            joint
            for samples in self.episode.samples
            if isinstance(samples.sensor, EffortSensor)
            for joint in samples.sensor.joints
        }
        silent = {names[i] for i in self.fixed} - measured
        carried = self._loads()
        joints = [name for name in names if name in place and name not in silent and name not in system.compliant]
        self.forced = np.array([names.index(name) for name in joints], int)
        of_place: dict[str, list[float]] = {}
        for name, index in zip(joints, self.forced, strict=True):
            of_place.setdefault(place[name], []).append(carried[index])
        largest = max((max(v) for v in of_place.values()), default=1.0)
        size = {p: FORCE * max(float(np.sqrt(np.mean(np.square(v)))), 1e-2 * largest) for p, v in of_place.items()}
        unknowns = list(joints)
        sources = [Source(place[name], "force", name in measured) for name in joints]
        reference = [size[place[name]] for name in joints]
        self.closed: list[int] = []
        row = 0
        for grasp, name in zip(system.grasps, grasp_names(system), strict=True):
            self.closed += [row, row + 1, row + 2]
            unknowns += [f"{name}.{axis}" for axis in "xyz"]
            sources += [Source(name, "offset")] * 3
            reference += [OFFSET] * 3
            row += grasp.equations
        self.biased: list[tuple[int, int]] = []
        for k, samples in enumerate(self.episode.samples):
            if isinstance(samples.sensor, EffortSensor):
                continue  # at a prescribed joint a bias and a force are the same
            for column, channel in enumerate(samples.channel_of_column):
                if not np.any(samples.weight[:, column] > 0):
                    continue
                frame = samples.sensor.frames[column // samples.sensor.width]
                location = self._seen_by(samples.sensor, frame)
                self.biased.append((k, column))
                unknowns.append(f"{channel}.{'xyz'[column % 3]}")
                sources.append(Source(location, "bias"))
                reference.append(BIAS * float(np.nanmedian(samples.std[:, column])))
        self.unknowns, self.sources, self.reference = tuple(unknowns), tuple(sources), np.array(reference)

    def _seen_by(self, sensor: Sensor, frame: str) -> str:
        """What could be wrong where a point is misread: the camera, the arm that holds it, else the sensor's group."""
        if sensor.camera is not None:
            return "camera"
        for grasp in self.system.grasps:
            if frame in (grasp.held, grasp.holder):
                return grasp.name
        return sensor.group

    def _loads(self) -> Array:
        """Typical load of every coordinate: of its spring, its motor or its prescription, shape (n,) [N m or N]."""
        system, rollout = self.system, self.rollout
        load = np.zeros(self.n)
        q = rollout.state[:, : self.n]
        springs = [(system.mechanism.joint_index(s.joint), s) for s in system.elastic]
        if springs:
            symbols = ca.vertcat(*(ca.vertcat(s.stiffness, s.rest) for _, s in springs))
            values = np.array(ca.Function("springs", [system.parameters.symbols], [symbols])(self.theta)).ravel()
            for (index, _), stiffness, rest in zip(springs, values[::2], values[1::2], strict=True):
                load[index] = stiffness * float(np.sqrt(np.mean((q[:, index] - rest) ** 2)))
        for indices, force in ((system.driven_indices, rollout.torque), (system.prescribed_indices, rollout.effort)):
            if len(indices):
                load[list(indices)] = np.sqrt(np.mean(force**2, axis=0))
        return load

    def build(self, observed: Array) -> Linear:
        """The linear model from the whitened residuals and their slopes."""
        count, driven = len(self.unknowns), len(self.forced) + len(self.closed)
        self._drop_idle_states()
        states = self.states
        ns = len(states)
        reading = _Reading(self)
        intervals = []
        at_rest = np.zeros((ns, count))
        for j in range(len(self.edges) - 1):
            first, last = int(self.edges[j]), int(self.edges[j + 1])
            a, e, by_effort = self._steps(first, last)
            if j == 0 and self.problem.options.initial_state != "fitted_to_points":
                # rest under constant unknowns, x = A x + E d; what has no stiffness does not come to rest
                at_rest[:, :driven] = np.linalg.lstsq(np.eye(ns) - a[0], e[0], rcond=1e-6)[0]
            node = np.zeros((last - first + 1, ns, ns + driven))
            node[0, :, :ns] = np.eye(ns)
            effort = np.zeros((last - first + 1, len(self.fixed), ns + driven))
            for k in range(last - first):
                node[k + 1] = a[k] @ node[k]
                node[k + 1][:, ns:] += e[k]
                effort[k] = by_effort[k][:, :ns] @ node[k]
                effort[k][:, ns:] += by_effort[k][:, ns:]
            effort[-1] = effort[-2]
            rows, moved = reading.rows(j, node, effort)
            by_unknown, drive = np.zeros((len(rows), count)), np.zeros((ns, count))
            by_unknown[:, :driven] = moved[:, ns:]
            by_unknown[:, driven:] = reading.bias(rows, self.biased, self.reference[driven:])
            drive[:, :driven] = node[-1][:, ns:]
            intervals.append(_compressed(observed[rows], moved[:, :ns], by_unknown, node[-1][:, :ns], drive))
        span = self.h * float(np.median(np.diff(self.edges)))
        loose = np.zeros(self.nx)
        if self.problem.options.initial_state == "fitted_to_points":
            options, joints = self.problem.options, self.system.mechanism.joint_names
            inertia = apparent_inertia(self.step, self.theta, tuple(joints[i] for i in self.free))
            loose[self.free] = options.configuration_std
            loose[self.n + self.free] = options.velocity_std * np.abs(inertia)
        return Linear(
            self.episode.name,
            tuple(intervals),
            self.h * self.edges,
            self.unknowns,
            self.sources,
            self.reference,
            at_rest,
            loose[states],
            math.exp(-span / MEMORY),
        )

    def _drop_idle_states(self) -> None:
        """Leave out states that cannot move and internal coordinates that nothing depends on."""
        n, inner = self.n, np.arange(2 * self.n, self.nx)
        ends = (0, int(self.edges[-1]) - 1)
        steps = [self._steps(k, k + 1) for k in ends]
        a, e, effort = (sum(np.abs(found[i][0]) for found in steps) for i in range(3))
        used = np.any(a[: 2 * n, inner] > 1e-12, axis=0) | np.any(effort[:, inner] > 1e-12, axis=0)
        # a coordinate whose compliance is neutral neither moves nor is moved
        active = np.any(a > 0, axis=1) | np.any(e > 0, axis=1)
        active[self.fixed] = False
        active[inner] = used
        self.states = np.flatnonzero(active)
        self.kept = np.setdiff1d(self.kept, n + np.flatnonzero(~used))

    def _steps(self, first: int, last: int) -> tuple[Array, Array, Array]:
        """A_k (steps, ns, ns), E_k (steps, ns, nd') and the effort's slopes (steps, nc, ns + nd') of some steps."""
        n, nz, nx, h = self.n, self.nz, self.nx, self.h
        span = slice(first, last)
        stages = self.step.kernel.linearize(
            self.theta,
            self.rollout.state[first : last + 1],
            self.rollout.multipliers[span],
            self.rollout.torque[span],
            (),
            True,
        )
        steps, nt = last - first, n + nz + self.m
        width = nx + len(self.forced) + len(self.closed)
        top, bottom = np.zeros((steps, nt, width)), np.zeros((steps, n, width))
        for target, matrix in ((top, stages.rows_old), (bottom, stages.p1_old)):
            target[:, :, :n], target[:, :, 2 * n : nx] = matrix[:, :, :n], matrix[:, :, n:]
        top[:, np.arange(n), n + np.arange(n)] += 1.0
        if self.feedback is not None:
            index, gain = self.feedback.index, self.feedback.gain[span]
            top[:, :, index] -= stages.rows_input @ gain
            bottom[:, :, index] -= stages.p1_input @ gain
        # an unknown force is held over the step and shared by both equations like any other
        first_share = 1.0 if self.step.force_split == "left" else 0.5
        column = nx + np.arange(len(self.forced))
        unit = h * self.reference[: len(self.forced)]
        top[:, self.forced, column] = first_share * unit
        bottom[:, self.forced, column] = (1 - first_share) * unit
        row = n + nz + np.array(self.closed, int)
        top[:, row, nx + len(self.forced) + np.arange(len(self.closed))] = OFFSET
        columns = np.concatenate([self.states, np.arange(nx, width)])
        top, bottom = top[:, :, columns], bottom[:, :, columns]
        new = -np.linalg.solve(stages.rows_new[:, self.kept[:, None], self.kept], top[:, self.kept])
        after = np.zeros((steps, nx, len(columns)))
        inner = self.kept[(self.kept >= n) & (self.kept < n + nz)]
        after[:, self.free] = new[:, : len(self.free)]
        after[:, n : 2 * n] = bottom + stages.p1_new[:, :, self.kept] @ new
        after[:, n + inner] = new[:, len(self.free) : len(self.free) + len(inner)]
        effort = -(top[:, self.fixed] + stages.rows_new[:, self.fixed[:, None], self.kept] @ new) / h
        ns = len(self.states)
        return after[:, self.states, :ns], after[:, self.states, ns:], effort


class _Reading:
    """Slopes of the whitened samples by the states of the nodes about them."""

    def __init__(self, builder: _Builder) -> None:
        problem, theta, n = builder.problem, builder.theta, builder.n
        edges = self._edges = builder.edges
        state, efforts = builder.rollout.state, problem.efforts(builder.rollout)
        group: list[NDArray[np.int64]] = []
        column, node, fraction, weight, slope, load = [], [], [], [], [], []
        for samples, predicted in zip(builder.episode.samples, builder.predicted, strict=True):
            late = problem.lateness(samples, theta, ())
            placed = samples if late is None else samples.late(late[0])
            shape = samples.weight.shape
            where = placed.node if placed.node.ndim > 1 else np.broadcast_to(placed.node[:, None], shape)
            beyond = placed.fraction if placed.node.ndim > 1 else np.broadcast_to(placed.fraction[:, None], shape)
            _, by_q, by_z, by_e, _ = problem.sensor(samples.sensor, ())(state[:, :n], state[:, 2 * n :], efforts, theta)
            keep = samples.weight > 0
            raw = samples.weight * np.where(keep, predicted - samples.value, 0.0)
            factor = huber(raw, problem.options.huber_threshold)[1]
            group.append(np.full(int(keep.sum()), len(group)))
            column.append(np.broadcast_to(np.arange(shape[1]), shape)[keep])
            node.append(where[keep])
            fraction.append(beyond[keep])
            weight.append((factor * samples.weight)[keep])
            slope.append(np.concatenate([by_q, np.zeros((*by_q.shape[:2], n)), by_z], axis=2)[:, :, builder.states])
            load.append(by_e[:, :, builder.fixed])
        self._group, self._column = np.concatenate(group), np.concatenate(column)
        self._node, self._fraction = np.concatenate(node), np.concatenate(fraction)
        self._weight, self._slope, self._load = np.concatenate(weight), slope, load
        self._interval = np.clip(np.searchsorted(edges, self._node, side="right") - 1, 0, len(edges) - 2)

    def rows(self, j: int, node: Array, effort: Array) -> tuple[NDArray[np.int64], Array]:
        """Rows of the residual in one interval and their slopes by its directions.

        Parameters
        ----------
        j : int
        node : ndarray, shape (steps + 1, nx, d)
            Slopes of the states at its nodes.
        effort : ndarray, shape (steps + 1, nc, d)
        """
        rows = np.flatnonzero(self._interval == j)
        found = np.zeros((len(rows), node.shape[2]))
        first = int(self._edges[j])
        for k in range(len(self._slope)):
            own = np.flatnonzero(self._group[rows] == k)
            at, column = self._node[rows[own]], self._column[rows[own]]
            fraction = self._fraction[rows[own]]
            for shift, part in ((0, 1 - fraction), (1, fraction)):
                used = part > 0
                place = np.minimum(at[used] + shift, len(self._slope[k]) - 1)
                local = np.minimum(place - first, len(node) - 1)
                value = np.einsum("rx,rxd->rd", self._slope[k][place, column[used]], node[local])
                if effort.shape[1]:
                    value += np.einsum("rx,rxd->rd", self._load[k][place, column[used]], effort[local])
                found[own[used]] += part[used, None] * value
        return rows, found * self._weight[rows, None]

    def bias(self, rows: NDArray[np.int64], biased: Sequence[tuple[int, int]], reference: Array) -> Array:
        """Slopes of rows by the biases, in units of their reference."""
        found = np.zeros((len(rows), len(biased)))
        for i, (k, column) in enumerate(biased):
            own = (self._group[rows] == k) & (self._column[rows] == column)
            found[own, i] = self._weight[rows[own]] * reference[i]
        return found


def _compressed(observed: Array, by_state: Array, by_unknown: Array, transition: Array, drive: Array) -> Interval:
    """An interval with no more rows than columns: what is orthogonal to all columns only adds to the products."""
    joined, count = np.hstack([by_state, by_unknown]), len(observed)
    rest = np.zeros((observed.shape[1], observed.shape[1]))
    if len(joined) > joined.shape[1]:
        q, r = scipy.linalg.qr(joined, mode="economic", check_finite=False)
        turned = q.T @ observed
        rest = observed.T @ observed - turned.T @ turned
        observed, joined = turned, r
    ns = by_state.shape[1]
    return Interval(observed, joined[:, :ns], joined[:, ns:], transition, drive, rest, count)


# -- filter and smoother ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Pass:
    """Filter and disturbance smoother over one recording.

    `products` (1 + ntheta, 1 + ntheta) holds V' S^-1 V, `score` (J, nd, 1 + ntheta) and `information` (J, nd) the
    disturbances' scores and their variances, both by disturbances of unit variance before they are scaled, `mean`
    (J, nd, 1 + ntheta) the smoothed unknowns, `covariance` (J, nd) their variances, `left` the smoothed residuals.
    """

    products: Array
    log_determinant: float
    score: Array
    information: Array
    mean: Array
    covariance: Array
    left: tuple[Array, ...]


def _filter(model: Linear, variance: Array, smooth: bool) -> _Pass:
    """Run through one recording with given variances of the unknowns, shape (nd,)."""
    ns, nd = len(model.loose), len(variance)
    size, columns = ns + nd, model.intervals[0].observed.shape[1]
    gain = math.sqrt(1 - model.decay**2)
    fresh = np.zeros((size, size))
    fresh[ns:, ns:] = gain**2 * np.diag(variance)
    begin = np.vstack([model.at_rest, np.eye(nd)])
    p = (begin * variance) @ begin.T
    p[np.arange(ns), np.arange(ns)] += model.loose**2
    mean = np.zeros((size, columns))
    products, log_determinant = np.zeros((columns, columns)), 0.0
    empty = np.zeros(0)
    kept: list[tuple[Array, ...]] = []
    for interval in model.intervals:
        design = np.hstack([interval.by_state, interval.by_unknown])
        products += interval.rest
        cross = p @ design.T
        innovation = interval.observed - design @ mean
        factor, failed = scipy.linalg.lapack.dpotrf(design @ cross + np.eye(len(design)), lower=1)
        if failed:  # variances so large that rounding shows: never the best
            return _Pass(products, np.inf, empty, empty, empty, empty, ())
        white = scipy.linalg.solve_triangular(factor, innovation, lower=True, check_finite=False)
        shaped = scipy.linalg.solve_triangular(factor, design, lower=True, check_finite=False)
        products += white.T @ white
        log_determinant += 2 * float(np.sum(np.log(np.diag(factor))))
        move = np.zeros((size, size))
        move[:ns, :ns], move[:ns, ns:] = interval.transition, interval.drive
        move[ns:, ns:] = model.decay * np.eye(nd)
        if smooth:
            kept.append((mean, p, factor, white, shaped, move))
        half = shaped @ p
        mean = mean + half.T @ white
        p = p - half.T @ half
        mean = move @ mean
        p = move @ p @ move.T + fresh
        p = (p + p.T) / 2
    if not smooth:
        return _Pass(products, log_determinant, empty, empty, empty, empty, ())
    count = len(model.intervals)
    score, information = np.zeros((count, nd, columns)), np.zeros((count, nd))
    smoothed, covariance = np.zeros((count, nd, columns)), np.zeros((count, nd))
    left: list[Array] = []
    r, n = np.zeros((size, columns)), np.zeros((size, size))
    for j in reversed(range(count)):
        mean, p, factor, white, shaped, move = kept[j]
        if j + 1 < count:
            score[j + 1], information[j + 1] = gain * r[ns:], gain**2 * np.diag(n)[ns:]
        pull = white - shaped @ (p @ (move.T @ r))
        left.append(scipy.linalg.solve_triangular(factor, pull, lower=True, trans="T", check_finite=False))
        # L = T (I - P H' S^-1 H)
        square = shaped.T @ shaped
        loop = move - (move @ p) @ square
        r = shaped.T @ white + loop.T @ r
        n = square + loop.T @ n @ loop
        n = (n + n.T) / 2
        smoothed[j] = (mean + p @ r)[ns:]
        own = p[ns:]
        covariance[j] = np.diag(p)[ns:] - np.sum((own @ n) * own, axis=1)
    score[0], information[0] = begin.T @ r, np.sum(begin * (n @ begin), axis=0)
    return _Pass(products, log_determinant, score, information, smoothed, covariance, tuple(reversed(left)))


@dataclass(frozen=True)
class _State:
    passes: tuple[_Pass, ...]
    shift: Array
    spread: Array
    evidence: float


def _run(models: Sequence[Linear], variance: Mapping[Source, float], smooth: bool = True) -> _State:
    """All recordings at given variances: the parameters' step, its covariance, and the log evidence."""
    with ThreadPoolExecutor(max_workers=2) as pool:
        passes = tuple(
            pool.map(lambda model: _filter(model, np.array([variance[s] for s in model.sources]), smooth), models)
        )
    products = np.sum([p.products for p in passes], axis=0)
    count = len(products) - 1
    # a parameter may move by several times its size: the prior only keeps unseen ones in place
    precision = np.full(count, 1.0 / 9.0)
    information = products[1:, 1:] + np.diag(precision)
    factor = scipy.linalg.cho_factor(information, lower=True)
    shift = scipy.linalg.cho_solve(factor, products[1:, 0])
    quadratic = float(products[0, 0] - products[0, 1:] @ shift)
    determinant = sum(p.log_determinant for p in passes)
    determinant += 2 * float(np.sum(np.log(np.diag(factor[0])))) - float(np.sum(np.log(precision)))
    spread = scipy.linalg.cho_solve(factor, np.eye(count))
    return _State(passes, shift, spread, -0.5 * (quadratic + determinant))


def _scores(models: Sequence[Linear], state: _State) -> dict[Source, tuple[float, float]]:
    """|score|^2 of every group's unknowns and its expectation, whatever their variance is."""
    up: dict[Source, float] = {}
    down: dict[Source, float] = {}
    for model, done in zip(models, state.passes, strict=True):
        by_theta = done.score[:, :, 1:]
        score = done.score[:, :, 0] - by_theta @ state.shift
        information = np.maximum(done.information - np.sum((by_theta @ state.spread) * by_theta, axis=2), 0.0)
        for i, source in enumerate(model.sources):
            up[source] = up.get(source, 0.0) + float(np.sum(score[:, i] ** 2))
            down[source] = down.get(source, 0.0) + float(np.sum(information[:, i]))
    return {source: (up[source], down[source]) for source in up}


def _refined(models: Sequence[Linear], variance: dict[Source, float]) -> tuple[dict[Source, float], _State]:
    """Variances of the groups at work by MacKay's fixed point: s^2 <- s^2 |score|^2 / its expectation."""
    state = _run(models, variance)
    for _ in range(ITERATIONS):
        found = _scores(models, state)
        trial = {
            s: float(np.clip(v * np.clip(found[s][0] / max(found[s][1], 1e-300), 0.05, 20.0), *VARIANCES)) if v else 0.0
            for s, v in variance.items()
        }
        after = _run(models, trial)
        if not after.evidence > state.evidence + 0.05:
            break
        variance, state = trial, after
    return variance, state


def _selected(
    models: Sequence[Linear], sources: Sequence[Source], variance: dict[Source, float], state: _State
) -> tuple[dict[Source, float], _State]:
    """Add group after group, that which raises the evidence most, while it rises by more than chance."""
    while sum(v > 0 for v in variance.values()) < PLACES:
        found = _scores(models, state)
        promising = [s for s in sources if not variance[s] and found[s][0] > found[s][1]]
        promising.sort(key=lambda s: -found[s][0] / max(found[s][1], 1e-300))
        if any(variance.values()):
            promising = promising[:LATER]

        def best_of(source: Source, base: dict[Source, float] = variance) -> tuple[float, float]:
            def cost(exponent: float) -> float:
                return -_run(models, base | {source: 10.0**exponent}, smooth=False).evidence

            low, high = np.log10(VARIANCES)
            outcome = scipy.optimize.minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 0.4})
            return -float(outcome.fun), 10.0 ** float(outcome.x)

        with ThreadPoolExecutor(max_workers=2) as pool:
            tried = list(pool.map(best_of, promising))
        if not tried:
            return variance, state
        (evidence, size), source = max(zip(tried, promising, strict=True), key=lambda pair: pair[0][0])
        if not evidence > state.evidence + WORTH:
            return variance, state
        variance, state = _refined(models, variance | {source: size})
    return variance, state


def smooth(problem: EstimationProblem, x: Array, evaluation: Evaluation) -> Smoothed:
    """Find the unknowns with the largest evidence.

    Parameters
    ----------
    problem : EstimationProblem
        Whitened.
    x : ndarray, shape (nx,)
        Its fit.
    evaluation : Evaluation
        At `x`, with its Jacobian.

    Returns
    -------
    Smoothed
    """
    # matrices of this size are multiplied faster by one thread
    with threadpoolctl.threadpool_limits(1):
        models = linear_model(problem, x, evaluation)
        sources = tuple(dict.fromkeys(source for model in models for source in model.sources))
        none = dict.fromkeys(sources, 0.0)
        nothing = _run(models, none)
        # what unknowns of the reference deviation add to r'r on average is the variance of their scores
        detectable = {s: math.sqrt(NOTICED / max(v, 1e-300)) for s, (_, v) in _scores(models, nothing).items()}
        sides = {
            "both": sources,
            "plant": tuple(s for s in sources if s.kind != "bias"),
            "sensor": tuple(s for s in sources if s.kind == "bias"),
        }
        found: dict[str, tuple[dict[Source, float], _State]] = {}
        for side, own in sides.items():
            done = [entry for entry in found.values() if {s for s, v in entry[0].items() if v} <= set(own)]
            found[side] = done[0] if done else _selected(models, own, none, nothing)
        evidence = {"none": 0.0} | {side: state.evidence - nothing.evidence for side, (_, state) in found.items()}
        # what is chosen greedily among all may end behind a choice among fewer
        best, final = max(found.values(), key=lambda entry: entry[1].evidence)
        return _summary(models, best, final, nothing, detectable, evidence)


def _summary(
    models: Sequence[Linear],
    variance: dict[Source, float],
    state: _State,
    plain: _State,
    detectable: dict[Source, float],
    evidence: dict[str, float],
) -> Smoothed:
    traces = []
    before = after = taken = 0.0
    samples = 0
    for model, done in zip(models, state.passes, strict=True):
        by_theta = done.mean[:, :, 1:]
        smoothed = done.mean[:, :, 0] - done.mean[:, :, 1:] @ state.shift
        spread = done.covariance + np.sum((by_theta @ state.spread) * by_theta, axis=2)
        std = np.sqrt(np.maximum(spread, 0.0))
        text = (model.recording, model.edges, model.unknowns, model.sources, model.reference)
        traces.append(Trace(*text, smoothed, std))
        own = np.array([variance[s] for s in model.sources])
        taken += float(np.sum((own * done.information)[:, own > 0]))
        weight0, weight1 = np.append(1.0, -plain.shift), np.append(1.0, -state.shift)
        for j, interval in enumerate(model.intervals):
            bare, left = interval.observed @ weight0, done.left[j] @ weight1
            before += float(bare @ bare + weight0 @ interval.rest @ weight0)
            after += float(left @ left + weight1 @ interval.rest @ weight1)
            samples += interval.samples
    weight = dict.fromkeys(variance, 0.0)
    for source in [s for s, v in variance.items() if v]:
        less = _run(models, variance | {source: 0.0}, smooth=False)
        weight[source] = max(state.evidence - less.evidence, 0.0)
    degrees = max(float(samples) - len(plain.shift), 1.0)
    return Smoothed(
        tuple(traces), variance, weight, detectable, before, after, degrees, max(degrees - taken, 1.0), evidence
    )

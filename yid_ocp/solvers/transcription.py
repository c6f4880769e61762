"""Compiled transcription of an estimation problem: node states as unknowns, defects, objective, initial guess.

The unknown vector of the NLP is, in this order,

    (theta_free | recording 1: x_0, [x_j, (lam of the step before)] for every later node | recording 2: ... )

with x = (q, p, z). With a node at every step the DEL equations and constraints are the equality constraints themselves
and the multipliers are unknowns; with one every n steps the steps between are eliminated by the compiled rollout and
the equality constraints are the defects F^n(x_j) - x_{j+1}.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from yid_ocp.errors import SolverError
from yid_ocp.integrator.rollout import simulate
from yid_ocp.integrator.step import Directions, Rollout
from yid_ocp.problem.measurements import Measurements
from yid_ocp.problem.problem import EstimationProblem
from yid_ocp.solvers.guess import guess

Array = NDArray[np.float64]
Sparse: TypeAlias = Any


@dataclass(frozen=True)
class Layout:
    """Indices of one recording's node states and multipliers in the NLP's vector.

    Attributes
    ----------
    nodes : ndarray of int, shape (K + 1,)
        Steps at which there is a node state.
    state : ndarray of int, shape (K + 1, nx)
        Positions of the node states.
    multipliers : ndarray of int, shape (K, m)
        Positions of the multipliers, of width zero where steps are eliminated.
    """

    nodes: NDArray[np.int64]
    state: NDArray[np.int64]
    multipliers: NDArray[np.int64]


class Transcription:
    """Transcription of an estimation problem with node states as unknowns, evaluated by compiled rollouts.

    Parameters
    ----------
    problem : EstimationProblem
        Its recordings' start states are those of the problem (equilibrium or given).
    interval : int
        Steps between nodes.
    multipliers : bool
        Whether, with a node at every step, the DEL equations are constraints and their multipliers unknowns.

    Raises
    ------
    SolverError
        Effort channels, an interval below one, a recording shorter than one interval, or local parameters where there
        are multipliers.
    """

    def __init__(self, problem: EstimationProblem, interval: int, multipliers: bool = True) -> None:
        if interval < 1:
            raise SolverError(f"node_interval = {interval}", where="solver", allowed="a whole number from 1")
        if problem.local and multipliers:
            raise SolverError(
                f"{problem.local[0]} has a value of its own in every recording",
                where="multiple shooting",
                hint="use gauss_newton for problems with local parameters",
            )
        if not problem.as_recorded:
            raise SolverError(
                "an effect changes recorded inputs, times or what the tracking filter follows",
                where="multiple shooting",
                allowed="effects of the mechanics and of what sensors read",
                hint="use gauss_newton",
            )
        self.problem = problem
        self.step = problem.step
        self.interval = interval
        self.free_start = bool(problem.unknowns.start)
        sizes = problem.step.sizes
        self.nx, self.n, self.nz, self.m = sizes["nx"], sizes["n"], sizes["nz"], sizes["m"]
        self.has_multipliers = interval == 1 and multipliers
        at = len(problem.shared)
        layouts = []
        for episode in problem.episodes:
            steps = episode.grid.steps
            if steps < interval:
                raise SolverError(
                    f"the recording has {steps} steps, fewer than one node interval of {interval}",
                    where=episode.name,
                    allowed=f"solver.node_interval from 1 to {steps}",
                )
            if any(s.sensor.efforts for s in episode.samples):
                raise SolverError(
                    "effort channels depend on whole steps, which node states do not carry",
                    where=episode.name,
                    hint="use gauss_newton",
                )
            nodes = np.unique(np.append(np.arange(0, steps + 1, interval), steps))
            width = self.m if self.has_multipliers else 0
            state, places = [], []
            for j in range(len(nodes)):
                state.append(np.arange(at, at + self.nx))
                at += self.nx
                if j < len(nodes) - 1:
                    places.append(np.arange(at, at + width))
                    at += width
            layouts.append(
                Layout(nodes, np.array(state), np.array(places, dtype=np.int64).reshape(len(nodes) - 1, width))
            )
        self.layouts = tuple(layouts)
        self.size = at
        # equilibria are looked for near those of the problem's start, whatever the point
        starts = (problem.start_state(e, problem.split(problem.start, i)[0]) for i, e in enumerate(problem.episodes))
        self.warm = tuple(None if s.rest is None or s.message else s.rest.state[: self.n] for s in starts)

    # -- initial guess ------------------------------------------------------------------------------------------------

    def guess(self, x: Array) -> Array:
        """Initial guess of the NLP's vector at the parameters `x` or at multiples of them."""
        found = guess(self.problem, [layout.nodes for layout in self.layouts], self._unknowns(x), self._misfit)
        w = np.zeros(self.size)
        w[: len(self.problem.shared)] = found.x[: len(self.problem.shared)]
        for i, pair in enumerate(zip(found.states, found.multipliers, strict=True)):
            self._place(w, i, *pair)
        return w

    def _place(self, w: Array, i: int, state: Array, multipliers: Array) -> None:
        layout = self.layouts[i]
        w[layout.state.ravel()] = state.ravel()
        if self.has_multipliers:
            w[layout.multipliers.ravel()] = multipliers.ravel()

    def _misfit(self, i: int, state: Array, multipliers: Array, x: Array) -> float:
        """Mean square of one recording's whitened residuals at given node states."""
        trial = np.zeros(self.size)
        trial[: len(self.problem.shared)] = x[: len(self.problem.shared)]
        self._place(trial, i, state, multipliers)
        values = [value for value, _, _ in self._sample_rows(trial, i, False)]
        return float(np.mean(np.concatenate(values) ** 2))

    def _unknowns(self, theta_free: Array) -> Array:
        """The problem's unknown vector with the starts' offsets at zero."""
        x = self.problem.start.copy()
        x[: len(theta_free)] = theta_free
        return x

    # -- bounds -------------------------------------------------------------------------------------------------------

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the NLP's vector; prescribed coordinates are fixed."""
        lower, upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        count = len(self.problem.shared)
        low, high = self.problem.bounds
        lower[:count], upper[:count] = low[:count], high[:count]
        for episode, layout in zip(self.problem.episodes, self.layouts, strict=True):
            for column, index in enumerate(self.problem.system.prescribed_indices):
                positions = layout.state[:, index]
                lower[positions] = upper[positions] = episode.path[layout.nodes, column]
        return lower, upper

    # -- equality constraints -----------------------------------------------------------------------------------------

    def constraints(self, w: Array, derivatives: bool) -> tuple[Array, Sparse | None]:
        """Defects of all recordings, scaled to order one, and their Jacobian.

        Rows of a recording: its start state, then for every interval the DEL rows over h, internal and constraint rows
        and p_{k+1} (a node at every step), or F^n(x_j) - x_{j+1} (fewer nodes).
        """
        values, blocks = [], []
        for i in range(len(self.problem.episodes)):
            for part, jacobian in (self._start_rows(w, i, derivatives), self._motion_rows(w, i, derivatives)):
                values.append(part)
                blocks.append(jacobian)
        matrix = scipy.sparse.vstack(blocks, format="csc") if derivatives else None
        return np.concatenate(values), matrix

    def _theta(self, w: Array, episode: int) -> Array:
        theta = self.problem.split(self._unknowns(w[: len(self.problem.shared)]), episode)[0]
        return self.problem.predictor.own_theta(self.problem.episodes[episode], theta)

    def _start_rows(self, w: Array, i: int, derivatives: bool) -> tuple[Array, Sparse | None]:
        episode, layout = self.problem.episodes[i], self.layouts[i]
        loose = self.problem.predictor.start_rows if self.free_start else ()
        keep = np.setdiff1d(np.arange(self.nx), [*self.problem.system.prescribed_indices, *loose])
        theta = self._theta(w, i)
        start = self.problem.start_state(episode, theta, guess=self.warm[i])
        value = (w[layout.state[0]] - start.state)[keep]
        if not derivatives:
            return value, None
        rows = np.arange(len(keep))
        matrix = scipy.sparse.lil_matrix((len(keep), self.size))
        matrix[rows, layout.state[0][keep]] = 1.0
        count = len(self.problem.shared)
        if count:
            matrix[:, :count] = -start.by_unknowns[keep][:, :count]
        return value, matrix.tocsc()

    def _start_prior(self, w: Array, i: int, derivatives: bool) -> tuple[Array, Sparse | None]:
        """Offset of an estimated start from rest, over its prior's standard deviation."""
        layout, rows = self.layouts[i], np.array(self.problem.predictor.start_rows)
        start = self.problem.start_state(self.problem.episodes[i], self._theta(w, i), guess=self.warm[i])
        weight = 1.0 / self.problem.start_std
        value = weight * (w[layout.state[0]] - start.state)[rows]
        if not derivatives:
            return value, None
        matrix = scipy.sparse.lil_matrix((len(rows), self.size))
        matrix[np.arange(len(rows)), layout.state[0][rows]] = weight
        count = len(self.problem.shared)
        matrix[:, :count] = -(weight[:, None] * start.by_unknowns[rows][:, :count])
        return value, matrix.tocsc()

    def unknowns(self, w: Array) -> Array:
        """Problem's unknown vector at a point `w` of the NLP, shape (nx,)."""
        x = self._unknowns(w[: len(self.problem.shared)])
        if self.free_start:
            at, size = len(self.problem.shared), len(self.problem.predictor.start_rows)
            for i, (episode, layout) in enumerate(zip(self.problem.episodes, self.layouts, strict=True)):
                start = self.problem.start_state(episode, self._theta(w, i), guess=self.warm[i]).state
                x[at : at + size] = (w[layout.state[0]] - start)[list(self.problem.predictor.start_rows)]
                at += size
        return x

    def _motion_rows(self, w: Array, i: int, derivatives: bool) -> tuple[Array, Sparse | None]:
        if self.has_multipliers:
            return self._step_rows(w, i, derivatives)
        return self._interval_rows(w, i, derivatives)

    def _step_rows(self, w: Array, i: int, derivatives: bool) -> tuple[Array, Sparse | None]:
        """DEL rows of every step, of which the multipliers are unknowns too."""
        layout = self.layouts[i]
        state, steps = w[layout.state], len(layout.nodes) - 1
        value, block = self._stage_block(
            i, state[:-1], state[1:], w[layout.multipliers], self._theta(w, i), derivatives
        )
        if not derivatives:
            return value.ravel(), None
        return value.ravel(), self._assembled(block, self._stage_columns(i, steps), value.shape[1])

    def _stage_columns(self, i: int, steps: int) -> NDArray[np.int64]:
        layout, count = self.layouts[i], len(self.problem.shared)
        shared = np.broadcast_to(np.arange(count), (steps, count))
        return np.concatenate([shared, layout.state[:-1], layout.state[1:], layout.multipliers], axis=1)

    def _stage_block(
        self, i: int, before: Array, after: Array, multipliers: Array, theta: Array, derivatives: bool
    ) -> tuple[Array, Array]:
        """Rows of all steps, (N, height), and their derivatives by (theta, x_k, x_{k+1}, lam_k), (N, height, width)."""
        problem, episode = self.problem, self.problem.episodes[i]
        n, nz, m, nx, h = self.n, self.nz, self.m, self.nx, self.step.time_step
        steps = len(before)
        feedback = episode.feedback
        torque = episode.torque
        if feedback is not None:
            error = before[:, feedback.index] - feedback.reference
            torque = torque - np.einsum("kuj,kj->ku", feedback.gain, error)
        if np.array_equal(before[1:], after[:-1]):
            chained, used, lam, held = np.vstack([before, after[-1:]]), slice(None), multipliers, torque
        else:
            # the kernel takes one trajectory: lay the pairs end to end and skip the steps in between
            chained = np.stack([before, after], axis=1).reshape(2 * steps, nx)
            used, lam, held = (
                slice(0, None, 2),
                np.repeat(multipliers, 2, axis=0)[:-1],
                np.repeat(torque, 2, axis=0)[:-1],
            )
        stages = self.step.kernel.linearize(theta, chained, lam, held, problem.shared, derivatives)
        free = np.array(problem.system.free_indices)
        kept = np.concatenate([free, np.arange(n, n + nz + m)])
        scale = np.concatenate([np.full(len(free), 1.0 / h), np.ones(nz + m)])
        value = np.hstack([stages.rows[used][:, kept] * scale, (after[:, n : 2 * n] - stages.p1[used]) / h])
        if not derivatives:
            return value, np.zeros(0)
        count, height = len(problem.shared), len(kept) + n
        top, bottom = slice(0, len(kept)), slice(len(kept), height)
        block = np.zeros((steps, height, count + 2 * nx + m))
        old, new, last = count, count + nx, count + 2 * nx
        block[:, top, :count], block[:, bottom, :count] = stages.rows_theta[used][:, kept], -stages.p1_theta[used]
        for rows, matrix, sign in ((top, stages.rows_old[used][:, kept], 1.0), (bottom, stages.p1_old[used], -1.0)):
            block[:, rows, old : old + n] = sign * matrix[:, :, :n]
            block[:, rows, old + 2 * n : old + nx] = sign * matrix[:, :, n:]
        for rows, matrix, sign in ((top, stages.rows_new[used][:, kept], 1.0), (bottom, stages.p1_new[used], -1.0)):
            block[:, rows, new : new + n] = sign * matrix[:, :, :n]
            block[:, rows, new + 2 * n : new + nx] = sign * matrix[:, :, n : n + nz]
            block[:, rows, last:] = sign * matrix[:, :, n + nz :]
        block[:, np.arange(len(free)), old + n + free] += 1.0
        block[:, len(kept) + np.arange(n), new + n + np.arange(n)] += 1.0
        if feedback is not None:
            at = old + feedback.index
            block[:, top, at] -= stages.rows_input[used][:, kept] @ feedback.gain
            block[:, bottom, at] += stages.p1_input[used] @ feedback.gain
        block[:, top] *= scale[None, :, None]
        block[:, bottom] /= h
        return value, block

    def curvature(self, w: Array, weights: Array) -> Sparse:
        """Hessian of weights . g(w) of the DEL equations, from differences of their compiled Jacobian.

        One difference for each local coordinate of a step (parameters, q_k, q_{k+1}, lam_k; momenta enter linearly)
        serves all steps at once.
        """
        if not self.has_multipliers:
            raise SolverError(
                "an exact Hessian needs a node at every step",
                where="solver.hessian",
                allowed="node_interval: 1, or hessian: gauss_newton",
            )
        n, nx, count = self.n, self.nx, len(self.problem.shared)
        total: Sparse = scipy.sparse.csc_matrix((self.size, self.size))
        at = 0
        for i, layout in enumerate(self.layouts):
            state, lam, theta = w[layout.state], w[layout.multipliers], self._theta(w, i)
            at += len(self._start_rows(w, i, False)[0])
            value, block = self._stage_block(i, state[:-1], state[1:], lam, theta, True)
            weight = weights[at : at + value.size].reshape(value.shape)
            at += value.size
            base = np.einsum("kr,krc->kc", weight, block)
            steps, width = base.shape
            hessian = np.zeros((steps, width, width))
            coordinates = [*range(n), *range(2 * n, nx)]
            local = [*range(count)]
            local += [count + c for c in coordinates] + [count + nx + c for c in coordinates]
            local += [*range(count + 2 * nx, width)]
            for c in local:
                before, after, moved, own = state[:-1].copy(), state[1:].copy(), lam.copy(), theta.copy()
                if c < count:
                    index = self.problem.system.parameters.index(self.problem.shared[c])
                    size = 1e-6 * max(abs(own[index]), 1.0)
                    own[index] += size
                else:
                    size = 1e-6
                    target = before if c < count + nx else after if c < count + 2 * nx else moved
                    target[:, (c - count) % nx if c < count + 2 * nx else c - count - 2 * nx] += size
                changed = self._stage_block(i, before, after, moved, own, True)[1]
                hessian[:, :, c] = (np.einsum("kr,krc->kc", weight, changed) - base) / size
            hessian = 0.5 * (hessian + hessian.transpose(0, 2, 1))
            column = self._stage_columns(i, steps)
            rows = np.broadcast_to(column[:, :, None], hessian.shape).ravel()
            columns = np.broadcast_to(column[:, None, :], hessian.shape).ravel()
            total = total + scipy.sparse.csc_matrix((hessian.ravel(), (rows, columns)), shape=total.shape)
        return total

    def _interval_rows(self, w: Array, i: int, derivatives: bool) -> tuple[Array, Sparse | None]:
        """Defects over intervals whose inner steps the rollout eliminates."""
        problem, layout = self.problem, self.layouts[i]
        keep = np.setdiff1d(np.arange(self.nx), problem.system.prescribed_indices)
        count, nx = len(problem.shared), self.nx
        theta = self._theta(w, i)
        values, blocks = [], []
        for j in range(len(layout.nodes) - 1):
            directions = None
            if derivatives:
                start = np.zeros((nx, count + nx))
                start[:, count:] = np.eye(nx)
                directions = Directions(problem.shared, start)
            rollout = self.interval_sweep(i, j, w[layout.state[j]], theta, directions)
            values.append((rollout.state[-1] - w[layout.state[j + 1]])[keep])
            if derivatives:
                assert rollout.by_state is not None
                minus = np.zeros((len(keep), nx))
                minus[np.arange(len(keep)), keep] = -1.0
                blocks.append(np.hstack([rollout.by_state[-1][keep], minus]))
        value = np.concatenate(values)
        if not derivatives:
            return value, None
        steps = len(blocks)
        column = np.hstack([np.broadcast_to(np.arange(count), (steps, count)), layout.state[:-1], layout.state[1:]])
        return value, self._assembled(np.array(blocks), column, len(keep))

    def interval_sweep(self, i: int, j: int, start: Array, theta: Array, directions: Directions | None) -> Rollout:
        """Roll out one interval of a recording under its tracking feedback."""
        episode, nodes = self.problem.episodes[i], self.layouts[i].nodes
        first, last = int(nodes[j]), int(nodes[j + 1])
        feedback = episode.feedback
        if feedback is not None:
            feedback = replace(feedback, gain=feedback.gain[first:last], reference=feedback.reference[first:last])
        return simulate(
            self.step,
            theta,
            start,
            last - first,
            episode.torque[first:last],
            episode.path[first : last + 1],
            feedback,
            directions,
        )

    def _assembled(self, block: Array, column: NDArray[np.int64], height: int) -> Sparse:
        steps, _, width = block.shape
        row = np.arange(steps * height).reshape(steps, height, 1)
        rows = np.broadcast_to(row, block.shape)
        columns = np.broadcast_to(column[:, None, :width], block.shape)
        used = np.any(block != 0.0, axis=0)
        chosen = np.broadcast_to(used, block.shape)
        shape = (steps * height, self.size)
        return scipy.sparse.csc_matrix((block[chosen], (rows[chosen], columns[chosen])), shape=shape)

    # -- objective ----------------------------------------------------------------------------------------------------

    def residual(self, w: Array, derivatives: bool) -> tuple[Array, Sparse | None, float]:
        """Whitened residual of all samples and priors, its Jacobian, and the (robust) cost."""
        problem = self.problem
        count = len(problem.shared)
        values, blocks, cost = [], [], 0.0
        for i in range(len(problem.episodes)):
            for value, jacobian, loss in self._sample_rows(w, i, derivatives):
                values.append(value)
                blocks.append(jacobian)
                cost += loss
            if self.free_start:
                part, jacobian = self._start_prior(w, i, derivatives)
                cost += 0.5 * float(part @ part)
                values.append(part)
                blocks.append(jacobian)
        prior, by_theta = problem.prior(self._unknowns(w[:count]))
        own = np.any(by_theta[:, :count] != 0, axis=1)
        values.append(prior[own])
        cost += 0.5 * float(prior[own] @ prior[own])
        if not derivatives:
            return np.concatenate(values), None, cost
        wide = scipy.sparse.lil_matrix((int(own.sum()), self.size))
        wide[:, :count] = by_theta[own][:, :count]
        return np.concatenate(values), scipy.sparse.vstack([*blocks, wide.tocsr()], format="csc"), cost

    def _sample_rows(self, w: Array, i: int, derivatives: bool) -> list[tuple[Array, Sparse | None, float]]:
        """Residual, Jacobian and loss of every group of samples of one recording."""
        problem, layout = self.problem, self.layouts[i]
        theta = self._theta(w, i)
        result = []
        for samples in problem.episodes[i].samples:
            nodes = samples.nodes
            position = np.searchsorted(layout.nodes, nodes)
            if np.all(layout.nodes[np.minimum(position, len(layout.nodes) - 1)] == nodes):
                state = w[layout.state[position]]
                effort = np.zeros((len(nodes), self.n))
                outputs = problem.functions.sensor(samples.sensor, problem.shared)(
                    state[:, : self.n], state[:, 2 * self.n :], effort, theta
                )
                predicted, jacobian = self._at_nodes(samples, outputs, layout.state[position], derivatives)
            else:
                predicted, jacobian = self._between_nodes(w, i, samples, theta, derivatives)
            part = samples.rows(predicted, threshold=problem.options.huber_threshold)
            placed: Sparse | None = None
            if jacobian is not None:
                seen = samples.seen
                plain = scipy.sparse.diags_array(samples.weight[seen]) @ jacobian.tocsr()[seen.ravel()]
                placed = scipy.sparse.diags_array(part.factor) @ samples.independent(plain)
            result.append((part.residual, placed, part.cost))
        return result

    def _at_nodes(
        self, samples: Measurements, outputs: Sequence[Array], columns: NDArray[np.int64], derivatives: bool
    ) -> tuple[Array, Sparse | None]:
        y, by_q, by_z, _, by_theta = outputs
        predicted = samples.interpolate(y[:, :, 0])
        if not derivatives:
            return predicted, None
        count, width = len(self.problem.shared), y.shape[1]
        nodes = samples.nodes
        before = np.searchsorted(nodes, samples.node)
        after = np.minimum(np.searchsorted(nodes, samples.node + 1), len(nodes) - 1)
        total: Sparse | None = None
        for place, share in ((before, 1.0 - samples.fraction), (after, samples.fraction)):
            block = np.concatenate([by_theta[place], by_q[place], by_z[place]], axis=2) * share[:, None, None]
            at = np.hstack(
                [
                    np.broadcast_to(np.arange(count), (len(place), count)),
                    columns[place][:, : self.n],
                    columns[place][:, 2 * self.n :],
                ]
            )
            part = self._assembled(block, at, width)
            total = part if total is None else total + part
        return predicted, total

    def _between_nodes(
        self, w: Array, i: int, samples: Measurements, theta: Array, derivatives: bool
    ) -> tuple[Array, Sparse | None]:
        """Predictions at steps that the rollout eliminates, by the chain rule through the interval before them."""
        problem, layout, n = self.problem, self.layouts[i], self.n
        count, nx = len(problem.shared), self.nx
        nodes = samples.nodes
        state = np.zeros((len(nodes), nx))
        slope = np.zeros((len(nodes), nx, count + nx))
        owner = np.clip(np.searchsorted(layout.nodes, nodes, side="right") - 1, 0, len(layout.nodes) - 2)
        for j in np.unique(owner):
            start = np.zeros((nx, count + nx))
            start[:, count:] = np.eye(nx)
            directions = Directions(problem.shared, start) if derivatives else None
            rollout = self.interval_sweep(i, int(j), w[layout.state[j]], theta, directions)
            here = owner == j
            offset = nodes[here] - layout.nodes[j]
            state[here] = rollout.state[offset]
            if rollout.by_state is not None:
                slope[here] = rollout.by_state[offset]
        effort = np.zeros((len(nodes), n))
        y, by_q, by_z, _, by_theta = problem.functions.sensor(samples.sensor, problem.shared)(
            state[:, :n], state[:, 2 * n :], effort, theta
        )
        predicted = samples.interpolate(y[:, :, 0])
        if not derivatives:
            return predicted, None
        total = by_q @ slope[:, :n] + (by_z @ slope[:, 2 * n :] if self.nz else 0.0)
        total[:, :, :count] += by_theta
        before = np.searchsorted(nodes, samples.node)
        after = np.minimum(np.searchsorted(nodes, samples.node + 1), len(nodes) - 1)
        matrix: Sparse | None = None
        for place, share in ((before, 1.0 - samples.fraction), (after, samples.fraction)):
            at = np.hstack([np.broadcast_to(np.arange(count), (len(place), count)), layout.state[owner[place]]])
            part = self._assembled(total[place] * share[:, None, None], at, y.shape[1])
            matrix = part if matrix is None else matrix + part
        return predicted, matrix

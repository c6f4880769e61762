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
from yid_ocp.integrator.step import Rollout, SensitivityDirections
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.problem.measurements import Measurements
from yid_ocp.solvers.initial_guess import guess_node_states

Array = NDArray[np.float64]
_SparseMatrix: TypeAlias = Any


@dataclass(frozen=True)
class _RecordingLayout:
    """Indices of one recording's node states and multipliers in the NLP's vector.

    Attributes
    ----------
    node_steps : ndarray of int, shape (K + 1,)
        Steps at which there is a node state.
    state_indices : ndarray of int, shape (K + 1, nx)
        Positions of the node states.
    multiplier_indices : ndarray of int, shape (K, m)
        Positions of the multipliers, of width zero where steps are eliminated.
    """

    node_steps: NDArray[np.int64]
    state_indices: NDArray[np.int64]
    multiplier_indices: NDArray[np.int64]


class CompiledTranscription:
    """Transcription of an estimation problem with node states as unknowns, evaluated by compiled rollouts.

    Parameters
    ----------
    problem : EstimationProblem
        Its recordings' start states are those of the problem (equilibrium or given).
    node_interval : int
        Steps between nodes.
    multipliers : bool
        Whether, with a node at every step, the DEL equations are constraints and their multipliers unknowns.

    Raises
    ------
    SolverError
        Effort channels, an interval below one, a recording shorter than one interval, or local parameters where there
        are multipliers.
    """

    def __init__(self, problem: EstimationProblem, node_interval: int, multipliers: bool = True) -> None:
        if node_interval < 1:
            raise SolverError(f"node_interval = {node_interval}", where="solver", allowed="a whole number from 1")
        if problem.local_parameters and multipliers:
            raise SolverError(
                f"{problem.local_parameters[0]} has a value of its own in every recording",
                where="multiple shooting",
                hint="use gauss_newton for problems with local parameters",
            )
        if not problem.has_uncorrected_inputs:
            raise SolverError(
                "an effect changes recorded inputs, times or what the tracking filter follows",
                where="multiple shooting",
                allowed="effects of the mechanics and of what sensors read",
                hint="use gauss_newton",
            )
        self.problem = problem
        self.step = problem.step
        self.node_interval = node_interval
        self.estimates_initial_state = bool(problem.unknowns.initial_state_names)
        sizes = problem.step.sizes
        self.nx, self.n, self.nz, self.m = sizes["nx"], sizes["n"], sizes["nz"], sizes["m"]
        self.has_multipliers = node_interval == 1 and multipliers
        at = len(problem.shared_parameters)
        layouts = []
        for episode in problem.episodes:
            steps = episode.grid.steps
            if steps < node_interval:
                raise SolverError(
                    f"the recording has {steps} steps, fewer than one node interval of {node_interval}",
                    where=episode.name,
                    allowed=f"solver.node_interval from 1 to {steps}",
                )
            if any(s.sensor.effort_joints for s in episode.measurements):
                raise SolverError(
                    "effort channels depend on whole steps, which node states do not carry",
                    where=episode.name,
                    hint="use gauss_newton",
                )
            nodes = np.unique(np.append(np.arange(0, steps + 1, node_interval), steps))
            width = self.m if self.has_multipliers else 0
            state, places = [], []
            for j in range(len(nodes)):
                state.append(np.arange(at, at + self.nx))
                at += self.nx
                if j < len(nodes) - 1:
                    places.append(np.arange(at, at + width))
                    at += width
            layouts.append(
                _RecordingLayout(
                    nodes, np.array(state), np.array(places, dtype=np.int64).reshape(len(nodes) - 1, width)
                )
            )
        self.layouts = tuple(layouts)
        self.n_variables = at
        # equilibria are looked for near those of the problem's start, whatever the point
        starts = (
            problem.initial_state(e, problem.split(problem.initial_unknowns, i)[0])
            for i, e in enumerate(problem.episodes)
        )
        self.equilibrium_guesses = tuple(
            None if s.equilibrium is None or s.failure_message else s.equilibrium.state[: self.n] for s in starts
        )

    # -- initial guess ------------------------------------------------------------------------------------------------

    def initial_guess(self, x: Array) -> Array:
        """Initial guess of the NLP's vector at the parameters `x` or at multiples of them."""
        found = guess_node_states(
            self.problem, [layout.node_steps for layout in self.layouts], self._unknowns(x), self._misfit
        )
        w = np.zeros(self.n_variables)
        w[: len(self.problem.shared_parameters)] = found.x[: len(self.problem.shared_parameters)]
        for i, pair in enumerate(zip(found.node_states, found.multipliers, strict=True)):
            self._place(w, i, *pair)
        return w

    def _place(self, w: Array, i: int, state: Array, multipliers: Array) -> None:
        layout = self.layouts[i]
        w[layout.state_indices.ravel()] = state.ravel()
        if self.has_multipliers:
            w[layout.multiplier_indices.ravel()] = multipliers.ravel()

    def _misfit(self, i: int, state: Array, multipliers: Array, x: Array) -> float:
        """Mean square of one recording's whitened residuals at given node states."""
        trial = np.zeros(self.n_variables)
        trial[: len(self.problem.shared_parameters)] = x[: len(self.problem.shared_parameters)]
        self._place(trial, i, state, multipliers)
        values = [value for value, _, _ in self._sample_rows(trial, i, False)]
        return float(np.mean(np.concatenate(values) ** 2))

    def _unknowns(self, theta_free: Array) -> Array:
        """The problem's unknown vector with the starts' offsets at zero."""
        x = self.problem.initial_unknowns.copy()
        x[: len(theta_free)] = theta_free
        return x

    # -- bounds -------------------------------------------------------------------------------------------------------

    def variable_bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the NLP's vector; prescribed coordinates are fixed."""
        lower, upper = np.full(self.n_variables, -np.inf), np.full(self.n_variables, np.inf)
        count = len(self.problem.shared_parameters)
        low, high = self.problem.bounds
        lower[:count], upper[:count] = low[:count], high[:count]
        for episode, layout in zip(self.problem.episodes, self.layouts, strict=True):
            for column, index in enumerate(self.problem.system.prescribed_indices):
                positions = layout.state_indices[:, index]
                lower[positions] = upper[positions] = episode.prescribed_path[layout.node_steps, column]
        return lower, upper

    # -- equality constraints -----------------------------------------------------------------------------------------

    def constraints(self, w: Array, derivatives: bool) -> tuple[Array, _SparseMatrix | None]:
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
        theta = self.problem.split(self._unknowns(w[: len(self.problem.shared_parameters)]), episode)[0]
        return self.problem.predictor.episode_theta(self.problem.episodes[episode], theta)

    def _start_rows(self, w: Array, i: int, derivatives: bool) -> tuple[Array, _SparseMatrix | None]:
        episode, layout = self.problem.episodes[i], self.layouts[i]
        loose = self.problem.predictor.estimated_state_indices if self.estimates_initial_state else ()
        keep = np.setdiff1d(np.arange(self.nx), [*self.problem.system.prescribed_indices, *loose])
        theta = self._theta(w, i)
        start = self.problem.initial_state(episode, theta, guess=self.equilibrium_guesses[i])
        value = (w[layout.state_indices[0]] - start.state)[keep]
        if not derivatives:
            return value, None
        rows = np.arange(len(keep))
        matrix = scipy.sparse.lil_matrix((len(keep), self.n_variables))
        matrix[rows, layout.state_indices[0][keep]] = 1.0
        count = len(self.problem.shared_parameters)
        if count:
            matrix[:, :count] = -start.state_sensitivity[keep][:, :count]
        return value, matrix.tocsc()

    def _start_prior(self, w: Array, i: int, derivatives: bool) -> tuple[Array, _SparseMatrix | None]:
        """Offset of an estimated start from rest, over its prior's standard deviation."""
        layout, rows = self.layouts[i], np.array(self.problem.predictor.estimated_state_indices)
        start = self.problem.initial_state(
            self.problem.episodes[i], self._theta(w, i), guess=self.equilibrium_guesses[i]
        )
        weight = 1.0 / self.problem.initial_state_prior_std
        value = weight * (w[layout.state_indices[0]] - start.state)[rows]
        if not derivatives:
            return value, None
        matrix = scipy.sparse.lil_matrix((len(rows), self.n_variables))
        matrix[np.arange(len(rows)), layout.state_indices[0][rows]] = weight
        count = len(self.problem.shared_parameters)
        matrix[:, :count] = -(weight[:, None] * start.state_sensitivity[rows][:, :count])
        return value, matrix.tocsc()

    def unknowns_from_variables(self, w: Array) -> Array:
        """Problem's unknown vector at a point `w` of the NLP, shape (nx,)."""
        x = self._unknowns(w[: len(self.problem.shared_parameters)])
        if self.estimates_initial_state:
            at, size = len(self.problem.shared_parameters), len(self.problem.predictor.estimated_state_indices)
            for i, (episode, layout) in enumerate(zip(self.problem.episodes, self.layouts, strict=True)):
                start = self.problem.initial_state(episode, self._theta(w, i), guess=self.equilibrium_guesses[i]).state
                x[at : at + size] = (w[layout.state_indices[0]] - start)[
                    list(self.problem.predictor.estimated_state_indices)
                ]
                at += size
        return x

    def _motion_rows(self, w: Array, i: int, derivatives: bool) -> tuple[Array, _SparseMatrix | None]:
        if self.has_multipliers:
            return self._step_rows(w, i, derivatives)
        return self._interval_rows(w, i, derivatives)

    def _step_rows(self, w: Array, i: int, derivatives: bool) -> tuple[Array, _SparseMatrix | None]:
        """DEL rows of every step, of which the multipliers are unknowns too."""
        layout = self.layouts[i]
        state, steps = w[layout.state_indices], len(layout.node_steps) - 1
        value, block = self._stage_block(
            i, state[:-1], state[1:], w[layout.multiplier_indices], self._theta(w, i), derivatives
        )
        if not derivatives:
            return value.ravel(), None
        return value.ravel(), self._assembled(block, self._stage_columns(i, steps), value.shape[1])

    def _stage_columns(self, i: int, steps: int) -> NDArray[np.int64]:
        layout, count = self.layouts[i], len(self.problem.shared_parameters)
        shared = np.broadcast_to(np.arange(count), (steps, count))
        return np.concatenate(
            [shared, layout.state_indices[:-1], layout.state_indices[1:], layout.multiplier_indices], axis=1
        )

    def _stage_block(
        self, i: int, before: Array, after: Array, multipliers: Array, theta: Array, derivatives: bool
    ) -> tuple[Array, Array]:
        """Rows of all steps, (N, height), and their derivatives by (theta, x_k, x_{k+1}, lam_k), (N, height, width)."""
        problem, episode = self.problem, self.problem.episodes[i]
        n, nz, m, nx, h = self.n, self.nz, self.m, self.nx, self.step.time_step
        steps = len(before)
        feedback = episode.tracking_feedback
        torque = episode.torque
        if feedback is not None:
            error = before[:, feedback.state_indices] - feedback.reference
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
        stages = self.step.kernel.linearize(theta, chained, lam, held, problem.shared_parameters, derivatives)
        free = np.array(problem.system.free_indices)
        kept = np.concatenate([free, np.arange(n, n + nz + m)])
        scale = np.concatenate([np.full(len(free), 1.0 / h), np.ones(nz + m)])
        value = np.hstack([stages.residual[used][:, kept] * scale, (after[:, n : 2 * n] - stages.p1[used]) / h])
        if not derivatives:
            return value, np.zeros(0)
        count, height = len(problem.shared_parameters), len(kept) + n
        top, bottom = slice(0, len(kept)), slice(len(kept), height)
        block = np.zeros((steps, height, count + 2 * nx + m))
        old, new, last = count, count + nx, count + 2 * nx
        block[:, top, :count], block[:, bottom, :count] = (
            stages.residual_by_theta[used][:, kept],
            -stages.p1_by_theta[used],
        )
        for rows, matrix, sign in (
            (top, stages.residual_by_old[used][:, kept], 1.0),
            (bottom, stages.p1_by_old[used], -1.0),
        ):
            block[:, rows, old : old + n] = sign * matrix[:, :, :n]
            block[:, rows, old + 2 * n : old + nx] = sign * matrix[:, :, n:]
        for rows, matrix, sign in (
            (top, stages.residual_by_new[used][:, kept], 1.0),
            (bottom, stages.p1_by_new[used], -1.0),
        ):
            block[:, rows, new : new + n] = sign * matrix[:, :, :n]
            block[:, rows, new + 2 * n : new + nx] = sign * matrix[:, :, n : n + nz]
            block[:, rows, last:] = sign * matrix[:, :, n + nz :]
        block[:, np.arange(len(free)), old + n + free] += 1.0
        block[:, len(kept) + np.arange(n), new + n + np.arange(n)] += 1.0
        if feedback is not None:
            at = old + feedback.state_indices
            block[:, top, at] -= stages.residual_by_input[used][:, kept] @ feedback.gain
            block[:, bottom, at] += stages.p1_by_input[used] @ feedback.gain
        block[:, top] *= scale[None, :, None]
        block[:, bottom] /= h
        return value, block

    def constraint_hessian(self, w: Array, weights: Array) -> _SparseMatrix:
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
        n, nx, count = self.n, self.nx, len(self.problem.shared_parameters)
        total: _SparseMatrix = scipy.sparse.csc_matrix((self.n_variables, self.n_variables))
        at = 0
        for i, layout in enumerate(self.layouts):
            state, lam, theta = w[layout.state_indices], w[layout.multiplier_indices], self._theta(w, i)
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
                    index = self.problem.system.parameters.index(self.problem.shared_parameters[c])
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

    def _interval_rows(self, w: Array, i: int, derivatives: bool) -> tuple[Array, _SparseMatrix | None]:
        """Defects over intervals whose inner steps the rollout eliminates."""
        problem, layout = self.problem, self.layouts[i]
        keep = np.setdiff1d(np.arange(self.nx), problem.system.prescribed_indices)
        count, nx = len(problem.shared_parameters), self.nx
        theta = self._theta(w, i)
        values, blocks = [], []
        for j in range(len(layout.node_steps) - 1):
            directions = None
            if derivatives:
                start = np.zeros((nx, count + nx))
                start[:, count:] = np.eye(nx)
                directions = SensitivityDirections(problem.shared_parameters, start)
            rollout = self.rollout_interval(i, j, w[layout.state_indices[j]], theta, directions)
            values.append((rollout.state[-1] - w[layout.state_indices[j + 1]])[keep])
            if derivatives:
                assert rollout.state_sensitivity is not None
                minus = np.zeros((len(keep), nx))
                minus[np.arange(len(keep)), keep] = -1.0
                blocks.append(np.hstack([rollout.state_sensitivity[-1][keep], minus]))
        value = np.concatenate(values)
        if not derivatives:
            return value, None
        steps = len(blocks)
        column = np.hstack(
            [np.broadcast_to(np.arange(count), (steps, count)), layout.state_indices[:-1], layout.state_indices[1:]]
        )
        return value, self._assembled(np.array(blocks), column, len(keep))

    def rollout_interval(
        self, i: int, j: int, start: Array, theta: Array, directions: SensitivityDirections | None
    ) -> Rollout:
        """Roll out one interval of a recording under its tracking feedback."""
        episode, nodes = self.problem.episodes[i], self.layouts[i].node_steps
        first, last = int(nodes[j]), int(nodes[j + 1])
        feedback = episode.tracking_feedback
        if feedback is not None:
            feedback = replace(feedback, gain=feedback.gain[first:last], reference=feedback.reference[first:last])
        return simulate(
            self.step,
            theta,
            start,
            last - first,
            episode.torque[first:last],
            episode.prescribed_path[first : last + 1],
            feedback,
            directions,
        )

    def _assembled(self, block: Array, column: NDArray[np.int64], height: int) -> _SparseMatrix:
        steps, _, width = block.shape
        row = np.arange(steps * height).reshape(steps, height, 1)
        rows = np.broadcast_to(row, block.shape)
        columns = np.broadcast_to(column[:, None, :width], block.shape)
        used = np.any(block != 0.0, axis=0)
        chosen = np.broadcast_to(used, block.shape)
        shape = (steps * height, self.n_variables)
        return scipy.sparse.csc_matrix((block[chosen], (rows[chosen], columns[chosen])), shape=shape)

    # -- objective ----------------------------------------------------------------------------------------------------

    def residual(self, w: Array, derivatives: bool) -> tuple[Array, _SparseMatrix | None, float]:
        """Whitened residual of all samples and priors, its Jacobian, and the (robust) cost."""
        problem = self.problem
        count = len(problem.shared_parameters)
        values, blocks, cost = [], [], 0.0
        for i in range(len(problem.episodes)):
            for value, jacobian, loss in self._sample_rows(w, i, derivatives):
                values.append(value)
                blocks.append(jacobian)
                cost += loss
            if self.estimates_initial_state:
                part, jacobian = self._start_prior(w, i, derivatives)
                cost += 0.5 * float(part @ part)
                values.append(part)
                blocks.append(jacobian)
        prior, by_theta = problem.prior_residual(self._unknowns(w[:count]))
        own = np.any(by_theta[:, :count] != 0, axis=1)
        values.append(prior[own])
        cost += 0.5 * float(prior[own] @ prior[own])
        if not derivatives:
            return np.concatenate(values), None, cost
        wide = scipy.sparse.lil_matrix((int(own.sum()), self.n_variables))
        wide[:, :count] = by_theta[own][:, :count]
        return np.concatenate(values), scipy.sparse.vstack([*blocks, wide.tocsr()], format="csc"), cost

    def _sample_rows(self, w: Array, i: int, derivatives: bool) -> list[tuple[Array, _SparseMatrix | None, float]]:
        """Residual, Jacobian and loss of every group of samples of one recording."""
        problem, layout = self.problem, self.layouts[i]
        theta = self._theta(w, i)
        result = []
        for samples in problem.episodes[i].measurements:
            nodes = samples.evaluation_nodes
            position = np.searchsorted(layout.node_steps, nodes)
            if np.all(layout.node_steps[np.minimum(position, len(layout.node_steps) - 1)] == nodes):
                state = w[layout.state_indices[position]]
                effort = np.zeros((len(nodes), self.n))
                outputs = problem.model_functions.compiled_sensor(samples.sensor, problem.shared_parameters)(
                    state[:, : self.n], state[:, 2 * self.n :], effort, theta
                )
                predicted, jacobian = self._at_nodes(samples, outputs, layout.state_indices[position], derivatives)
            else:
                predicted, jacobian = self._between_nodes(w, i, samples, theta, derivatives)
            part = samples.residual_block(predicted, threshold=problem.options.huber_threshold)
            placed: _SparseMatrix | None = None
            if jacobian is not None:
                seen = samples.is_used
                plain = scipy.sparse.diags_array(samples.weight[seen]) @ jacobian.tocsr()[seen.ravel()]
                placed = scipy.sparse.diags_array(part.robust_factor) @ samples.decorrelate(plain)
            result.append((part.residual, placed, part.cost))
        return result

    def _at_nodes(
        self, samples: Measurements, outputs: Sequence[Array], columns: NDArray[np.int64], derivatives: bool
    ) -> tuple[Array, _SparseMatrix | None]:
        y, by_q, by_z, _, by_theta = outputs
        predicted = samples.interpolate(y[:, :, 0])
        if not derivatives:
            return predicted, None
        count, width = len(self.problem.shared_parameters), y.shape[1]
        nodes = samples.evaluation_nodes
        before = np.searchsorted(nodes, samples.node)
        after = np.minimum(np.searchsorted(nodes, samples.node + 1), len(nodes) - 1)
        total: _SparseMatrix | None = None
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
    ) -> tuple[Array, _SparseMatrix | None]:
        """Predictions at steps that the rollout eliminates, by the chain rule through the interval before them."""
        problem, layout, n = self.problem, self.layouts[i], self.n
        count, nx = len(problem.shared_parameters), self.nx
        nodes = samples.evaluation_nodes
        state = np.zeros((len(nodes), nx))
        slope = np.zeros((len(nodes), nx, count + nx))
        owner = np.clip(np.searchsorted(layout.node_steps, nodes, side="right") - 1, 0, len(layout.node_steps) - 2)
        for j in np.unique(owner):
            start = np.zeros((nx, count + nx))
            start[:, count:] = np.eye(nx)
            directions = SensitivityDirections(problem.shared_parameters, start) if derivatives else None
            rollout = self.rollout_interval(i, int(j), w[layout.state_indices[j]], theta, directions)
            here = owner == j
            offset = nodes[here] - layout.node_steps[j]
            state[here] = rollout.state[offset]
            if rollout.state_sensitivity is not None:
                slope[here] = rollout.state_sensitivity[offset]
        effort = np.zeros((len(nodes), n))
        y, by_q, by_z, _, by_theta = problem.model_functions.compiled_sensor(samples.sensor, problem.shared_parameters)(
            state[:, :n], state[:, 2 * n :], effort, theta
        )
        predicted = samples.interpolate(y[:, :, 0])
        if not derivatives:
            return predicted, None
        total = by_q @ slope[:, :n] + (by_z @ slope[:, 2 * n :] if self.nz else 0.0)
        total[:, :, :count] += by_theta
        before = np.searchsorted(nodes, samples.node)
        after = np.minimum(np.searchsorted(nodes, samples.node + 1), len(nodes) - 1)
        matrix: _SparseMatrix | None = None
        for place, share in ((before, 1.0 - samples.fraction), (after, samples.fraction)):
            at = np.hstack([np.broadcast_to(np.arange(count), (len(place), count)), layout.state_indices[owner[place]]])
            part = self._assembled(total[place] * share[:, None, None], at, y.shape[1])
            matrix = part if matrix is None else matrix + part
        return predicted, matrix

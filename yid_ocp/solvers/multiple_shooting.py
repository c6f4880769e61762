"""Multiple shooting: node states as unknowns of a nonlinear program, solved by IPOPT.

The program is CasADi's own (`symbolic`), or its values and derivatives come from the compiled kernel (`compiled`),
which also eliminates steps between nodes. With a node at every step both have the same constraints and, where no noise
drives the motion, the same objective; the errors that do are unknowns of the first and left out of the second.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal, get_args

import casadi as ca
import numpy as np
import scipy.sparse
from annotated_types import Ge, Gt
from numpy.typing import NDArray

from yid_ocp.errors import SolverError
from yid_ocp.options import OptionInfo, check_option_bounds
from yid_ocp.problem.estimation_problem import EstimationProblem
from yid_ocp.solvers.base import SOLVERS, IterationCallback, IterationRecorder, SolverResult, Status
from yid_ocp.solvers.compiled_transcription import CompiledTranscription
from yid_ocp.solvers.nonlinear_program import QUIET_OPTIONS, HessianKind, NonlinearProgram, available_memory
from yid_ocp.solvers.symbolic_transcription import MIN_RIDGE_FACTOR, transcribe, unknowns_from_program

log = logging.getLogger(__name__)

Array = NDArray[np.float64]
_TranscriptionForm = Literal["symbolic", "compiled"]

_MEMORY_WARNING_BYTES = 2e9
"""Estimated memory above which a warning is logged before solving [bytes]."""
_IPOPT_SUCCESS = {"Solve_Succeeded", "Solved_To_Acceptable_Level"}


@SOLVERS.register("multiple_shooting")
@dataclass(frozen=True)
class MultipleShooting:
    """Multiple shooting: min 1/2 |r(w)|^2 subject to the DEL equations of every step (or interval) and bounds.

    The start is that of `solvers.guess`; defects are scaled to order one, the cost by its initial value,
    and IPOPT's own scaling is off. In these units IPOPT's first bound multipliers, which are one, weigh as much as the
    cost, so that the first steps change no parameter by much more than a factor.

    A barrier parameter much above the default pushes parameters that the data hardly inform away from their bounds, and
    time is lost in bringing them back.

    References
    ----------
    Bock and Plitt (1984), IFAC Proc. 17(2):1603, doi:10.1016/S1474-6670(17)61205-9.
    Waechter and Biegler (2006), Math. Programming 106:25, doi:10.1007/s10107-004-0559-y.
    """

    node_interval: Annotated[
        int,
        Ge(1),
        OptionInfo("steps between nodes; 1 makes every equation of motion and multiplier part of the program"),
    ] = 1
    transcription: Annotated[
        _TranscriptionForm | None,
        OptionInfo(
            "whether the program is CasADi's own or calls the compiled step; when absent symbolic with a node at every "
            "step, else compiled, which alone can eliminate steps"
        ),
    ] = None
    hessian: Annotated[
        HessianKind,
        OptionInfo(
            "of the Lagrangian; exact adds the curvature of equations and sensors (compiled: of equations alone, by "
            "differences of their Jacobian)"
        ),
    ] = "gauss_newton"
    max_iterations: Annotated[int, Ge(1), OptionInfo("limit on IPOPT's iterations")] = 200
    tolerance: Annotated[float, Gt(0), OptionInfo("IPOPT's tol")] = 1e-6
    mu_init: Annotated[float, Gt(0), OptionInfo("initial barrier parameter, in units of the initial cost")] = 1e-7
    ipopt: Annotated[dict[str, Any], OptionInfo("further options of IPOPT, which win")] = field(default_factory=dict)
    name: ClassVar[str] = "multiple_shooting"
    needs_rollout: ClassVar[bool] = False

    def __post_init__(self) -> None:
        check_option_bounds(self, f"solver {self.name}")

    @property
    def chosen_transcription(self) -> _TranscriptionForm:
        """Transcription that is used: `transcription`, else by `node_interval`."""
        return self.transcription or ("symbolic" if self.node_interval == 1 else "compiled")

    @property
    def estimates_torque_errors(self) -> bool:
        """Whether the torque errors are estimated as unknowns of the program."""
        return self.chosen_transcription == "symbolic"

    def minimize_cost(
        self, problem: EstimationProblem, start: Array, callback: IterationCallback | None
    ) -> SolverResult:
        """Minimize the problem's cost from `start` with IPOPT on the chosen transcription."""
        if self.hessian not in ("gauss_newton", "exact"):
            raise SolverError(
                f"hessian = '{self.hessian}'",
                where="solver.hessian",
                allowed="gauss_newton, exact",
                hint="limited-memory updates cannot learn thousands of node states in a few dozen iterations",
            )
        if str(self.ipopt.get("hessian_approximation", "exact")) != "exact":
            raise SolverError(
                "limited-memory Hessians are refused",
                where="solver.ipopt.hessian_approximation",
                allowed="exact",
                hint="the node states number in the thousands; use hessian: gauss_newton",
            )
        if self.chosen_transcription not in get_args(_TranscriptionForm):
            raise SolverError(
                f"transcription = '{self.chosen_transcription}'",
                where="solver.transcription",
                allowed=", ".join(get_args(_TranscriptionForm)),
            )
        if self.chosen_transcription == "symbolic" and self.node_interval != 1:
            raise SolverError(
                f"node_interval = {self.node_interval} with the symbolic transcription",
                where="solver.transcription",
                allowed="node_interval: 1",
                hint="transcription: compiled eliminates the steps between nodes",
            )
        return (self._symbolic if self.chosen_transcription == "symbolic" else self._compiled)(problem, start, callback)

    def _symbolic(self, problem: EstimationProblem, start: Array, callback: IterationCallback | None) -> SolverResult:
        program = transcribe(problem, start)
        assert program.ridge is not None
        held = _Held(program.ridge.scale)
        program = replace(program, ridge=replace(program.ridge, factor=_Factor(held, program.w.numel())))
        needed, free = program.estimated_memory(self.hessian), available_memory()
        size = f"{program.w.numel()} unknowns, {program.g.numel()} equations, about {needed / 1e9:.2g} GB of memory"
        log.log(logging.WARNING if needed > _MEMORY_WARNING_BYTES else logging.INFO, "IPOPT on %s", size)
        if needed > free:
            message = f"{size}, of which {free / 1e9:.2g} GB are free; take a longer time_step, a shorter duration or "
            return SolverResult(Status.FAILED, message + "gauss_newton", start, (), 0)
        functions = ca.Function("point", [program.w, program.p], [program.f, program.grad_f, program.g])
        watch = _Watch(problem, program, functions, held, IterationRecorder(callback))
        options = self._options()
        options["ipopt"] = {"obj_scaling_factor": 1.0 / watch.unit, **options["ipopt"]}
        solver = program.make_solver("ipopt", self.hessian, iteration_callback=watch, **options)
        w = np.array(solver(**program.solver_arguments)["x"]).ravel()
        w = w if np.all(np.isfinite(w)) else watch.best
        defect = float(ca.norm_inf(functions(w, program.parameter_values)[2]))
        stats = solver.stats()
        status, message = self._ended(stats["return_status"], defect, 0)
        history, n = tuple(watch.recorder.history), problem.step.sizes["n"]
        warm = tuple(w[program.variables[f"q[{episode.name}]"].index[:n, 0]] for episode in problem.episodes)
        x = unknowns_from_program(problem, program, w)
        return SolverResult(status, message, x, history, int(stats["n_call_nlp_g"]), warm)

    def _compiled(self, problem: EstimationProblem, start: Array, callback: IterationCallback | None) -> SolverResult:
        transcription = CompiledTranscription(problem, self.node_interval)
        nlp = _Nlp(transcription, self.hessian, IterationRecorder(callback))
        w0 = transcription.initial_guess(start)
        lower, upper = transcription.variable_bounds()
        nlp.prepare(w0)
        functions = nlp.functions()
        solver = ca.nlpsol("multiple_shooting", "ipopt", functions.pop("nlp"), {**self._options(), **functions})
        result = solver(x0=w0, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)
        w = np.array(result["x"]).ravel()
        best = w if np.all(np.isfinite(w)) else nlp.best
        defect = float(np.max(np.abs(transcription.constraints(w, False)[0]), initial=0.0))
        status, message = self._ended(solver.stats()["return_status"], defect, nlp.lost)
        history, evaluations = tuple(nlp.recorder.history), nlp.recorder.n_evaluations
        return SolverResult(
            status,
            message,
            transcription.unknowns_from_variables(best),
            history,
            evaluations,
            transcription.equilibrium_guesses,
        )

    def _options(self) -> dict[str, Any]:
        """Options of CasADi's IPOPT interface."""
        return {
            **QUIET_OPTIONS,
            "no_nlp_grad": True,
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "max_iter": self.max_iterations,
                "tol": self.tolerance,
                "mu_init": self.mu_init,
                "nlp_scaling_method": "none",
                # the Hessian is positive definite by construction: MUMPS, which counts wrong signs among nearly
                # vanishing pivots, would have IPOPT regularise and factorise again
                "neg_curv_test_tol": 1e-11 if self.hessian == "gauss_newton" else 0.0,
                # measured on 50 variables and 500 steps: a sixth of the time of MUMPS's own choice
                "mumps_scaling": 8,
                "mumps_pivot_order": 0,
                "mumps_permuting_scaling": 0,
                "bound_relax_factor": 0.0,
                "acceptable_tol": 1e-3,
                "acceptable_iter": 4,
                "acceptable_constr_viol_tol": 1e-6,
                "acceptable_obj_change_tol": 1e-5,
                "fixed_variable_treatment": "make_parameter",
                **self.ipopt,
            },
        }

    def _ended(self, returned: str, defect: float, lost: int) -> tuple[Status, str]:
        """Status and message from IPOPT's own word, the largest defect and the trial points without a value."""
        if returned in _IPOPT_SUCCESS:
            return Status.CONVERGED, f"IPOPT: {returned}, largest defect {defect:.1e}"
        if returned == "Maximum_Iterations_Exceeded":
            limit = f"IPOPT stopped after {self.max_iterations} iterations, largest defect {defect:.1e}"
            return Status.ITERATION_LIMIT, f"{limit}; raise solver.max_iterations"
        if lost:
            returned += f", {lost} trial points could not be worked out"
        remedy = "start nearer, use more nodes, or use gauss_newton"
        return Status.STALLED, f"IPOPT: {returned}, largest defect {defect:.1e}; {remedy}"


class _Held:
    """A ridge that rises where parameters swing to and fro, and falls where they keep going."""

    def __init__(self, scale: Array) -> None:
        self.factor = MIN_RIDGE_FACTOR
        self._scale, self._change = scale, np.zeros(len(scale))

    def moved(self, before: Array, after: Array) -> None:
        """Take note of an iterate."""
        change = (after - before) / np.maximum(np.abs(after), self._scale)
        turned = float(change @ self._change) < 0
        self.factor = 4.0 * self.factor if turned else max(0.5 * self.factor, MIN_RIDGE_FACTOR)
        self._change = change


class _Factor(ca.Callback):
    """The factor of a ridge, as CasADi asks for it."""

    def __init__(self, held: _Held, size: int) -> None:
        ca.Callback.__init__(self)
        self._held, self._size = held, size
        self.construct("factor", {})

    def get_sparsity_in(self, _: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._size, 1)

    def eval(self, _: Sequence[ca.DM]) -> list[float]:
        """Whatever the point is."""
        return [self._held.factor]


class _Watch(ca.Callback):
    """Told by CasADi of every iterate; enters it in the history."""

    def __init__(
        self,
        problem: EstimationProblem,
        program: NonlinearProgram,
        functions: ca.Function,
        held: _Held,
        recorder: IterationRecorder,
    ) -> None:
        ca.Callback.__init__(self)
        self.recorder, self.best, self._held = recorder, program.initial_guess, held
        self._problem, self._program, self._functions = problem, program, functions
        cost = float(functions(program.initial_guess, program.parameter_values)[0])
        self.unit = max(cost, 0.5 * program.residual.numel() * problem.data_noise_unit**2)
        self._sizes = {"x": program.w.numel(), "f": 1, "g": program.g.numel(), "lam_x": program.w.numel()}
        self._sizes |= {"lam_g": program.g.numel(), "lam_p": program.p.numel()}
        self.construct("watch", {})

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_name_out(self, _: int) -> str:
        return "stop"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes[ca.nlpsol_out(i)], 1)

    def eval(self, arguments: Sequence[ca.DM]) -> list[int]:
        """Enter an iterate; never stops the solver."""
        w = np.array(arguments[0]).ravel()
        cost, slope, _ = self._functions(w, self._program.parameter_values)
        assert self._program.ridge is not None
        at = self._program.ridge.index
        self._held.moved(self.best[at], w[at])
        self.best = w
        x = unknowns_from_program(self._problem, self._program, w)
        self.recorder.n_evaluations += 1
        note = "" if self.recorder.history else "start"
        self.recorder.record_iterate(float(cost), x, float(ca.norm_inf(slope)) / self.unit, note)
        return [0]


class _Function(ca.Callback):
    """A CasADi function computed in Python."""

    def __init__(
        self,
        name: str,
        inputs: Sequence[str],
        outputs: Sequence[str],
        sparsity: dict[str, ca.Sparsity],
        compute: Callable[..., list],
    ) -> None:
        ca.Callback.__init__(self)
        self._inputs, self._outputs, self._sparsity, self._compute = list(inputs), list(outputs), sparsity, compute
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_name_in(self, i: int) -> str:
        return self._inputs[i]

    def get_name_out(self, i: int) -> str:
        return self._outputs[i]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self._sparsity[self._inputs[i]]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._sparsity[self._outputs[i]]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Sequence[memoryview | None], results: Sequence[memoryview | None]) -> int:
        """Compute on CasADi's own memory: a Jacobian of millions of entries is not copied to and fro."""
        # the arguments' memory is CasADi's only as long as this call lasts
        values = self._compute(*(np.zeros(0) if a is None else np.frombuffer(a).copy() for a in arguments))
        for place, value in zip(results, values, strict=True):
            if place is not None:
                np.frombuffer(place)[:] = value
        return 0


class _Nlp:
    """Objective, constraints and their derivatives in the form that CasADi's IPOPT interface takes."""

    def __init__(self, transcription: CompiledTranscription, hessian: HessianKind, recorder: IterationRecorder) -> None:
        self.transcription = transcription
        self.hessian = hessian
        self.recorder = recorder
        self.best = np.zeros(transcription.n_variables)
        self.lost = 0
        self._asked = np.zeros(0)
        count = len(transcription.problem.shared_parameters)
        self._held = _Held(transcription.problem.unknown_scales[:count])
        self._keep: list[_Function] = []

    def prepare(self, w0: Array) -> None:
        """Fix scaling and sparsity from the start and from random points about it."""
        t = self.transcription
        rng = np.random.default_rng(0)
        pattern_g: Any = None
        pattern_r: Any = None
        for trial in range(3):
            w = w0 + (rng.normal(scale=1e-2, size=len(w0)) * np.maximum(np.abs(w0), 1e-2) if trial else 0.0)
            _, jacobian = t.constraints(w, True)
            _, slope, _ = t.residual(w, True)
            assert jacobian is not None
            assert slope is not None
            pattern_g = abs(jacobian).sign() if pattern_g is None else pattern_g + abs(jacobian).sign()
            pattern_r = abs(slope).sign() if pattern_r is None else pattern_r + abs(slope).sign()
        self._g = _Pattern(pattern_g)
        curvature = pattern_r.T @ pattern_r
        if self.hessian == "exact":
            curvature = curvature + pattern_g.T @ pattern_g
        curvature = curvature + scipy.sparse.identity(t.n_variables, format="csc")
        self._h = _Pattern(scipy.sparse.triu(curvature, format="csc"))
        residual, _, cost = t.residual(w0, False)
        self._unit = max(cost, 0.5 * len(residual) * t.problem.data_noise_unit**2)
        self.best = w0
        self.recorder.n_evaluations += 1
        self.recorder.record_iterate(cost, w0[: len(t.problem.shared_parameters)], np.nan, "start")

    def functions(self) -> dict[str, ca.Function]:
        """The functions `nlp`, `grad_f`, `jac_g` and `hess_lag`."""
        t = self.transcription
        count = self._g.shape[0]
        sparsity = {
            "x": ca.Sparsity.dense(t.n_variables, 1),
            "p": ca.Sparsity.dense(0, 1),
            "f": ca.Sparsity.dense(1, 1),
            "g": ca.Sparsity.dense(count, 1),
            "lam_f": ca.Sparsity.dense(1, 1),
            "lam_g": ca.Sparsity.dense(count, 1),
            "grad_f": ca.Sparsity.dense(t.n_variables, 1),
            "jac_g": self._g.sparsity,
            "hess_lag": self._h.sparsity,
        }

        def make(name: str, inputs: Sequence[str], outputs: Sequence[str], compute: Callable[..., list]) -> _Function:
            self._keep.append(_Function(name, inputs, outputs, sparsity, compute))
            return self._keep[-1]

        return {
            "nlp": make("nlp", ("x", "p"), ("f", "g"), self._values),
            "grad_f": make("grad_f", ("x", "p"), ("f", "grad_f"), self._gradient),
            "jac_g": make("jac_g", ("x", "p"), ("g", "jac_g"), self._jacobian),
            "hess_lag": make("hess_lag", ("x", "p", "lam_f", "lam_g"), ("hess_lag",), self._curvature),
        }

    def _values(self, w: Array, _: Array) -> list:
        if not np.array_equal(w, self._asked):
            # IPOPT asks for the cost and for the constraints of a point one after the other
            self.recorder.n_evaluations += 1
            self._asked = w
        cost, constraints = self.transcription.residual(w, False)[2], self.transcription.constraints(w, False)[0]
        self.lost += not (np.isfinite(cost) and np.all(np.isfinite(constraints)))
        return [cost / self._unit, constraints]

    def _gradient(self, w: Array, _: Array) -> list:
        residual, slope, cost = self.transcription.residual(w, True)
        assert slope is not None
        gradient = slope.T @ residual
        if not np.array_equal(w, self.best):
            # IPOPT may ask more than once for the gradient at the point that it accepted
            count = len(self.transcription.problem.shared_parameters)
            self._held.moved(self.best[:count], w[:count])
            self.best = w
            self.recorder.record_iterate(
                cost, self.transcription.unknowns_from_variables(w), float(np.max(np.abs(gradient))) / self._unit
            )
        return [cost / self._unit, gradient / self._unit]

    def _size(self, w: Array) -> Array:
        problem = self.transcription.problem
        count = len(problem.shared_parameters)
        return np.maximum(np.abs(w[:count]), problem.unknown_scales[:count])

    def _jacobian(self, w: Array, _: Array) -> list:
        value, jacobian = self.transcription.constraints(w, True)
        assert jacobian is not None
        return [value, self._g.filled(jacobian)]

    def _curvature(self, w: Array, _: Array, lam_f: Array, lam_g: Array) -> list:
        residual, slope, cost = self.transcription.residual(w, True)
        assert slope is not None
        size = self._size(w)
        # along weakly informed parameters the curvature that Gauss-Newton leaves out may be as large as its own
        ridge = np.zeros(len(w))
        ridge[: len(size)] = self._held.factor * 2 * cost / len(residual) / size**2
        matrix = (slope.T @ slope + scipy.sparse.diags(ridge)) * (float(lam_f[0]) / self._unit)
        if self.hessian == "exact":
            matrix = matrix + self.transcription.constraint_hessian(w, lam_g)
        return [self._h.filled(scipy.sparse.triu(matrix, format="csc"))]


class _Pattern:
    """A fixed sparsity into which matrices of fewer entries are filled."""

    def __init__(self, matrix: Any) -> None:
        matrix = scipy.sparse.csc_matrix(matrix)
        matrix.sort_indices()
        self.shape = matrix.shape
        self._start, self._row = matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64)
        self.sparsity = ca.Sparsity(matrix.shape[0], matrix.shape[1], self._start.tolist(), self._row.tolist())
        columns = np.repeat(np.arange(self.shape[1]), np.diff(self._start))
        self._keys = columns * self.shape[0] + self._row

    def filled(self, matrix: Any) -> Array:
        """The matrix's entries in this pattern; entries outside it (a derivative that vanished by chance) are lost."""
        matrix = scipy.sparse.csc_matrix(matrix)
        matrix.sort_indices()
        if np.array_equal(matrix.indptr, self._start) and np.array_equal(matrix.indices, self._row):
            return np.asarray(matrix.data)
        columns = np.repeat(np.arange(self.shape[1]), np.diff(matrix.indptr))
        keys = columns * self.shape[0] + matrix.indices
        place = np.minimum(np.searchsorted(self._keys, keys), len(self._keys) - 1)
        values = np.zeros(len(self._keys))
        inside = self._keys[place] == keys
        values[place[inside]] = matrix.data[inside]
        return values

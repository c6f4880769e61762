"""Discretisation check: shifts of estimates and frequencies with finer links or shorter time steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.convergence import Frequencies, natural_frequencies
from yid_ocp.analysis.discretisation import Moves, Refined, counting, divided_joints, moves
from yid_ocp.analysis.stability import growth_of_fit
from yid_ocp.config.settings import Run, SegmentedObject, YObject
from yid_ocp.errors import YidError
from yid_ocp.integrator.step import at_time_step
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.evaluation import Evaluation
from yid_ocp.progress import SILENT, Progress
from yid_ocp.solvers import Solution, Status
from yid_ocp.solvers.judgement import typical_sizes
from yid_ocp.workflow.build import build_step, build_system, finer_factor

Array = NDArray[np.float64]
What = Literal["links", "time_step"]

TOLERATED = 0.02  # a frequency that moves by more than this fraction when links or steps are refined is worth a warning
MODES = 3
WORTH_COMPILING = 2000  # steps of one evaluation from which on compiling a finer model takes less time than it saves


# -- estimates --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Discretisation:
    """Shifts of the estimates with a finer discretisation.

    Attributes
    ----------
    moves : mapping of parameter to Moves
        Of every shared free parameter; empty where nothing was tried.
    notes : tuple of str
        Why something that was asked for is not known.
    """

    moves: Mapping[str, Moves]
    notes: tuple[str, ...] = ()

    def result(self, std: Mapping[str, float]) -> dict[str, Any]:
        """Shifts for result.json in the parameter's unit, with the standard deviation from the data alone."""
        return {name: {**asdict(own), "std": std.get(name)} for name, own in self.moves.items()}


def wanted(run: Run) -> tuple[What, ...]:
    """Refinements that a run's settings request after a solve.

    Where they do not say: the time step, and the links too where they stand for something that bends everywhere; the
    links of the paper's Y are its definition.
    """
    said = run.output.discretisation
    if said is None:
        said = "both" if isinstance(run.model.object, SegmentedObject) else "time_step"
    return {"none": (), "time_step": ("time_step",), "both": ("links", "time_step")}[said]  # type: ignore[return-value]


def discretisation(
    run: Run,
    problem: EstimationProblem,
    x: Array,
    at_x: Evaluation,
    what: tuple[What, ...],
    progress: Progress = SILENT,
    *,
    models_alone: bool = False,
) -> Discretisation:
    """Shifts of the estimates when every link is divided in two and when the time step is halved.

    Parameters
    ----------
    run : Run
    problem : EstimationProblem
    x : ndarray, shape (nx,)
    at_x : Evaluation
        With its Jacobian.
    what : tuple of "links", "time_step"
    progress : Progress, optional
    models_alone : bool
        At a point that is no estimate; see `moves`.
    """
    found: dict[str, dict[str, float]] = {}
    notes: list[str] = []
    for key in what:
        words = "twice the links" if key == "links" else "half the time step"
        if key == "links" and object_links(run) is None:
            continue
        progress.stage(f"trying {words}")
        try:
            refined = _with_twice_the_links(run, problem) if key == "links" else _with_half_the_step(problem)
            own = moves(refined, problem, x, at_x, models_alone=models_alone)
        except YidError as error:
            own = error.what
        if isinstance(own, str):
            notes.append(f"what {words} would change is not known: {own}")
        else:
            found[key] = own
    names = problem.shared if found else ()
    made = {name: Moves(*(found.get(key, {}).get(name) for key in ("links", "time_step"))) for name in names}
    return Discretisation(made, tuple(notes))


def counted(solution: Solution, found: Discretisation) -> Solution:
    """The solution with stds and verdicts that include the discretisation shifts."""
    sizes = {} if solution.problem is None else typical_sizes(solution.problem, solution.x)
    return replace(solution, parameters=counting(solution.parameters, found.moves, sizes))


def _with_twice_the_links(run: Run, problem: EstimationProblem) -> Refined:
    system, options = build_system(run, finer=2), problem.options
    steps = sum(episode.grid.steps for episode in problem.episodes)
    compiled = problem.step.compiled and steps > WORTH_COMPILING
    step = build_step(replace(run, problem=replace(run.problem, compiler=compiled)), system)
    factors = {name: float(finer_factor(run, name, 2)) for name in system.parameters.names}
    priors = {name: std * factors.get(name, 1.0) for name, std in options.priors.items()}
    recordings = [episode.recording for episode in problem.episodes]
    options = replace(options, priors=priors, joint_prior=options.joint_prior.scaled(factors))
    made = EstimationProblem(step, recordings, problem.free, options)
    return Refined(made, factors, divided_joints(problem.system, system))


def _with_half_the_step(problem: EstimationProblem) -> Refined:
    step = at_time_step(problem.step, problem.step.time_step / 2)
    recordings = [episode.recording for episode in problem.episodes]
    return Refined(EstimationProblem(step, recordings, problem.free, problem.options))


# -- stability --------------------------------------------------------------------------------------------------------


def steadied(problem: EstimationProblem, solution: Solution) -> tuple[Solution, dict[str, Any]]:
    """The solution, marked as not converged where the step is unstable, and stability data for result.json.

    Along the recorded motions, at the start of the search and at the estimate. A search may begin where the step is not
    stable and leave that place; one that ends there has followed the step's own errors.
    """
    begin, end = growth_of_fit(problem, problem.start), growth_of_fit(problem, solution.x)
    found = {key: None if own is None else asdict(own) for key, own in (("start", begin), ("estimate", end))}
    if end is not None and not end.stable:
        status = Status.STALLED if solution.status == Status.CONVERGED else solution.status
        return replace(solution, status=status, message=f"at the estimate {end.words} ({solution.message})"), found
    if solution.status == Status.FAILED and begin is not None and not begin.stable:
        return replace(solution, message=f"at the start {begin.words} ({solution.message})"), found
    return solution, found


# -- frequencies ------------------------------------------------------------------------------------------------------


def refine(run: Run, problem: EstimationProblem | None, warnings: list[str]) -> dict[str, Any]:
    """Lowest natural frequencies with twice the links and with half and a quarter of the time step.

    Returns
    -------
    dict
        `links` and `time_step`: lists of {value, hertz, growing, message}; empty where there is nothing to vary.
    """
    system = build_system(run)
    h = run.problem.time_step
    posture = _posture(system, problem)
    if posture is None:
        return {"links": [], "time_step": [], "message": "no posture is known: the run names no recording"}
    theta, guess = system.parameters.vector(), None
    rule = (run.problem.force_split, run.problem.constraint_force)
    if problem is not None:
        first = problem.episodes[0]
        theta = problem.predictor.own_theta(first, theta)
        guess = None if first.start is None else first.start.state[: system.size]
    own = natural_frequencies(system, posture, theta, h, *rule, guess)
    if own.message:
        return {"links": [], "time_step": [], "message": own.message}
    if own.growing:
        remedy = "problem.constraint_force: midpoint, " if rule[1] == "node" and system.grasps else ""
        warnings.append(
            f"{own.growing} modes grow from step to step about the first posture: take a shorter problem.time_step, "
            f"{remedy}or more damping"
        )
    values = dict(zip(system.parameters.names, theta, strict=True))
    steps = [_row(h, own)]
    steps += [_row(h / k, natural_frequencies(system, posture, theta, h / k, *rule, guess)) for k in (2, 4)]
    _warn(warnings, "the time step goes", "s", steps, len(steps) - 1, 0)
    count = object_links(run)
    rows = []
    if count is not None:
        other = build_system(run, finer=2)
        scaled = other.parameters.vector(
            {name: value * finer_factor(run, name, 2) for name, value in values.items() if name in other.parameters}
        )
        rows = [_row(count, own), _row(2 * count, natural_frequencies(other, posture, scaled, h, *rule))]
        _warn(warnings, "the links go", "", rows, 1, 0)
    return {"links": rows, "time_step": steps, "message": ""}


def object_links(run: Run) -> int | None:
    """Number of links per tube of the object, in total where tubes differ; None without divisible links."""
    item = run.model.object
    if isinstance(item, YObject):
        return item.links
    if not isinstance(item, SegmentedObject):
        return None
    counts = [s.links if s.link_lengths is None else len(s.link_lengths) for s in item.segments.values()]
    return counts[0] if len(set(counts)) == 1 else sum(counts)


def _posture(system: Any, problem: EstimationProblem | None) -> dict[str, float] | None:
    names = (*system.driven, *system.prescribed)
    if not names:
        return {}
    if problem is None:
        return None
    return dict(zip(names, map(float, problem.episodes[0].posture), strict=True))


def _row(value: float, found: Frequencies) -> dict[str, Any]:
    return {
        "value": value,
        "hertz": found.hertz[:MODES].tolist(),
        "growing": found.growing,
        "message": found.message,
    }


def _warn(warnings: list[str], what: str, unit: str, rows: list[dict[str, Any]], finest: int, own: int) -> None:
    fine, coarse = rows[finest]["hertz"], rows[own]["hertz"]
    for i, (a, b) in enumerate(zip(coarse, fine, strict=False)):
        if b > 0 and abs(a - b) / b > TOLERATED:
            change = f"from {rows[own]['value']:g} to {rows[finest]['value']:g} {unit}".rstrip()
            moved = f"{a:.3g} Hz to {b:.3g} Hz ({100 * abs(a - b) / b:.2g} %)"
            warnings.append(f"frequency {i + 1} moves from {moved} when {what} {change}")

"""How cost and memory grow: with variables, horizon, recordings, candidates, and what a second worker is worth.

    python benchmarks/growth.py [AXIS ...] [--whole] [--quick] [--largest N] [--json FILE] [--workers 1 2] [--cases 24]

Every point is measured in a process of its own: processor time of one evaluation with its derivatives (residual and
Jacobian by six stiffnesses, what an iteration of Gauss-Newton costs in the main), and by how much the process grew
beyond what it was before. Slopes are those of logarithms, so that 1 is linear growth; compilation is not counted.
With `--whole` it is the command `yid-ocp solve` in place of one evaluation, with checks, intervals and report.

`workers` solves the same problems with one process and with several. Its efficiency is work over what the processes
were there for: the processor time of one process over that of several (what is done twice, and what they take from
each other's caches) times the part of the time that they were busy.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from yid_ocp import cli
from yid_ocp.config.reader import load_config
from yid_ocp.data.recording_hdf5 import read_recording, write_recording
from yid_ocp.diagnosis.diagnose import fit_nominal_model
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, make_candidate_effects
from yid_ocp.diagnosis.refit import RefitContext
from yid_ocp.diagnosis.screening import linearize_candidates
from yid_ocp.files import write_strict_json
from yid_ocp.integrator import compiled
from yid_ocp.parallel import Task, WorkerConfig, run_tasks
from yid_ocp.parallel.threads_and_processes import process_pool
from yid_ocp.problem import EstimationProblem
from yid_ocp.report.terminal import aligned_table_lines
from yid_ocp.solvers import GaussNewton, fit_problem
from yid_ocp.workflow.build_problem import build_problem

REPOSITORY = Path(__file__).resolve().parents[1]
CONFIG = REPOSITORY / "configs" / "single_arm_no_vision.yaml"
# torques that are exact: an evaluation is one pass
RECORDING = REPOSITORY / "tests" / "data" / "clean" / "single_arm_no_vision_estimate.h5"
ARM, TUBES, JOINTS = 7, 3, 3  # joints of the arm, tubes, joints of a link: n = 7 + 9 links
VARIABLES: Mapping[bool, tuple[int, ...]] = {False: (25, 43, 79, 151, 295, 403), True: (16, 25)}
HORIZONS: Mapping[bool, tuple[int, ...]] = {False: (500, 1000, 5000, 10_000, 20_000, 50_000), True: (10, 40)}
RECORDINGS: Mapping[bool, tuple[int, ...]] = {False: (1, 2, 5, 10, 20, 50), True: (1, 3)}
CANDIDATES: Mapping[bool, tuple[int, ...]] = {False: (5, 10, 20, 40, 80), True: (1, 2)}
CASES: Mapping[bool, int] = {False: 24, True: 2}
DURATION = 5.0  # of the recording [s]
MIB = 1024.0**2

Point = Callable[[Sequence[str]], dict[str, float]]
"""What is measured with given settings."""

# -- what is measured -------------------------------------------------------------------------------------------------


def settings_of(links: int, quick: bool, files: Sequence[Path] = (RECORDING,), step: float = 0.01) -> list[str]:
    """Settings of one arm on a Y of so many links a tube, as stiff as one of four links of 12 N m/rad."""
    stiffness = json.dumps({
        f"T{tube}.{way}": {"free": True, "initial": 3.0 * links, "bounds": [0.0, 1e4]}
        for tube in (1, 2, 3) for way in ("bend", "twist")
    })  # fmt: skip
    given = [
        f"model.object.links={links}",
        "parameters={}",  # those of the configuration are of other links
        f"parameters={stiffness}",
        f"recordings.estimate={json.dumps([str(file) for file in files])}",
        "recordings.held_out=[]",
        f"problem.time_step={step}",
    ]
    return [*given, "problem.use_compiler=false", "problem.duration=0.1"] if quick else given


def problem_of(settings: Sequence[str]) -> EstimationProblem:
    return build_problem(load_config(CONFIG, settings))


def evaluation(settings: Sequence[str]) -> dict[str, float]:
    """An evaluation with its derivatives, after one that compiles and warms up."""
    problem = problem_of(settings)
    x = problem.initial_unknowns
    short = problem.with_options(replace(problem.options, duration=5 * problem.step.time_step))
    # many recordings march together as they do in a solve of some iterations, which is worth the compilation
    with mock.patch.object(compiled, "MIN_STEPS_TO_COMPILE_BATCH", 0):
        warm = short.evaluate(short.initial_unknowns)  # compiles, and needs next to no memory
        assert warm.ok, warm.message
        before = peak()
        begun = time.process_time()
        found = problem.evaluate(x)
    assert found.ok, found.message
    return {
        "cpu": time.process_time() - begun,
        "memory": peak() - before,
        "variables": problem.system.n_coordinates,
        "steps": sum(episode.grid.steps for episode in problem.episodes),
    }


def whole(settings: Sequence[str]) -> dict[str, float]:
    """The command `yid-ocp solve`, imports apart, after one on a tenth of the motion that compiles."""
    command = ["solve", str(CONFIG), "--quiet", *(part for own in settings for part in ("--set", own))]
    problem = problem_of(settings)
    with tempfile.TemporaryDirectory() as folder:
        cli.main([*command, "--set", f"problem.duration={DURATION / 10}", "--out", f"{folder}/first"])
        before = peak()
        begun = time.process_time()
        cli.main([*command, "--out", f"{folder}/run"])
        cpu = time.process_time() - begun
        assert (Path(folder) / "run" / "result.json").is_file()
    steps = sum(episode.grid.steps for episode in problem.episodes)
    return {"cpu": cpu, "memory": peak() - before, "variables": problem.system.n_coordinates, "steps": steps}


def side_by_side(counts: Sequence[int]) -> list[dict[str, float]]:
    """Wall time of so many `yid-ocp solve` at once: with one thread each, with all, and one after the other."""
    found = []
    for count in counts:
        point = {"commands": float(count)}
        for key, environment in (("one_thread", {"YID_OCP_THREADS": "1"}), ("all_threads", {})):
            with tempfile.TemporaryDirectory() as folder:
                begun = time.monotonic()
                command = [sys.executable, "-m", "yid_ocp", "solve", "--quiet", "--out"]
                own = {**os.environ, **environment}
                runs = [subprocess.Popen([*command, f"{folder}/{k}"], env=own) for k in range(count)]
                assert not any(run.wait() for run in runs)
                point[key] = time.monotonic() - begun
        found.append(point)
    keys = ("one_thread", "all_threads")
    return [point | {f"{key} / alone": point[key] / found[0][key] for key in keys} for point in found]


def screening(settings: Sequence[str], count: int) -> dict[str, float]:
    """The composed problem of so many candidates, and one sweep of all their sensitivities."""
    problem = problem_of(settings)
    recording = problem.episodes[0].recording
    effects = make_candidate_effects(problem.system, [recording], "all")[:count]
    before = peak()
    composed = AllCandidatesProblem.from_problem(problem, effects)
    nominal = fit_nominal_model(problem, RefitContext(composed))
    linearize_candidates(composed, (), nominal.values)  # compiles
    begun = time.process_time()
    linearize_candidates(composed, (), nominal.values)
    return {"cpu": time.process_time() - begun, "memory": peak() - before, "candidates": len(effects)}


def case(settings: list[str], seed: int) -> dict[str, float]:
    """One solve from values of its own: a task as workers do them."""
    begun = time.process_time()
    problem = problem_of(settings)
    rng = np.random.default_rng(seed)
    values = {
        name: float(x * math.exp(rng.uniform(-0.3, 0.3)))
        for name, x in zip(problem.unknown_names, problem.initial_unknowns, strict=True)
    }
    solution = fit_problem(
        problem, GaussNewton(max_iterations=6), initial_unknowns=problem.pack_unknowns(values).tolist(), restarts=False
    )
    return {"cpu": time.process_time() - begun, "cost": float(solution.cost)}


def peak() -> float:
    """Largest resident memory of this process so far [MiB]."""
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used / MIB if sys.platform == "darwin" else used / 1024.0


# -- axes -------------------------------------------------------------------------------------------------------------


def alone(function: Callable[..., dict[str, float]], *arguments: Any) -> dict[str, float]:
    """What a function measures in a process of its own."""
    with process_pool(1) as pool:
        return pool.submit(function, *arguments).result()


def variables(sizes: Sequence[int], quick: bool, what: Point) -> list[dict[str, float]]:
    return [alone(what, settings_of((n - ARM) // (TUBES * JOINTS), quick)) for n in sizes]


def horizon(sizes: Sequence[int], quick: bool, what: Point) -> list[dict[str, float]]:
    """More steps by finer ones: the recording is the same."""
    found = []
    for steps in sizes:
        step = (0.1 if quick else DURATION) / steps
        found.append(alone(what, settings_of(1 if quick else 4, quick, step=step)))
    return found


def recordings(sizes: Sequence[int], quick: bool, what: Point) -> list[dict[str, float]]:
    found = []
    with tempfile.TemporaryDirectory() as folder:
        files = [_another(i, Path(folder)) for i in range(max(sizes))]
        for count in sizes:
            point = alone(what, settings_of(1 if quick else 4, quick, files[:count]))
            found.append(point | {"recordings": count})
    return found


def candidates(sizes: Sequence[int], quick: bool, _: Point) -> list[dict[str, float]]:
    return [alone(screening, settings_of(1 if quick else 4, quick), count) for count in sizes]


def _another(number: int, folder: Path) -> Path:
    """The recording with other noise: the same data would count once."""
    recording = read_recording(RECORDING)
    joints, rng = recording.joints, np.random.default_rng(number)
    assert joints is not None
    noisy = joints.position + 1e-6 * rng.standard_normal(joints.position.shape)
    path = folder / f"recording_{number:02d}.h5"
    write_recording(replace(recording, joints=replace(joints, position=noisy), name=path.stem), path)
    return path


Measure = Callable[[Sequence[int], bool, Point], list[dict[str, float]]]
AXES: Mapping[str, tuple[Measure, str, Mapping[bool, tuple[int, ...]]]] = {
    "variables": (variables, "variables", VARIABLES),
    "horizon": (horizon, "steps", HORIZONS),
    "recordings": (recordings, "recordings", RECORDINGS),
    "candidates": (candidates, "candidates", CANDIDATES),
}
"""What measures every axis, by which key it goes, and its points, those of `--quick` as well."""


def slope(points: Sequence[Mapping[str, float]], by: str, of: str) -> float:
    """Exponent of a power law through some points, NaN for fewer than two."""
    known = [(point[by], point[of]) for point in points if point[of] > 0]
    if len({x for x, _ in known}) < 2:
        return math.nan
    x, y = np.log(np.array(known)).T
    return float(np.polyfit(x, y, 1)[0])


# -- workers ----------------------------------------------------------------------------------------------------------


def efficiency(counts: Sequence[int], cases: int, quick: bool) -> list[dict[str, float]]:
    """The same tasks by different numbers of processes; the first number is what the others are compared with."""
    settings = settings_of(1 if quick else 4, quick)
    case(settings, 0)  # compiles
    runs = [shared(settings, count, cases) for count in counts]
    assert len({tuple(costs) for _, costs in runs}) == 1, "workers change the answers"
    points = [point for point, _ in runs]
    return [point | {"efficiency": points[0]["cpu"] / point["cpu"] * point["occupied"]} for point in points]


def shared(settings: list[str], count: int, cases: int) -> tuple[dict[str, float], list[float]]:
    """Tasks by so many processes: their processor time and how busy the processes were, and what they found."""
    ends: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        tasks = [Task(f"case {k}", {"settings": settings, "seed": k}) for k in range(cases)]
        progress = lambda *_: ends.append(time.monotonic())  # noqa: E731
        results = run_tasks(case, tasks, Path(folder), WorkerConfig(n_processes=count), progress)
    failed = [entry.error for entry in results if entry.error]
    assert not failed, failed[0]
    # processes start once, however many tasks there are: the time counts from when the first task began
    span = ends[-1] - ends[0] + min(entry.seconds for entry in results)
    busy = sum(entry.seconds for entry in results)
    cpu = sum(entry.value["cpu"] for entry in results)
    point = {"workers": count, "cpu": cpu, "occupied": min(1.0, busy / (count * span))}
    return point, [entry.value["cost"] for entry in results]


# -- the run ----------------------------------------------------------------------------------------------------------


def report(found: Mapping[str, Sequence[Mapping[str, float]]], slopes: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Tables for a person."""
    lines: list[str] = []
    for axis, points in found.items():
        if axis == "workers":
            rows: list[Sequence[str]] = [("workers", "CPU [s]", "occupied", "efficiency")]
            rows += [
                (str(int(p["workers"])), f"{p['cpu']:.3g}", f"{p['occupied']:.2f}", f"{p['efficiency']:.2f}")
                for p in points
            ]
        elif axis == "side_by_side":
            keys = ("one_thread", "one_thread / alone", "all_threads", "all_threads / alone")
            rows = [("commands at once", *(f"wall, {key}" for key in keys))]
            rows += [(f"{p['commands']:g}", *(f"{p[key]:.3g}" for key in keys)) for p in points]
        else:
            by = AXES[axis][1]
            rows = [(by, "CPU [s]", "memory [MiB]")]
            rows += [(f"{p[by]:g}", f"{p['cpu']:.3g}", f"{p['memory']:.3g}") for p in points]
            rows.append(("slope", *(f"{slopes[axis][of]:.2f}" for of in ("cpu", "memory"))))
            rows.append(("at the end", *(f"{slope(points[-2:], by, of):.2f}" for of in ("cpu", "memory"))))
        lines += [*aligned_table_lines(rows), ""]
    return lines


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    known = [*AXES, "workers", "side_by_side"]
    parser.add_argument("axes", nargs="*", metavar="AXIS", help=f"of {', '.join(known)}; all when absent")
    parser.add_argument("--whole", action="store_true", help="measure whole commands in place of evaluations")
    parser.add_argument("--quick", action="store_true", help="small models without a compiler: whether it runs at all")
    parser.add_argument("--largest", type=float, default=math.inf, help="leave larger points of an axis out")
    parser.add_argument("--json", type=Path, metavar="FILE", help="store points and slopes")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2], help="numbers of processes to compare")
    parser.add_argument("--cases", type=int, help=f"that they share ({CASES[False]}; {CASES[True]} where quick)")
    chosen = parser.parse_args(arguments)
    unknown = sorted(set(chosen.axes) - set(known))
    if unknown:
        parser.error(f"there is no axis '{unknown[0]}'; choose from {', '.join(known)}")
    found: dict[str, list[dict[str, float]]] = {}
    slopes: dict[str, dict[str, float]] = {}
    what = whole if chosen.whole else evaluation
    for axis in [name for name in known if name in chosen.axes or not chosen.axes]:
        print(f"{axis} ...", file=sys.stderr, flush=True)
        if axis == "side_by_side":
            found[axis] = side_by_side((1,) if chosen.quick else (1, 2, 5))
            continue
        if axis == "workers":
            found[axis] = efficiency(chosen.workers, chosen.cases or CASES[chosen.quick], chosen.quick)
            continue
        measure, by, sizes = AXES[axis]
        found[axis] = measure([size for size in sizes[chosen.quick] if size <= chosen.largest], chosen.quick, what)
        slopes[axis] = {of: slope(found[axis], by, of) for of in ("cpu", "memory")}
    if chosen.json is not None:
        kept = {axis: {of: value for of, value in own.items() if math.isfinite(value)} for axis, own in slopes.items()}
        write_strict_json(chosen.json, {"points": found, "slopes": kept})
    print("\n".join(report(found, slopes)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

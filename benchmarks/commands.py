"""Whole commands as a user starts them: CPU, wall time and memory, as multiples of Pinocchio's RNEA derivatives.

    python benchmarks/commands.py [NAME ...] [--base DIR] [--cold] [--repeats 3] [--json FILE] [--gate]

Every command runs in a process of its own, one at a time, in turn with the same command of another checkout (`--base`).
The unit is 100 000 calls of computeRNEADerivatives at 43 coordinates in the same run: the figures hardly depend on the
machine, and `--gate` holds them against `baseline.json`. Each checkout has a cache of its own, filled by a first run;
with `--cold` it is empty every time, and so the C compiler counts.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from rich.console import Console
from rich.table import Table
from run import BASELINE, TOLERANCE, regressions
from workloads import Bench, rnea_derivatives

REPOSITORY = Path(__file__).resolve().parents[1]
COMMANDS: Mapping[str, tuple[str, ...]] = {
    "solve": ("solve",),
    "diagnose": ("diagnose",),
    "check": ("check",),
    "identifiability": ("identifiability",),
    "simulate": ("simulate", "configs/double_pendulum.yaml"),
    "solve_two_arms": ("solve", "configs/dual_arm_vision.yaml"),
    "diagnose_baxter": ("diagnose", "configs/baxter_arm.yaml"),
    "diagnose_cable": ("diagnose", "configs/deft_bdlo1.yaml"),
}
NOISY: Mapping[str, str] = {
    "diagnose_torque_noise": "clean",
    "diagnose_torque_noise_gap": "damped_trunk",
    "diagnose_torque_noise_outside": "tether",
}
"""Diagnoses of one arm with two recordings of 5 s that state errors of torques, by the case of `diagnosis_cases.py`."""
USUAL = ("solve", "diagnose", "check", "identifiability", "simulate")
UNIT_CALLS = 100_000
LIMIT = 7200.0  # [s]


def with_torque_noise(case: str, folder: Path) -> tuple[str, ...]:
    """The command that diagnoses a case whose recordings, made in a folder, state noise and offsets of torques."""
    from diagnosis_cases import CASES
    from make_recordings import TRAVEL, TRUTH

    from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
    from yid_ocp.data.recording_hdf5 import write_recording
    from yid_ocp.virtual.experiment import ArmSensorNoise, VirtualExperimentSettings, run_virtual_experiment
    from yid_ocp.virtual.injected import run_experiment_with_injected_effects
    from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
    from yid_ocp.workflow.build import build_system

    system = build_system(load_config(None, (), SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME))
    posture, travel = grasping_joint_angles(system, TRUTH), MultisineOptions(gripper_travel=TRAVEL[1])
    command = ["diagnose", "--set", "diagnosis.candidates=all"]
    for role, seed, noise_seed in (("estimate", 1, 401), ("held_out", 7, 402)):
        file, noise = folder / f"{case}_{role}.h5", ArmSensorNoise(effort_std=0.1, effort_bias_std=0.3)
        start = {"seed": seed, "initial_joint_angles": posture, "excitation": travel}
        motion = random_multisine_motion(system, TRUTH, **start)
        settings = VirtualExperimentSettings(
            motion=motion, initial_joint_angles=posture, seed=noise_seed, recording_name=file.stem, arm_noise=noise
        )
        withheld = CASES[case].withheld
        run = (withheld, settings) if withheld else (settings,)
        recording = (run_experiment_with_injected_effects if withheld else run_virtual_experiment)(system, TRUTH, *run)
        write_recording(recording, file)
        command += ["--set", f"recordings.{role}=[{file}]"]
    return tuple(command)


@dataclass(frozen=True)
class Cost:
    """CPU and wall time [s] and largest memory [GiB] of a command; one that was cut off took at least that."""

    cpu: float
    wall: float
    memory: float


def measured(command: Sequence[str], checkout: Path, cache: Path) -> Cost:
    """One run of a command of a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "YID_OCP_CACHE": str(cache)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # users have compiled modules
    # a process between, so that its children's figures are this command's alone
    watch = "import resource, subprocess, sys; c = subprocess.call(sys.argv[1:]); r = resource.getrusage(resource."
    watch += "RUSAGE_CHILDREN); print(); print(c, r.ru_utime + r.ru_stime, r.ru_maxrss)"
    with tempfile.TemporaryDirectory() as folder:
        line = [sys.executable, "-m", "yid_ocp", *command, "--out", f"{folder}/run", "--quiet"]
        begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        try:
            told = subprocess.run(
                [sys.executable, "-c", watch, *line],
                cwd=checkout,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                timeout=LIMIT,
                check=True,
            )
        except subprocess.TimeoutExpired:
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            return Cost(after.ru_utime - before.ru_utime, LIMIT, 0.0)
        code, cpu, size = told.stdout.splitlines()[-1].split()
        if int(code) not in (0, 1):
            raise SystemExit(f"{' '.join(command)} of {checkout} ended with exit code {code}")
        return Cost(float(cpu), time.perf_counter() - begun, float(size) / 2**20)


def unit() -> float:
    """CPU time of `UNIT_CALLS` RNEA derivatives [s]."""
    bench, best = Bench.of(43), float("inf")
    for _ in range(5):
        begun = time.process_time()
        count = rnea_derivatives(bench)
        best = min(best, (time.process_time() - begun) / count)
    return UNIT_CALLS * best


def compared(
    names: Sequence[str], checkouts: Mapping[str, Path], repeats: int, cold: bool
) -> dict[tuple[str, str], list[Cost]]:
    """Costs of every command of every checkout, in turn."""
    costs: dict[tuple[str, str], list[Cost]] = {(name, which): [] for name in names for which in checkouts}
    with tempfile.TemporaryDirectory() as folder:
        commands = {**COMMANDS, **{n: with_torque_noise(NOISY[n], Path(folder)) for n in names if n in NOISY}}
        for repeat in range(repeats if cold else repeats + 1):
            for name, which in costs:
                cache = Path(folder) / which
                if cold:
                    shutil.rmtree(cache, ignore_errors=True)
                cache.mkdir(mode=0o700, exist_ok=True)
                cost = measured(commands[name], checkouts[which], cache)
                if repeat or cold:
                    costs[name, which].append(cost)
    return costs


def main(arguments: list[str] | None = None) -> int:
    """Measure, show, and hold against what was stored; 1 where `--gate` finds a regression."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"{', '.join([*COMMANDS, *NOISY])}; usual: {', '.join(USUAL)}"
    )
    parser.add_argument("--base", type=Path, metavar="DIR", help="another checkout, run in turn with this one")
    parser.add_argument("--cold", action="store_true", help="with an empty cache each time")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="FILE", help="store the multiples")
    parser.add_argument("--gate", action="store_true", help="exit with 1 where one regressed against baseline.json")
    given = parser.parse_args(arguments)
    if unknown := sorted(set(given.names) - {*COMMANDS, *NOISY}):
        parser.error(f"there is no command '{unknown[0]}'; known: {', '.join([*COMMANDS, *NOISY])}")
    names = given.names or list(USUAL)
    checkouts = {"here": REPOSITORY} | ({"base": given.base.resolve()} if given.base else {})
    first = unit()
    costs = compared(names, checkouts, given.repeats, given.cold)
    each = min(first, unit())
    table = Table(title=f"whole commands, {'empty' if given.cold else 'filled'} cache, least of {given.repeats} runs")
    for title in ("command", "CPU [s]", "wall [s]", "memory [GiB]", "CPU / unit", "CPU / base", "wall / base"):
        table.add_column(title, justify="left" if title == "command" else "right")
    stored: dict[str, float] = {}
    for name in names:
        least = {
            w: Cost(*(min(getattr(c, f) for c in costs[name, w]) for f in vars(costs[name, w][0]))) for w in checkouts
        }
        here, base = least["here"], least.get("base")
        stored[f"{'cold' if given.cold else 'warm'}_{name}_over_rnea_derivatives"] = here.cpu / each
        ratio = ("", "") if base is None else (f"{here.cpu / base.cpu:.2f}", f"{here.wall / base.wall:.2f}")
        cells = (f"{here.cpu:.1f}", f"{here.wall:.1f}", f"{here.memory:.2f}", f"{here.cpu / each:.2f}", *ratio)
        table.add_row(name, *cells)
    console = Console(width=None if sys.stdout.isatty() else 120)
    console.print(table)
    console.print(f"unit: {UNIT_CALLS} RNEA derivatives at 43 coordinates, {each:.2f} s of CPU")
    if given.json is not None:
        given.json.write_text(json.dumps(stored, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    if not given.gate:
        return 0
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))
    found = regressions(stored, {key: baseline[key] for key in stored if key in baseline}, TOLERANCE)
    for line in found:
        console.print(f"regression: {line}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

"""Time the step, its derivatives and the sweeps beside Pinocchio, as ratios within one run.

    python benchmarks/run.py [--quick] [--json FILE] [--gate]

Absolute times depend on the machine; the ratios hardly do, so these are stored and compared with `baseline.json`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from rich.console import Console
from rich.table import Table
from workloads import RATIOS, SIZES, WORKLOADS, Bench, first_compile

BASELINE = Path(__file__).parent / "baseline.json"
TOLERANCE = 1.5
COMPILE_LIMIT = 20.0  # [s]


def measure(bench: Bench, repeats: int) -> dict[str, float]:
    """Median processor seconds per unit; the workloads take turns, so that a disturbance meets all of them."""
    samples: dict[str, list[float]] = {workload.name: [] for workload in WORKLOADS}
    for repeat in range(repeats + 1):
        for workload in WORKLOADS:
            start = time.process_time()
            count = workload.function(bench)
            spent = (time.process_time() - start) / count
            if repeat:  # the first turn warms up
                samples[workload.name].append(spent)
    return {name: statistics.median(values) for name, values in samples.items()}


def ratios(seconds: Mapping[int, Mapping[str, float]]) -> dict[str, float]:
    """The quotients of `RATIOS` for every size."""
    return {
        key.format(n=size): times[above] / times[below]
        for size, times in seconds.items()
        for key, (above, below) in RATIOS.items()
    }


def regressions(current: Mapping[str, float], baseline: Mapping[str, float], tolerance: float) -> list[str]:
    """What got worse: ratios more than `tolerance` times the baseline's, or missing, and compilation over its limit."""
    found = []
    for key, before in sorted(baseline.items()):
        now = current.get(key)
        if now is None:
            found.append(f"{key}: not measured")
        elif not key.endswith("_seconds") and now > tolerance * before:
            found.append(f"{key}: {now:.3g}, {now / before:.2f} times the baseline's {before:.3g}")
    for key, now in sorted(current.items()):
        if key.startswith("compile_") and now > COMPILE_LIMIT:
            found.append(f"{key}: {now:.1f} s, limit {COMPILE_LIMIT:g} s")
    return found


def show(console: Console, seconds: Mapping[int, Mapping[str, float]], compiles: Mapping[int, float]) -> None:
    """Print times and ratios of every workload."""
    table = Table(title="Time per unit and as a ratio, medians of one run")
    table.add_column("workload")
    table.add_column("unit")
    for size in seconds:
        table.add_column(f"n = {size} [us]", justify="right")
        table.add_column("/ RNEA'", justify="right")
        table.add_column("/ step", justify="right")
    for workload in WORKLOADS:
        cells = []
        for times in seconds.values():
            value = times[workload.name]
            cells += [f"{1e6 * value:.1f}", f"{value / times['rnea_derivatives']:.3g}", f"{value / times['step']:.3g}"]
        table.add_row(workload.name, workload.unit, *cells)
    console.print(table)
    for size, value in compiles.items():
        console.print(f"first compilation with an empty cache, n = {size}: {value:.1f} s, compiler included")
    overhead = ", ".join(
        f"{1e6 * times['trivial_call']:.2f} us (n = {size}: {times['trivial_call'] / times['rnea_derivatives']:.0%})"
        for size, times in seconds.items()
    )
    console.print(
        "RNEA' is Pinocchio's computeRNEADerivatives, called from Python: a call that computes next to nothing takes "
        f"{overhead} of it; nothing was subtracted. `step` runs inside a compiled rollout."
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the benchmark; 1 where `--gate` finds a regression."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few repeats, and no timing of the first compilation")
    parser.add_argument("--json", type=Path, metavar="FILE", help="store the ratios")
    parser.add_argument("--gate", action="store_true", help="exit with 1 where a ratio regressed against baseline.json")
    parser.add_argument("--tolerance", type=float, default=TOLERANCE, help=f"factor allowed by --gate ({TOLERANCE:g})")
    options = parser.parse_args(arguments)
    console = Console(width=None if sys.stdout.isatty() else 120)

    seconds, compiles = {}, {}
    for size in SIZES:
        bench = Bench.of(size)
        if not bench.step.is_compiled:
            console.print("there is no C compiler, so there is nothing to compare")
            return 1
        seconds[size] = measure(bench, 5 if options.quick else 25)
        if not options.quick:
            compiles[size] = first_compile(bench)
    show(console, seconds, compiles)
    results = ratios(seconds) | {f"compile_{size}_seconds": value for size, value in compiles.items()}
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    if not options.gate:
        return 0
    others = ("warm_", "cold_", *(("compile_",) if options.quick else ()))  # those of whole commands
    stored = json.loads(BASELINE.read_text(encoding="utf-8"))
    baseline = {key: value for key, value in stored.items() if not key.startswith(others)}
    found = regressions(results, baseline, options.tolerance)
    for line in found:
        console.print(f"regression: {line}")
    if not found:
        console.print(f"no ratio is more than {options.tolerance:g} times the baseline's")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())

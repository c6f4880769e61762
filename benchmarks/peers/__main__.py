"""The same recordings through this package and other tools.

    python benchmarks/peers [--cases NAME ...] [--tools NAME ...] [--seeds N] [--out FILE]
    python benchmarks/peers --table [--out FILE]
    python benchmarks/peers --against STORED --out FILE

The first adds to FILE (`results.json` beside this script) the figures of cases, tools and seeds that it lacks; delete
it to begin anew. The second writes table and chart of the documentation from it. The third exits with 1 if a figure of
this package in FILE is worse than in STORED, beyond a tolerance (`TOLERANCES` in `table.py`).

`pip install -e '.[peers]'` has what is needed but for opty, which needs an installed IPOPT (`pip install opty`). What
is not installed is left out and named, and so is the servo pendulum where its recordings are not beside the clone.
"""

from __future__ import annotations

import argparse
import importlib
import json
import platform
import resource
import sys
import tempfile
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
TOOLS = {
    "yid_ocp": ("with_yid_ocp", "yid-ocp", "yid_ocp"),
    "mujoco.sysid": ("with_sysid", "mujoco", "mujoco.sysid"),
    "least_squares": ("with_least_squares", "scipy", "scipy"),
    "friction ladder": ("with_friction_ladder", "scipy", "scipy"),
    "opty": ("with_opty", "opty", "opty"),
}  # module of the scripts, distribution, import


def cpu_seconds() -> float:
    """User and system time of this process and of what it has started [s]."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(entry.ru_utime + entry.ru_stime for entry in used)


def run_case(name: str, tools: list[str], seeds: int | None, entry: dict[str, Any]) -> Iterator[None]:
    """Add figures of every tool and seed that `entry` lacks, one at a time, or what a tool raises."""
    from cases import CASES
    from mujoco_models import SETTERS
    from score import score, user_lines, yaml_lines

    case = CASES[name]
    with tempfile.TemporaryDirectory() as folder:
        for seed in case.seeds[:seeds]:
            trial = None
            for tool in tools:
                by_case = importlib.import_module(TOOLS[tool][0]).BY_CASE
                done = [
                    run["seed"] for key, own in entry["tools"].items() if key.startswith(tool) for run in own["runs"]
                ]
                if name not in by_case or seed in done:
                    continue
                trial = trial or case.trial(seed, Path(folder) / str(seed))
                entry["truth"] = dict(trial.truth)
                before = cpu_seconds()
                try:
                    answers = by_case[name](trial)
                except Exception as error:  # what a tool raises is its answer
                    answers = f"{type(error).__name__}: {error}"
                spent = cpu_seconds() - before
                lines = user_lines(TOOLS[tool][0], by_case[name].__name__)
                lines += yaml_lines(trial.config) if tool == "yid_ocp" else 0
                if tool in ("mujoco.sysid", "least_squares") and name in SETTERS:
                    lines += user_lines("mujoco_models", SETTERS[name].__name__)
                for part, answer in (answers if isinstance(answers, dict) else {"": answers}).items():
                    own = entry["tools"].setdefault(f"{tool} {part}".strip(), {"runs": []})
                    own["lines"] = lines
                    failed = isinstance(answer, str)
                    figures = {"failed": answer} if failed else {"cpu": round(spent, 2), **score(trial, answer)}
                    own["runs"].append({"seed": seed, **figures})
                print(f"{name}, seed {seed}: {tool}, {spent:.1f} s of CPU time", file=sys.stderr, flush=True)
                yield


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", help="all when absent")
    parser.add_argument("--tools", nargs="+", choices=list(TOOLS), default=list(TOOLS))
    parser.add_argument("--seeds", type=int, help="at most so many of each case")
    parser.add_argument("--out", type=Path, default=HERE / "results.json")
    parser.add_argument("--table", action="store_true", help="write table and chart of the documentation, and stop")
    parser.add_argument("--against", type=Path, help="stored results with which FILE is compared, and stop")
    chosen = parser.parse_args()
    known = json.loads(chosen.out.read_text(encoding="utf-8")) if chosen.out.exists() else {"versions": {}, "cases": {}}
    if chosen.table:
        from table import write_documentation

        write_documentation(known)
        return 0
    if chosen.against:
        from table import worse_figures

        stored = json.loads(chosen.against.read_text(encoding="utf-8"))
        worse = worse_figures(known, stored)
        print("\n".join(worse) or "no figure is worse than the stored one")
        for name in (each for each in stored["cases"] if each not in known["cases"]):
            print(f"not compared: {name}, {known.get('left_out', {}).get(name, 'which was not asked for')}")
        return int(bool(worse))
    from cases import CASES, SERVO_FOLDER

    tools = []
    for tool in chosen.tools:
        try:
            importlib.import_module(TOOLS[tool][2])
            importlib.import_module(TOOLS[tool][0])
            known["versions"][TOOLS[tool][1]] = version(TOOLS[tool][1])
            tools.append(tool)
        except (ImportError, PackageNotFoundError) as error:
            print(f"left out: {tool} is not installed ({error})", file=sys.stderr)
    known["versions"]["python"] = platform.python_version()
    known["left_out"] = {}
    for name in chosen.cases or CASES:
        if CASES[name].needs_shared_recordings and not SERVO_FOLDER.is_dir():
            known["left_out"][name] = f"whose recordings are not in {SERVO_FOLDER}"
            print(f"left out: {name}, {known['left_out'][name]}", file=sys.stderr)
            continue
        case = CASES[name]
        entry = known["cases"].setdefault(
            name, {"title": case.title, "made_by": case.made_by, "truth": {}, "tools": {}}
        )
        known["cases"] = {key: known["cases"][key] for key in CASES if key in known["cases"]}
        for _ in run_case(name, tools, chosen.seeds, entry):
            chosen.out.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    chosen.out.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

"""What each rule of a diagnosis is worth: finished cases judged again, one threshold at its neutral value.

    python benchmarks/ablation.py DIR [--set KEY=VALUE ...]

DIR is the folder of a finished `yid-ocp blind`. Nothing is refitted: a case whose verdict would need another refit is
counted as not judged. A rule that changes nothing here can go, unless another ensemble needs it.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from yid_ocp.workflow.blind import rescore_blind

NEUTRAL = {
    "significance_level": 0.05,
    "gap_significance_level": 0.01,
    "min_excess_chi2_per_dof": 0.0,
    "min_samples_per_unknown": 1e-9,
    "signature_overlap": 1.0,
    "n_refit_pairs": 0,
    "max_effects": 1,
    "min_z": 0.0,
    "min_gap_closed": 0.0,
    "min_log_bayes_factor": 1.92,  # that of a 95 % interval
    "prior_range_margin_in_widths": 1e9,
    "transfer_rtol": 1e9,
    "always_allowed_transfer_z": 1e9,
    "min_explained_fraction": 0.0,
}
"""Values at which a threshold asks for nothing, or for as little as makes sense."""


def changes(folder: Path, settings: Sequence[str]) -> Counter[str]:
    """How many cases change their verdict or effects, and which way."""
    found = rescore_blind(folder, folder / "rescored", settings).result
    count: Counter[str] = Counter(cases=found["cases"], not_judged=found["not_judged"])
    for own in found["rescored"]["changed"]:
        before, after = own["right"]
        if not own["now"].startswith("not_judged"):
            count["lost" if before > after else "gained" if after > before else "otherwise"] += 1
    return count


def main() -> None:
    parser = argparse.ArgumentParser(description="Judge a finished blind proof again, one rule off at a time.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="for every row")
    arguments = parser.parse_args()
    print("| threshold | neutral | right, then wrong | wrong, then right | otherwise changed | not judged | cases |")
    print("|---|---|---|---|---|---|---|")
    for name, value in {"(as set)": math.nan, **NEUTRAL}.items():
        own = [f"diagnosis.{name}={value}"] if math.isfinite(value) else []
        count = changes(arguments.folder, [*arguments.set, *own])
        numbers = [count[key] for key in ("lost", "gained", "otherwise", "not_judged", "cases")]
        print(f"| {name} | {value:g} | {' | '.join(map(str, numbers))} |")


if __name__ == "__main__":
    main()

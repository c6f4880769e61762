"""Diagnose cases of one kind and one experiment of a blind ensemble, and print every answer.

    python benchmarks/blind_cases.py [CONFIG.VARIATION] [--category null] [--multiple 10] [--brisk] [--cases 10]

Where a whole ensemble raises false alarms or misses effects, this shows at what: CONFIG is `diagnosis` or
`dual_arm_vision`, VARIATION one of `EXPERIMENT_VARIATIONS`, the category one of `BLIND_CASE_CATEGORY_SHARES`. The cases
are those of no ensemble that sets or tests a threshold.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from yid_ocp.diagnosis.blind import (
    BLIND_CASE_CATEGORY_SHARES,
    BLIND_ENSEMBLE_PURPOSES,
    PlannedBlindCase,
    diagnose_unlabelled_case,
)
from yid_ocp.workflow.blind import EXPERIMENT_VARIATIONS, _BlindExperiment

CONFIGS = Path(__file__).resolve().parents[1] / "yid_ocp" / "data" / "defaults"


def main() -> None:
    parser = argparse.ArgumentParser(description="Diagnose cases of one experiment of a blind ensemble.")
    what = f"CONFIG.VARIATION; variations: {', '.join(EXPERIMENT_VARIATIONS)}"
    parser.add_argument("experiment", nargs="?", default="diagnosis.bare_arm_efforts", help=what)
    parser.add_argument("--category", default="null", choices=list(BLIND_CASE_CATEGORY_SHARES))
    parser.add_argument("--multiple", type=float, help="of the detectable size of one effect")
    parser.add_argument("--brisk", action="store_true", help="three times the acceleration")
    parser.add_argument("--cases", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--config", type=Path, help="file; default: the example of this name")
    given = parser.parse_args()
    config, variation = given.experiment.split(".")
    file = given.config or CONFIGS / f"{config}.yaml"
    experiment = _BlindExperiment(file, variation, given.seed, BLIND_ENSEMBLE_PURPOSES[1])
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder) / "first.h5"
        experiment._write_first_recording(first)
        run, ensemble = experiment._build_ensemble(first)
        print("| case | injected | verdict | effects, with those that are equivalent | chi2/n | held out | CPU [s] |")
        print("|---|---|---|---|---|---|---|")
        for number in range(given.cases):
            planned = PlannedBlindCase(number, given.experiment, given.category, given.multiple, given.brisk)
            case, label = ensemble.draw_recordings_and_ground_truth(planned)
            begun = time.process_time()
            found = diagnose_unlabelled_case(ensemble, case, run.diagnosis)
            sets = (" or ".join(e.label for e in own.equivalent_effects) for own in found.accepted_selected_effects)
            sizes = f"{found.nominal_test.chi2_per_dof:.3g} | {found.nominal_held_out_test.chi2_per_dof:.3g}"
            injected, named = ", ".join(e.label for e in label.injected) or "-", "; ".join(sets) or "-"
            spent = time.process_time() - begun
            print(f"| {number} | {injected} | {found.verdict} | {named} | {sizes} | {spent:.0f} |", flush=True)


if __name__ == "__main__":
    main()

"""What each rule of a diagnosis is worth: finished cases judged again, one rule at a time switched off.

    python benchmarks/ablation.py DIR ... [--set KEY=VALUE ...]

DIR is the folder of a finished `yid-ocp blind`, or that of `benchmarks/unchanged.py --keep`. Nothing is refitted: a
case whose verdict would need another refit is counted as not judged, so rules that steer the search are not tested
fully. A rule that changes nothing here can go, unless other recordings need it.
"""

from __future__ import annotations

import argparse
import inspect
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.diagnosis import select, verdict
from yid_ocp.diagnosis.blind_scores import rejudge_diagnosis_evidence
from yid_ocp.files import read_input_json
from yid_ocp.workflow.blind import rescore_blind

NEUTRAL = {
    "significance_level": 0.05,
    "gap_significance_level": 0.01,
    "min_excess_chi2_per_dof": 0.0,
    "signature_overlap": 1.0,
    "n_refit_pairs": 0,
    "max_effects": 1,
    "min_z": 0.0,
    "min_log_bayes_factor": 1.92,  # that of a 95 % interval
    "prior_range_margin_in_widths": 1e9,
    "min_explained_fraction": 0.0,
    "min_closure": 0.0,
}
"""Values at which a threshold asks for nothing, or for as little as makes sense."""
CONSTANTS = {
    "_LOSS_RTOL": (select, 1e-12),
    "_MIN_CHI2_FRACTION": (select, 0.0),
    "_LOG_ODDS_FACTOR": (select, 1.0),
    "_MIN_FIRST_PART": (select, 0.0),
    "_MIN_FURTHER_PART": (select, 0.0),
    "_SET_PROBABILITY": (select, 1.0),
}
"""Constants of modules, with their neutral values."""
CRITERIA = {
    "mean log ratio of blocks": (select, "_distance_in_prediction", "float(ratios.mean())", "-math.inf"),
    "at most sqrt(2N)": (select, "_near_best_models", "math.sqrt(2 * samples)", "math.inf"),
    "implausible models": (select, "_near_best_models", "excess_chi2_per_sample <= most", "chi2_per_sample < -1"),
    "fewest parameters first": (select, "_near_best_models", "(fit.total_effect_parameter_count, ", "(0.0, "),
    "plausible second effects": (select, "_plausible_beside", "fit.implausible_parameters(effect, limits)", "False"),
    "significant effects": (select, "_is_needed", "is_clear and all(", "is_clear or not all("),
    "small gaps": (verdict, "_explained_fraction", "1.0 if max(is_left)", "1.0 if math.inf"),
    "size is determined": (verdict, "_reasons_against", "bool(said.undetermined_sizes(limits))", "False"),
}
"""Conditions in code: module, function, the text and what replaces it."""


@contextmanager
def switched_off(name: str) -> Iterator[list[str]]:
    """Switch a rule off; gives the settings that do so, if it is a threshold."""
    if name in CONSTANTS:
        module, value = CONSTANTS[name]
        with mock.patch.object(module, name, value):
            yield []
    elif name in CRITERIA:
        module, function, old, new = CRITERIA[name]
        source = inspect.getsource(getattr(module, function))
        if source.count(old) != 1:
            raise SystemExit(f"{name}: {function} has no longer one place with `{old}`")
        made: dict[str, Any] = {}
        exec(source.replace(old, new), vars(module), made)
        with ExitStack() as patches:
            for own in [m for m in sys.modules.values() if vars(m).get(function) is getattr(module, function)]:
                patches.enter_context(mock.patch.object(own, function, made[function]))
            yield []
    else:
        yield [f"diagnosis.{name}={NEUTRAL[name]}"] if name in NEUTRAL else []


def changes(folder: Path, settings: Sequence[str]) -> Counter[str]:
    """How many cases change their verdict or effects, and which way."""
    if not (folder / "answers").is_dir():
        return changes_of_known_cases(folder, settings)
    found = rescore_blind(folder, folder / "rescored", settings).result
    count: Counter[str] = Counter(cases=found["cases"], not_judged=found["not_judged"])
    for own in found["rescored"]["changed"]:
        before, after = own["right"]
        if not own["now"].startswith("not_judged"):
            count["lost" if before > after else "gained" if after > before else "otherwise"] += 1
    return count


def changes_of_known_cases(folder: Path, settings: Sequence[str]) -> Counter[str]:
    """How many cases of a folder of tasks have another verdict or other effects than with all rules."""
    wanted = load_config(None, settings, SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME).diagnosis
    names = [text.partition("=")[0].removeprefix("diagnosis.") for text in settings]
    changed = {name: getattr(wanted, name) for name in names}
    count: Counter[str] = Counter()
    for file in sorted(folder.glob("*.json")):
        found = read_input_json(file).get("value") or {}
        if evidence := found.get("evidence"):
            judged = rejudge_diagnosis_evidence(evidence, changed)
            count["cases"] += 1
            if judged["verdict"] == "not_judged":
                count["not_judged"] += 1
            elif (judged["verdict"], named(judged)) != (found["said"]["verdict"], named(found["said"])):
                count["otherwise"] += 1
    return count


def named(result: dict[str, Any]) -> set[str]:
    """Labels of all effects that a result names, alone or in sets."""
    return {f"{own['kind']}@{own['location']}" for part in (result["effects"], *result["confusable"]) for own in part}


def main() -> None:
    parser = argparse.ArgumentParser(description="Judge finished cases again, one rule off at a time.")
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="for every row")
    arguments = parser.parse_args()
    print("| rule that is off | right, then wrong | wrong, then right | otherwise changed | not judged | cases |")
    print("|---|---|---|---|---|---|")
    for name in ("(none)", *NEUTRAL, *CONSTANTS, *CRITERIA):
        count: Counter[str] = Counter()
        with switched_off(name) as own:
            for folder in arguments.folders:
                count += changes(folder, [*arguments.set, *own])
        numbers = [count[key] for key in ("lost", "gained", "otherwise", "not_judged", "cases")]
        print(f"| {name} | {' | '.join(map(str, numbers))} |")


if __name__ == "__main__":
    main()

"""Shorten the answers of a finished slice of a blind ensemble to what its scores need, for `benchmarks/blind_slices/`.

    python benchmarks/reduce_blind_slice.py FOLDER/slice-1-of-6/slice.json benchmarks/blind_slices/NAME.json

What only `--rescore` reads is left out, which takes 0.3 MB instead of some 10 MB a slice. `yid-ocp blind --join` of the
version that made the answers takes the file, in a folder of its own, as `slice.json`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

RESULT_KEYS = ("verdict", "probability", "effects", "confusable", "seconds", "statistics", "reason")


def shortened(result: dict[str, Any]) -> dict[str, Any]:
    """What scores read of the result of a diagnosis."""
    kept = {key: result[key] for key in RESULT_KEYS if key in result}
    gap, law = result["gap"], result.get("law")
    if "before" in gap:  # not so where a case could not be examined
        before = {key: gap["before"][key] for key in ("chi2_per_dof", "p_value") if key in gap["before"]}
        kept["gap"] = {"before": before, "closure": gap["closure"], "closure_ci": gap.get("closure_ci")}
    else:
        kept["gap"] = gap
    added = [(own["kind"], own["location"]) for own in result["effects"]]

    def is_kept(own: dict[str, Any]) -> bool:
        """Whether a candidate was fitted."""
        return own.get("closure") is not None or (own["kind"], own["location"]) in added

    kept["where"] = [{"location": place["location"]} for place in result["where"]]
    kept["which"] = [
        {key: own[key] for key in ("kind", "location")} | {"parameters": own["parameters"] if is_kept(own) else {}}
        for own in result["which"]
    ]
    kept["law"] = None if law is None else {key: law[key] for key in ("location", "depends_on", "closure")}
    return kept


def main() -> None:
    parser = argparse.ArgumentParser(description="Shorten the answers of a slice of a blind ensemble.")
    parser.add_argument("slice", type=Path, help="slice.json of a finished slice")
    parser.add_argument("out", type=Path, help="file to write")
    given = parser.parse_args()
    content = json.loads(given.slice.read_text(encoding="utf-8"))
    folders = [word for word in content["command"].split() if Path(word).is_absolute()]
    content["command"] = " ".join(word for word in content["command"].split() if word not in folders)
    for answer in content["answers"]:
        answer |= {"evidence": None, "result": shortened(answer["result"])}
    text = json.dumps(content, separators=(",", ":"), ensure_ascii=False)
    given.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()

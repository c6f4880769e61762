"""The documentation's table and chart of `results.json`."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
PAGE = REPOSITORY / "docs" / "reference" / "comparison_results.md"
CHART = REPOSITORY / "docs" / "pictures" / "peers.png"
BEGIN, END = "<!-- peers: begin -->", "<!-- peers: end -->"
HELD_OUT = {"springs": (1e3, "mm"), "servo": (1.0, "rad")}  # scale and unit; torques elsewhere
MARKERS = "osD^v<>PX*"
HEADER = (
    "tool", "confident estimates", "median of the largest error", "confident but wrong",
    "intervals that contain the truth", "held out", "CPU [s]", "lines",
)  # fmt: skip
# by which fraction a figure may be worse than the stored one; chosen, as other machines round differently
TOLERANCES = {"error": 0.1, "held_out": 0.1, "wrong": 0.0, "failed": 0.0, "known": 0.0, "holding": 0.0}
MADE_BY = {
    "MuJoCo": "recordings by MuJoCo",
    "real": "real recordings; the true values are not known",
    "closed form": "recordings from a formula",
}


def figures(runs: list[dict[str, Any]], truth: Mapping[str, float]) -> dict[str, float | None]:
    """Figures of one tool over the seeds of a case, none where they do not exist."""
    done = [run for run in runs if "failed" not in run]
    if not done:
        return {}
    found: dict[str, float | None] = {
        "held_out": median(run["held_out"] for run in done),
        "cpu": min(run["cpu"] for run in done),
        "failed": len(runs) - len(done),
    }
    if not truth:
        return found
    errors = [max(run["errors"][name] for name in run["known"]) for run in done if run["known"]]
    all_errors = median(max(run["errors"].values()) for run in done)
    found |= {
        "known": sum(len(run["known"]) for run in done),
        "of": len(truth) * len(done),
        "error": median(errors) if errors else None,
        "error_of_all": all_errors,
    }
    if "stated" in done[0]:
        found["wrong"] = sum(len(run["known_but_outside"]) for run in done)
        found["holding"], found["stated"] = (sum(run[key] for run in done) for key in ("holding", "stated"))
    return found


def worse_figures(known: Mapping[str, Any], stored: Mapping[str, Any], tool: str = "yid_ocp") -> list[str]:
    """Figures of one tool that are worse than stored ones by more than `TOLERANCES`, over the seeds that both have."""
    found = []
    for case in (name for name in known["cases"] if name in stored["cases"]):
        truth = stored["cases"][case]["truth"]
        both = [results["cases"][case]["tools"].get(tool, {"runs": []})["runs"] for results in (known, stored)]
        seeds = set.intersection(*({run["seed"] for run in runs} for runs in both))
        now, before = (figures([run for run in runs if run["seed"] in seeds], truth) for runs in both)
        found += [] if now else [f"{case}: no figures"]
        for name, tolerance in TOLERANCES.items():
            new, old = now.get(name), before.get(name)
            rise = 0.0 if new is None or old is None else new - old
            if (-rise if name in ("known", "holding") else rise) > tolerance * (old or 0.0):
                found.append(f"{case}: {name} is {new:.4g}, stored {old:.4g}")
    return found


def rows(case: str, entry: Mapping[str, Any]) -> list[list[str]]:
    scale, unit = HELD_OUT.get(case, (1.0, "N m"))
    lines = []
    most = max(len(own["runs"]) for own in entry["tools"].values())
    for tool, own in entry["tools"].items():
        found, count = figures(own["runs"], entry["truth"]), len(own["runs"])
        name = f"`{tool}`" if count == most else f"`{tool}` ({count} repetitions)"
        if not found:
            lines.append([name, *["failed"] * 5, "", str(own.get("lines", ""))])
            continue
        cells = ["-"] * 4
        if entry["truth"]:
            error = found["error"]
            over_all = f"none; {100 * found['error_of_all']:.2g} % over all parameters"
            shown = over_all if error is None else f"{100 * error:.2g} %"
            failed = f"; {found['failed']} runs failed" if found["failed"] else ""
            cells[:2] = [f"{found['known']} of {found['of']}{failed}", shown]
            cells[2:] = ["no intervals"] * 2
            if "wrong" in found:
                cells[2:] = [
                    str(found["wrong"]),
                    f"{found['holding']} of {found['stated']}" if found["stated"] else "none stated",
                ]
        last = [f"{scale * found['held_out']:.2g} {unit}", f"{found['cpu']:.2g}", str(own["lines"])]
        lines.append([name, *cells, *last])
    return lines


def markdown(known: Mapping[str, Any]) -> str:
    """One table for each case."""
    versions = ", ".join(f"{name} {number}" for name, number in sorted(known["versions"].items()))
    parts = [f"Versions: {versions}."]
    for case, entry in known["cases"].items():
        seeds = max(len(own["runs"]) for own in entry["tools"].values())
        real = entry["made_by"] == "real"
        what = "kinds of motion, each held out once" if real else "repetitions"
        parts.append(
            f"**{entry['title'][0].upper()}{entry['title'][1:]}** ({seeds} {what}; {MADE_BY[entry['made_by']]})"
        )
        table = [HEADER, ["---"] * len(HEADER), *rows(case, entry)]
        if not entry["truth"]:
            table = [[row[0], *row[5:]] for row in table]
        parts.append("\n".join(f"| {' | '.join(row)} |" for row in table))
    parts += [f"**Left out:** {name}, {why}" for name, why in known.get("left_out", {}).items()]
    return "\n\n".join(parts)


def write_documentation(known: Mapping[str, Any]) -> None:
    """Renew the table between its marks in the page, and the chart."""
    page = PAGE.read_text(encoding="utf-8")
    text = f"{BEGIN}\n\n{markdown(known)}\n\n{END}"
    PAGE.write_text(re.sub(f"{BEGIN}.*{END}", lambda _: text, page, flags=re.DOTALL), encoding="utf-8")
    draw(known, CHART)


def draw(known: Mapping[str, Any], path: Path) -> None:
    """Estimates that are confident but wrong, held-out errors over the least of each case, and CPU time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    cases = known["cases"]
    tools = list(dict.fromkeys(tool for entry in cases.values() for tool in entry["tools"]))
    figure, axes = plt.subplots(1, 3, figsize=(12, 0.6 * len(cases) + 1.9), sharey=True, layout="constrained")
    for place, entry in enumerate(cases.values()):
        found = {tool: figures(own["runs"], entry["truth"]) for tool, own in entry["tools"].items()}
        found = {tool: own for tool, own in found.items() if own}
        least = min(own["held_out"] for own in found.values())
        for tool, own in found.items():
            at = tools.index(tool)
            style = {"color": f"C{at}", "marker": MARKERS[at % len(MARKERS)], "ls": "", "ms": 7, "label": tool}
            y = place + 0.09 * (at - (len(tools) - 1) / 2)
            share = 100 * own["wrong"] / own["known"] if own.get("known") and "wrong" in own else None
            for axis, x in zip(axes, (share, own["held_out"] / least, own["cpu"]), strict=True):
                if x is not None:
                    axis.plot(x, y, **style)
    axes[0].set_yticks(range(len(cases)), [entry["title"] for entry in cases.values()])
    axes[0].set_ylim(len(cases) - 0.5, -0.5)
    titles = ("confident but wrong [%]", "held-out error / smallest error of this case", "CPU time [s]")
    for axis, title in zip(axes, titles, strict=True):
        axis.set_xlabel(title)
        axis.grid(alpha=0.3)
    axes[1].set_xscale("log")
    axes[2].set_xscale("log")
    handles = {text: line for axis in axes for line, text in zip(*axis.get_legend_handles_labels(), strict=True)}
    shown = {tool: handles[tool] for tool in tools if tool in handles}
    figure.legend(shown.values(), shown.keys(), loc="outside upper center", ncols=5, frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)

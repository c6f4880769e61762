"""Sentences that describe a diagnosis, and the recommended next experiment."""

from __future__ import annotations

import math
from collections.abc import Sequence

from yid_ocp.diagnosis.baseline import Since
from yid_ocp.diagnosis.carry_over import disagreeing
from yid_ocp.diagnosis.counterfactual import Counterfactual
from yid_ocp.diagnosis.events import Event, Events
from yid_ocp.diagnosis.finding import Finding
from yid_ocp.diagnosis.hypotheses import Cut
from yid_ocp.diagnosis.localise import Place, main_places
from yid_ocp.diagnosis.refit import Fit
from yid_ocp.diagnosis.screening import Visibility
from yid_ocp.diagnosis.select import Added
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.diagnosis.verdict import assumptions, needed
from yid_ocp.effects import EffectBase
from yid_ocp.effects.base import ASPECTS
from yid_ocp.problem.null_test import NullTest

MOVED = 0.1
"""Relative change from which a nominal parameter is named."""
ROOM = 0.25
"""Part of its range by which an amplitude may leave it unnoticed."""
SIDES = {
    "plant": ", in the mechanics rather than in what sensors read",
    "sensor": ", in what sensors read",
    "either": ", in the mechanics or in what the effort sensor reads, which efforts alone do not tell apart",
}
DIFFER = 0.01
"""Significance below which several runs of a baseline differ."""
NOWHERE = ("world", "clock", "camera", "object", "base")
"""Locations that cannot be moved by themselves."""
NEXT = {
    "insufficient_data": "Record longer and larger motions; more of the object has to be seen.",
    "separate": "Vary {aspects} independently of each other, over a wide range, in one recording.",
    "places": "Move so that {places} work one at a time, or measure a point between them.",
    "vary": "Vary {aspects} over a wider range.",
    "other": "Record other motions, faster and larger.",
    "unknown": "Move {place} alone, slowly and fast, and hold it still in several postures.",
    "unseen": "None is needed; these motions could not have shown {unseen}.",
    "no_gap": "None is needed.",
    "effect": "Repeat with other motions to see whether the effect's parameters stay.",
}
"""Texts of the recommended next experiment, by situation."""


NAMELESS = {
    "nothing": "No known effect explains it.",
    "none": "No known effect explains it (the best, {best}, is not sure to be there and to close a part).",
    "unsure": "{names} close{s} {closure:.3g} % of it, but not surely: at least {low:.3g} %, where {least:.3g} % are "
    "asked.",
    "little": "{names} explain{s} {explained:.3g} % of what unknown forces, offsets and biases explain, and surely "
    "close{s} {low:.3g} % on held-out motions; {enough:.3g} % {asked}.",
    "stand_in": "{names} imitate{s} it (closing {closure:.3g} % on held-out motions) and {are} not its cause: {apart}.",
}
"""Sentences on why the verdict is unknown, by `verdict.Reason`."""


def separating(rivals: Sequence[EffectBase]) -> str:
    """Return the experiment that separates indistinguishable effects, from what their equations depend on."""
    said = list(dict.fromkeys(effect.depends_on for effect in rivals if effect.depends_on))
    aspects = sorted(said, key=lambda aspect: ASPECTS.index(aspect) if aspect in ASPECTS else len(ASPECTS))
    places = list(dict.fromkeys(effect.location for effect in rivals))
    if len(aspects) > 1:
        return NEXT["separate"].format(aspects=" and ".join(aspects))
    if len(places) > 1:
        return NEXT["places"].format(places=" and ".join(places))
    return NEXT["vary"].format(aspects=aspects[0]) if aspects else NEXT["other"]


def next_experiment(verdict: str, added: Sequence[Added], where: Sequence[Place], unseen: Sequence[str]) -> str:
    """Return the recommended next recording as text."""
    if verdict == "insufficient_data":
        return NEXT["insufficient_data"]
    rivals = next((entry.rivals for entry in added if len(entry.rivals) > 1), ())
    if rivals:
        return separating(rivals)
    if verdict == "unknown" and where and where[0].share > 0 and where[0].location not in NOWHERE:
        return NEXT["unknown"].format(place=where[0].location)
    if verdict == "unknown":
        return NEXT["other"]
    if verdict == "no_gap" and unseen:
        return NEXT["unseen"].format(unseen=", ".join(unseen[:4]) + (", ..." if len(unseen) > 4 else ""))
    return NEXT["no_gap"] if verdict == "no_gap" else NEXT["effect"]


def shortage(verdict: str, before: NullTest, unknowns: int, seen: Sequence[Visibility], limits: Thresholds) -> str:
    """Return why the data are insufficient; empty if they suffice.

    Parameters
    ----------
    verdict : str
    before : NullTest
        Of the nominal model, on the recordings to estimate on.
    unknowns : int
    seen : sequence of Visibility
    limits : Thresholds
    """
    if verdict != "insufficient_data":
        return ""
    if not any(entry.visible for entry in seen):
        return "no candidate of the size that one would expect would show in these recordings."
    return (
        f"{before.degrees:.0f} effective samples for {unknowns} unknowns, at least "
        f"{limits.samples_per_unknown * unknowns:.0f} are needed; record longer or free fewer parameters."
    )


def cut_short(cut: Cut) -> str:
    """Return the sentence on how far the nominal model follows a held-out recording."""
    if cut.kept == 0:
        return f"The nominal model cannot follow {cut.recording} at all, which is left out."
    return (
        f"The nominal model follows {cut.recording} for {cut.kept:.3g} of {cut.whole:.3g} s only; the rest is left out."
    )


def sentences(finding: Finding) -> str:
    """Return the summary text of a diagnosis."""
    text = [_gap(finding)]
    if finding.verdict not in ("insufficient_data", "no_gap"):
        text.append(_places(finding))
    if finding.effects:
        text += _effects(finding)
    elif finding.verdict == "unknown":
        text.append(_nameless(finding))
    text += [cut_short(cut) for cut in finding.cuts]
    if finding.since is not None:
        text.append(_since(finding.since, bool(finding.effects)))
    if finding.counterfactual is not None:
        text += _counterfactual(finding.counterfactual)
    if finding.in_blocks:
        why = "No held-out recording is left" if finding.cuts else "Only one set of recordings was given"
        text.append(f"{why}: alternate blocks of what is estimated on were held out.")
    text.append(event_sentences(finding.events))
    text.append(f"Next experiment: {finding.next_experiment}")
    return " ".join(part for part in text if part)


def _gap(finding: Finding) -> str:
    """Whether there is one."""
    held, first = finding.held_out_before, finding.before
    p = min(first.p_value, held.p_value)
    if finding.verdict == "insufficient_data":
        return f"The data do not suffice: {finding.message}"
    if finding.verdict == "no_gap":
        return (
            f"There is no gap to speak of (chi2 per degree of freedom {first.chi2_per_dof:.3g}, held out "
            f"{held.chi2_per_dof:.3g}; p = {p:.2g})."
        )
    best = min(finding.scores, key=lambda score: score.p_value, default=None)
    along = ""
    if p >= finding.limits.level and best is not None:
        p, along = min(1.0, best.p_value * len(finding.scores)), f" along what {best.effect.label} would do"
    small = f"= {p:.2g}" if p > 1e-12 else "< 1e-12"
    return f"The gap is real (held-out chi2 per degree of freedom {held.chi2_per_dof:.3g}, p {small}{along})."


def _places(finding: Finding) -> str:
    """Where it lies; empty where nothing says so."""
    shares = [(_one_of(p), round(100 * p.share)) for p in main_places(finding.where)]
    named = " and ".join(f"{place} ({percent} %)" for place, percent in shares if percent)
    side = "" if finding.smoothed is None else SIDES.get(finding.smoothed.side, "")
    if named:
        return f"It lies in {named}{side}."
    return "These data do not tell where it lies." if shares else ""


def _nameless(finding: Finding) -> str:
    """Why no effect is named, with the numbers that say so."""
    if finding.reason == "none":
        best = finding.fits[0] if finding.fits else None
        return NAMELESS["nothing"] if best is None else NAMELESS["none"].format(best=best.effects[0].label)
    names = " and ".join(entry.effect.label for entry in finding.added)
    apart = [
        f"{entry.effect}.{entry.name} is {entry.value:.3g} ± {entry.std:.2g} {entry.unit} on the recordings to "
        f"estimate on and {entry.again:.3g} ± {entry.again_std:.2g} on the held-out ones"
        for entry in disagreeing(finding.carried)
    ]
    count = assumptions(finding.added)
    return NAMELESS[finding.reason].format(
        names=names,
        s="s" if len(finding.added) == 1 else "",
        are="is" if len(finding.added) == 1 else "are",
        closure=100 * finding.closure.value,
        low=100 * finding.closure.low,
        least=100 * finding.limits.closure,
        explained=100 * finding.explained,
        asked=f"of the former are asked of {count} assumptions" if count > 1 else "of either are asked",
        enough=100 * needed(finding.added, finding.limits),
        apart="; ".join(apart[:2]),
    )


def _one_of(place: Place) -> str:
    """A place and those that the data cannot tell from it."""
    return " or ".join([place.location, *place.also])


def _effects(finding: Finding) -> list[str]:
    """What was added, what it closes, what it cannot be told from, and what remains."""
    last, total = finding.last, finding.closure
    names = "; ".join(f"{e.label} with {_figures(e, last)}" for e in finding.effects)
    verb = "closes" if len(finding.effects) == 1 else "together close"
    text = [
        f"{names} {verb} {100 * total.value:.3g} % of it on held-out motions "
        f"(95 % interval {100 * total.low:.3g} to {100 * total.high:.3g} %)."
        if total.low > finding.limits.closure
        else f"With {names} the held-out motions are far more likely (more than {math.exp(finding.limits.worth):.0f} "
        "times), although so little of chi2 tells of it that no part of the gap can be given."
    ]
    for entry in finding.added:
        others = [r.label for r in entry.rivals if r.label != entry.effect.label]
        if others:
            text.append(f"Not separable from {entry.effect.label}: {', '.join(others)}.")
    odd = [said for effect in finding.effects for said in _out_of_range(effect, last)]
    if odd:
        text.append(f"Beyond what one would expect, and so perhaps standing in for something else: {', '.join(odd)}.")
    text.append(_remains(finding))
    moved = [a for a in finding.absorbed if abs(a.after - a.before) > MOVED * max(abs(a.before), 1e-9)]
    if moved:
        steps = (f"{a.name} goes from {a.before:.3g} to {a.after:.3g}" for a in moved[:6])
        text.append(f"With it {', '.join(steps)}.")
    return text


def _since(found: Since, effects: bool) -> str:
    """What has moved since the baseline, and what a baseline that explained little is worth."""
    several = len(found.runs) > 1
    said = "Against the baseline" + (f" of {len(found.runs)} runs" if several else "")
    if found.changed:
        moved = (
            f"{e.name} is {e.now:.3g} ± {e.now_std:.2g} {e.unit} where it was {e.before:.3g} ± {e.before_std:.2g}"
            for e in found.changed[:4]
        )
        text = f"{said}, {'even with that ' if effects else ''}{', '.join(moved)}."
    else:
        seen = [entry for entry in found.parameters if entry.score is not None]
        text = f"{said}, " + (
            "no parameter has changed." if seen else "these recordings say nothing of the parameters."
        )
    if several and found.p_value < DIFFER:
        text += f" The runs of the baseline differ among themselves (p = {found.p_value:.2g}); their ± is wider for it."
    if not found.explains:
        text += (
            " The model did not explain the baseline's recordings, so its ± counts that misfit and may be too small."
        )
    return text


def _counterfactual(found: Counterfactual) -> list[str]:
    """Whether taking the effects away predicts the world without them, and adding them the world with them."""
    text = []
    parts = (
        ("Taken away again, it predicts", found.removed, "made without it", "as it was fitted without a diagnosis"),
        ("Added to what was known without it, it predicts", found.added, "made with it", "without it"),
    )
    for begin, part, made, rival in parts:
        if part.message:
            text.append(f"What was {made} could not be predicted ({part.message}).")
            continue
        names = " and ".join(name.removesuffix(" (without)") for name in part.recordings[:2]) + (
            " and others" if len(part.recordings) > 2 else ""
        )
        errors = ", ".join(f"{after:.2g} {unit}" for unit, (_, after) in part.means.items())
        plain = ", ".join(f"{before:.2g} {unit}" for unit, (before, _) in part.means.items())
        text.append(f"{begin} {names}, {made}, to {errors} (rms), where the model {rival} has {plain}.")
        if not part.better:
            text.append("That is no better, so it may stand in for something else.")
    return text


def _remains(finding: Finding) -> str:
    rest = finding.remaining
    if rest.chi2_per_dof > 1 and rest.p_value < finding.limits.level:
        place = f", most of it in {finding.remaining_where[0].location}" if finding.remaining_where else ""
        return f"What remains: held-out chi2 per degree of freedom {rest.chi2_per_dof:.3g}{place}."
    return "What remains is noise."


def _figures(effect: EffectBase, fit: Fit) -> str:
    parts = []
    for name, r in fit.reported(effect).items():
        known = f"{name} = {r.value:.3g} ± {r.std:.2g} {r.unit}".strip().removesuffix(" 1")
        parts.append(known if math.isfinite(r.std) else f"{name} unknown")
    return ", ".join(parts)


def _out_of_range(effect: EffectBase, fit: Fit) -> list[str]:
    """Amplitudes beyond the range that an engineer would expect."""
    found = []
    for name in effect.amplitudes:
        low, high = effect.prior_range[name]
        room = ROOM * (high - low)
        if not low - room <= fit.values[name] <= high + room and effect.neutral[name] != fit.values[name]:
            found.append(f"{name} = {fit.values[name]:.3g} (range {low:.3g} to {high:.3g})")
    return found


# -- events ---------------------------------------------------------------------------------------------------------

NAMED = 8
"""Maximum number of events listed one by one."""


def event_sentences(events: Events) -> str:
    """Return the sentences on all events: what, where, when; empty if there are none."""
    text = []
    if events.found:
        count = len(events.found)
        told = "; ".join(_said(event) for event in events.found[:NAMED])
        more = f"; and {count - NAMED} more" if count > NAMED else ""
        first = "One event stands" if count == 1 else f"{count} events stand"
        text.append(f"{first} beside all this, short and in one place: {told}{more}.")
    return " ".join([*text, *fall_sentences(events)])


def fall_sentences(events: Events) -> list[str]:
    """Return one sentence for each recording whose end is ignored because a joint moves too fast."""
    why = "moves too fast for the model to follow."
    return [
        f"From {fall.time:.3g} s on nothing is judged in {fall.recording}, where {fall.joint} {why}"
        for fall in events.falls
    ]


def _said(event: Event) -> str:
    if event.kind == "sample":
        when = f"at {0.5 * (event.begin + event.end):.3f} s in {event.recording}"
        return f"{event.channel} is off by {event.peak:+.3g} {event.unit} {when}"
    return (
        f"{event.channel} is pushed by up to {event.peak:+.2g} {event.unit} from {event.begin:.2f} to {event.end:.2f} "
        f"s in {event.recording} ({event.impulse:+.2g} ± {event.std:.1g} {event.unit} s)"
    )

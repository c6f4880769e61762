"""Steps eight and nine: the verdict with its thresholds, where the stiffnesses go, and the words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le, Lt

from yid_ocp.diagnosis.localise import Place
from yid_ocp.diagnosis.null_test import Floor, NullTest
from yid_ocp.diagnosis.screening import Confusability, Score, Visibility
from yid_ocp.diagnosis.select import Closure, Fit, closure
from yid_ocp.diagnosis.smoother import Smoothed
from yid_ocp.effects import EffectBase
from yid_ocp.options import About

FORMAT = "yid-diagnosis/1"
SHAPELESS = 0.01
"""Part of the significance level that an excess without any shape has to reach."""


@dataclass(frozen=True)
class Thresholds:
    """All that a verdict depends on besides the data."""

    level: Annotated[float, Gt(0), Lt(1), About("significance below which a residual is more than noise")] = 0.01
    smallest_gap: Annotated[
        float, Ge(0), About("excess of chi2 per sample over one below which a gap is not worth a name, however sure")
    ] = 0.1
    closure: Annotated[
        float, Ge(0), Lt(1), About("a held-out closure whose lower end is below this is no improvement")
    ] = 0.05
    explained: Annotated[
        float,
        Ge(0),
        Le(1),
        About("fraction of what the smoother explains of the residual which effects have to explain"),
    ] = 0.5
    alike: Annotated[
        float,
        Ge(0),
        Le(1),
        About("fraction of a signature explained by another candidate from which on both are refitted"),
    ] = 0.9
    refits: Annotated[int, Ge(1), About("candidates refitted in a round, and once more as many that are like them")] = 6
    effects: Annotated[int, Ge(1), Le(10), About("how many effects may be added")] = 3
    samples_per_unknown: Annotated[
        float, Ge(0), About("effective samples for every unknown below which nothing is said")
    ] = 3.0


@dataclass(frozen=True)
class Added:
    """An effect that was added, in its round.

    Attributes
    ----------
    effect : EffectBase
    fit : Fit
        With all effects up to this one.
    closure : Closure
        Of the whole gap by all effects up to this one.
    rivals : tuple of EffectBase
        That pass within one standard error, the chosen one first.
    """

    effect: EffectBase
    fit: Fit
    closure: Closure
    rivals: tuple[EffectBase, ...]


@dataclass(frozen=True)
class Absorbed:
    """How a nominal parameter moves when the effects are added."""

    name: str
    unit: str
    before: float
    after: float
    std: float


@dataclass(frozen=True)
class Finding:
    """What a diagnosis says.

    Attributes
    ----------
    verdict : str
        effect, confusable, no_gap, unknown or insufficient_data.
    floor : tuple of Floor
    before, held_out_before : NullTest
        Nominal model, on the recordings to estimate on and on the held-out ones.
    visibility : tuple of Visibility
    confusability : Confusability
    scores : tuple of Score
        First pass, best first.
    smoothed : Smoothed or None
        Unknown forces, offsets and biases about the nominal model; None where there is no gap to locate.
    where : tuple of Place
    nominal : Fit
    fits : tuple of Fit
        Refits of the first round, best first.
    added : tuple of Added
    closure : Closure
    remaining : NullTest
        Held-out, with the effects added.
    remaining_where : tuple of Place
    absorbed : tuple of Absorbed
    next_experiment : str
    held_out : tuple of str
        Names of the recordings.
    in_blocks : bool
        Whether one recording was split in blocks.
    message : str
        Why data do not suffice, or what else must be said.
    seconds : dict of stage to float
    """

    verdict: str
    floor: tuple[Floor, ...]
    before: NullTest
    held_out_before: NullTest
    visibility: tuple[Visibility, ...]
    confusability: Confusability
    scores: tuple[Score, ...]
    smoothed: Smoothed | None
    where: tuple[Place, ...]
    nominal: Fit
    fits: tuple[Fit, ...]
    added: tuple[Added, ...]
    closure: Closure
    remaining: NullTest
    remaining_where: tuple[Place, ...]
    absorbed: tuple[Absorbed, ...]
    next_experiment: str
    held_out: tuple[str, ...]
    in_blocks: bool
    message: str
    seconds: Mapping[str, float]

    @property
    def effects(self) -> tuple[EffectBase, ...]:
        """What was added, in order."""
        return tuple(entry.effect for entry in self.added) if self.verdict in ("effect", "confusable") else ()

    @property
    def last(self) -> Fit:
        """The model with all that was added."""
        return self.added[-1].fit if self.effects else self.nominal

    def to_dict(self) -> dict[str, Any]:
        """`yid-diagnosis/1`."""
        gap = self.verdict not in ("no_gap",)
        after = self.last
        return {
            "format": FORMAT,
            "verdict": self.verdict,
            "gap": {
                "before": _state(self.nominal, self.held_out_before),
                "after": _state(after, self.remaining),
                "closure": _number(self.closure.value) if gap and self.effects else None,
                "closure_ci": [_number(self.closure.low), _number(self.closure.high)] if self.effects else None,
                "held_out": list(self.held_out),
            },
            "where": [_place(p) for p in self.where],
            "which": which(self),
            "effects": [{"kind": e.kind, "location": e.location} for e in self.effects],
            "remaining": {"p_value": self.remaining.p_value, "where": [_place(p) for p in self.remaining_where]},
            "confusable": [
                [{"kind": e.kind, "location": e.location} for e in entry.rivals]
                for entry in self.added
                if self.effects and len(entry.rivals) > 1
            ],
            "next_experiment": self.next_experiment,
            "side": None if self.smoothed is None else self.smoothed.side,
            "evidence": {} if self.smoothed is None else dict(self.smoothed.evidence),
            "explainable": None if self.smoothed is None else self.smoothed.explainable,
            "summary": sentences(self),
            "message": self.message,
            "held_out_in_blocks": self.in_blocks,
            "absorption": {
                a.name: {"before": a.before, "after": a.after, "std": _number(a.std), "unit": a.unit}
                for a in self.absorbed
            },
            "steps": [
                {
                    "added": entry.effect.label,
                    "closure": _number(entry.closure.value),
                    "closure_ci": [_number(entry.closure.low), _number(entry.closure.high)],
                    "chi2_per_dof": entry.fit.loss.mean,
                    "rmse": {name: value for name, (value, _) in entry.fit.loss.channels.items()},
                }
                for entry in self.added
            ],
            "unseen": [v.effect.label for v in self.visibility if not v.visible],
            "noise": {f.channel: {"std": f.std, "unit": f.unit, "samples": f.samples} for f in self.floor},
            "seconds": dict(self.seconds),
        }


def _state(fit: Fit, test: NullTest) -> dict[str, Any]:
    return {
        "rmse": {name: value for name, (value, _) in fit.loss.channels.items()},
        "unit": {name: unit for name, (_, unit) in fit.loss.channels.items()},
        "chi2_per_dof": test.chi2_per_dof,
        "p_value": test.p_value,
    }


def _place(place: Place) -> dict[str, Any]:
    return {
        "location": place.location,
        "share": place.share,
        "observable": place.observable,
        "windows": [list(window) for window in place.windows],
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def which(finding: Finding) -> list[dict[str, Any]]:
    """Candidates, best first: what was added, then the other refits by held-out loss, then the rest by score."""
    scores = {score.effect.label: score for score in finding.scores}
    listed: dict[str, dict[str, Any]] = {}
    entries: list[tuple[EffectBase, Fit | None]] = [(a.effect, finding.last) for a in finding.added if finding.effects]
    entries += [(fit.effects[0], fit) for fit in finding.fits]
    entries += [(score.effect, None) for score in finding.scores]
    alone = {fit.effects[0].label: fit for fit in finding.fits}
    for effect, fit in entries:
        if effect.label in listed:
            continue
        score = scores.get(effect.label)
        if fit is None:
            step = {} if score is None else score.step
            reported = effect.reported(step)
        else:
            reported = fit.reported(effect)
        own = alone.get(effect.label)
        closed = None if own is None else closure(finding.nominal.loss, own.loss)
        listed[effect.label] = {
            "kind": effect.kind,
            "location": effect.location,
            "parameters": {
                name: {"value": _number(r.value), "std": _number(r.std), "unit": r.unit} for name, r in reported.items()
            },
            "score": 0.0 if score is None else score.statistic,
            "p_value": 1.0 if score is None else score.p_value,
            "closure": None if closed is None else _number(closed.value),
            "closure_ci": None if closed is None else [_number(closed.low), _number(closed.high)],
        }
    return list(listed.values())


# -- the decision -----------------------------------------------------------------------------------------------------


def has_gap(before: NullTest, held_out: NullTest, limits: Thresholds, ranked: Sequence[Score] = ()) -> bool:
    """Whether the residual is more than noise, by enough to be worth a name.

    Either as a whole, or along what a candidate would do to it with some channel above noise: the sum over all channels
    does not notice what only a few samples show.

    Parameters
    ----------
    before, held_out : NullTest
    limits : Thresholds
    ranked : sequence of Score
        Of all visible candidates; their smallest p-value counts as the best of that many tries.
    """
    p = min(1.0, 2 * min(before.p_value, held_out.p_value))
    if p < limits.level and max(before.chi2_per_dof, held_out.chi2_per_dof) > 1 + limits.smallest_gap:
        return True
    best = min((score.p_value for score in ranked), default=1.0) * len(ranked)
    largest = max((*before.channels.values(), *held_out.channels.values()), default=1.0)
    return best < limits.level and largest > 1 + limits.smallest_gap


def shapeless(
    smoothed: Smoothed, ranked: Sequence[Score], before: NullTest, held_out: NullTest, limits: Thresholds
) -> bool:
    """Whether an excess is barely significant and neither any unknown nor any candidate explains it: chance, then.

    A sure excess without shape stays a gap: stated noise that is too small looks like that.
    """
    best = min((score.p_value for score in ranked), default=1.0) * len(ranked)
    barely = min(before.p_value, held_out.p_value) > SHAPELESS * limits.level
    return barely and best >= limits.level and smoothed.side == "none"


def decide(
    gap: bool,
    visible: Sequence[Visibility],
    added: Sequence[Added],
    total: Closure,
    limits: Thresholds,
    enough: bool,
    explained: float = 1.0,
) -> str:
    """The verdict of step eight.

    Parameters
    ----------
    gap : bool
    visible : sequence of Visibility
    added : sequence of Added
        After composition.
    total : Closure
        Of all effects added.
    limits : Thresholds
    enough : bool
        Whether there are samples enough for the unknowns.
    explained : float
        What the effects explain over what unknown forces, offsets and biases explain.
    """
    if not enough or not any(entry.visible for entry in visible):
        return "insufficient_data"
    if not gap:
        return "no_gap"
    if not added or not total.low > limits.closure or explained < limits.explained:
        return "unknown"
    return "confusable" if len(added[0].rivals) > 1 else "effect"


_DEPENDS = {
    "how fast it moves": ("kelvin_voigt", "joint_viscous", "aerodynamic_drag", "joint_stribeck", "joint_coulomb"),
    "how long it is held": ("standard_linear_solid", "hysteresis", "grasp_slip"),
    "how hard it accelerates": ("rotor_inertia", "density", "link_mass", "point_mass"),
    "how far it bends": ("cubic_stiffness", "rest_curvature", "bend_anisotropy", "joint_spring"),
    "how it stands against gravity": (
        "gravity_scale",
        "gravity_tilt",
        "effort_offset",
        "encoder_offset",
        "effort_gain",
    ),
    "how hard it pulls at its ends": (
        "grasp_compliance",
        "grasp_offset",
        "mount_compliance",
        "junction_compliance",
        "series_elasticity",
        "backlash",
    ),
    "when it is read": ("effort_delay", "camera_latency", "clock_scale"),
    "where the camera stands": ("camera_translation", "camera_rotation", "camera_scale", "surface_offset"),
    "how long it is": ("length_scale",),
}


def separating(rivals: Sequence[EffectBase]) -> str:
    """The experiment that would tell rivals apart, from what their equations depend on."""
    aspects = [a for a, kinds in _DEPENDS.items() if any(effect.kind in kinds for effect in rivals)]
    places = list(dict.fromkeys(effect.location for effect in rivals))
    if len(aspects) > 1:
        return f"Vary {' and '.join(aspects)} independently of each other, over a wide range, in one recording."
    if len(places) > 1:
        return f"Move so that {' and '.join(places)} work one at a time, or measure a point between them."
    return f"Vary {aspects[0]} over a wider range." if aspects else "Record other motions, faster and larger."


def next_experiment(verdict: str, added: Sequence[Added], where: Sequence[Place], unseen: Sequence[str]) -> str:
    """What to record next."""
    if verdict == "insufficient_data":
        return "Record longer and larger motions; more of the object has to be seen."
    rivals = next((entry.rivals for entry in added if len(entry.rivals) > 1), ())
    if rivals:
        return separating(rivals)
    if verdict == "unknown" and where:
        return f"Move {where[0].location} alone, slowly and fast, and hold it still in several postures."
    if verdict == "no_gap":
        listed = ", ".join(unseen[:4]) + (", ..." if len(unseen) > 4 else "")
        return f"None is needed; these motions could not have shown {listed}." if unseen else "None is needed."
    return "Repeat with other motions to see whether the effect's parameters stay."


# -- words ------------------------------------------------------------------------------------------------------------


def _figures(effect: EffectBase, fit: Fit) -> str:
    parts = []
    for name, r in fit.reported(effect).items():
        deviation = f" ± {r.std:.2g}" if math.isfinite(r.std) else ""
        parts.append(f"{name} = {r.value:.3g}{deviation} {r.unit}".strip().removesuffix(" 1"))
    return ", ".join(parts)


def _out_of_range(effect: EffectBase, fit: Fit) -> list[str]:
    """Amplitudes beyond the range that an engineer would expect."""
    found = []
    for name in effect.amplitudes:
        low, high = effect.prior_range[name]
        room = 0.25 * (high - low)
        if not low - room <= fit.values[name] <= high + room and effect.neutral[name] != fit.values[name]:
            found.append(f"{name} = {fit.values[name]:.3g} (range {low:.3g} to {high:.3g})")
    return found


SIDES = {
    "plant": ", in the mechanics rather than in what sensors read",
    "sensor": ", in what sensors read",
    "either": ", in the mechanics or in what the effort sensor reads, which efforts alone do not tell apart",
}


def sentences(finding: Finding) -> str:
    """The report in words."""
    held, first = finding.held_out_before, finding.before
    text = []
    if finding.verdict == "insufficient_data":
        text.append(f"The data do not suffice: {finding.message}")
    elif finding.verdict == "no_gap":
        text.append(
            f"There is no gap to speak of (chi2 per degree of freedom {first.chi2_per_dof:.3g}, held out "
            f"{held.chi2_per_dof:.3g}; p = {min(first.p_value, held.p_value):.2g})."
        )
    else:
        text.append(
            f"The gap is real (held-out chi2 per degree of freedom {held.chi2_per_dof:.3g}, "
            f"p {_small(min(first.p_value, held.p_value))})."
        )
        main = [p for p in finding.where if p.share > 0.1] or list(finding.where[:1])
        named = " and ".join(f"{p.location} ({100 * p.share:.0f} %)" for p in main[:3])
        side = "" if finding.smoothed is None else SIDES.get(finding.smoothed.side, "")
        text.append(f"It lies in {named}{side}." if named else "")
    if finding.effects:
        last = finding.last
        names = "; ".join(f"{e.label} with {_figures(e, last)}" for e in finding.effects)
        c = finding.closure
        verb = "closes" if len(finding.effects) == 1 else "together close"
        text.append(
            f"{names} {verb} {100 * c.value:.3g} % of it on held-out motions "
            f"(95 % interval {100 * c.low:.3g} to {100 * c.high:.3g} %)."
        )
        for entry in finding.added:
            others = [r.label for r in entry.rivals if r.label != entry.effect.label]
            if others:
                text.append(f"Not separable from {entry.effect.label}: {', '.join(others)}.")
        odd = [text for effect in finding.effects for text in _out_of_range(effect, last)]
        if odd:
            text.append(
                f"Beyond what one would expect, and so perhaps standing in for something else: {', '.join(odd)}."
            )
        rest = finding.remaining
        if rest.chi2_per_dof > 1 and rest.p_value < 0.01:
            place = f", most of it in {finding.remaining_where[0].location}" if finding.remaining_where else ""
            text.append(f"What remains: held-out chi2 per degree of freedom {rest.chi2_per_dof:.3g}{place}.")
        else:
            text.append("What remains is noise.")
        moved = [a for a in finding.absorbed if abs(a.after - a.before) > 0.1 * max(abs(a.before), 1e-9)]
        if moved:
            steps = (f"{a.name} goes from {a.before:.3g} to {a.after:.3g}" for a in moved[:6])
            text.append(f"With it {', '.join(steps)}.")
    elif finding.verdict == "unknown":
        best = finding.fits[0] if finding.fits else None
        said = "" if best is None else f" (the best, {best.effects[0].label}, does not explain half of it)"
        text.append(f"No known effect explains it{said}.")
    if finding.in_blocks:
        text.append("Only one set of recordings was given: alternate blocks of it were held out.")
    text.append(f"Next experiment: {finding.next_experiment}")
    return " ".join(part for part in text if part)


def _small(p: float) -> str:
    return f"= {p:.2g}" if p > 1e-12 else "< 1e-12"

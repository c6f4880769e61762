"""Support of an export format for each parameter and effect: native, emulated or not representable."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from yid_ocp.model.system import System
from yid_ocp.virtual import mjcf
from yid_ocp.virtual.rigid_body_terms import (
    MODEL_ASPECTS,
    ParameterEvaluator,
    aspects_of_parameters,
    effect_terms_and_aspects,
)

_SupportStatus = Literal["native", "emulated", "not representable"]
_ORDER: tuple[_SupportStatus, ...] = ("native", "emulated", "not representable")

EXPORT_FORMAT = "yid-export/1"


@dataclass(frozen=True)
class FormatSupport:
    """Support of a format for one parameter or effect, with its means or the reason against."""

    status: _SupportStatus
    how: str

    @staticmethod
    def worst_of(parts: Iterable[FormatSupport]) -> FormatSupport:
        """The worst status of several parts that belong together, with the explanations of those that have it."""
        known = list(parts)
        status = max((part.status for part in known), key=_ORDER.index)
        return FormatSupport(status, "; ".join(dict.fromkeys(part.how for part in known if part.status == status)))


# what each format calls the aspects that it has; others it has not
_MJCF = {
    "stiffness": "stiffness of joints",
    "rest": "springref of joints",
    "damping": "damping of joints",
    "geometry": "places of bodies and sites",
    "inertia": "inertials",
    "weight": "gravcomp of bodies",
    "gravity": "gravity of the option",
    "grasp": "equality constraints between sites",
    "grasp_compliance": "a tendon without length, which damps along its pull alone",
    "sprung_joint": "joints with stiffness and damping",
    "armature": "armature of joints",
    "dry_friction": "frictionloss of joints, which sticks at rest where the model creeps",
    "cubic_stiffness": "polynomial stiffness of joints",
    "servo": "position actuators: gainprm, biasprm, forcerange and delay",
    "torque_gain": "gainprm of actuators",
    "torque_offset": "biasprm of actuators",
    "torque_delay": "delay of actuators",
    "torque_lag": "filterexact actuators",
}
_URDF = {
    "damping": "damping of joints",
    "geometry": "origins of joints",
    "inertia": "inertials",
    "dry_friction": "friction of joints, which engines take in ways of their own",
}
_SDF = {
    **_URDF,
    "stiffness": "spring_stiffness of axes",
    "rest": "spring_reference of axes",
    "geometry": "poses of links and frames",
    "sprung_joint": "spring_stiffness and damping of axes",
    "gravity": "gravity of the world",
}
_SUPPORT_BY_FORMAT: Mapping[str, Mapping[str, FormatSupport]] = {
    name: {
        aspect: FormatSupport("not representable", f"{name.upper()} has nothing for {words}")
        if aspect not in table
        else FormatSupport("emulated" if aspect in mjcf.EMULATED_ASPECTS else "native", table[aspect])
        for aspect, words in MODEL_ASPECTS.items()
    }
    for name, table in (("mjcf", _MJCF), ("urdf", _URDF), ("sdf", _SDF))
}
"""Support by format and aspect."""

_READING = FormatSupport("not representable", f"{MODEL_ASPECTS['reading']}: correct the readings instead")
_NEUTRAL = FormatSupport("native", "neutral: it changes nothing and is left out")
_UNUSED = FormatSupport("native", "it enters nothing in this model")


def effect_support(system: System, values: Mapping[str, float], form: str) -> dict[str, FormatSupport]:
    """Support of a format for every effect of a system, by label.

    Parameters
    ----------
    system : System
    values : mapping of parameter name to value
    form : str
        `mjcf`, `urdf` or `sdf`.
    """
    value = ParameterEvaluator(system, values)
    found: dict[str, FormatSupport] = {}
    for effect in system.effects:
        label = f"{effect.kind}@{effect.location}"
        amplitudes = _neutral(effect)
        theta = dict(zip(system.parameters.names, system.parameters.vector(values), strict=True))
        if amplitudes and all(theta[name] == neutral for name, neutral in amplitudes.items()):
            found[label] = _NEUTRAL
            continue
        _, aspects = effect_terms_and_aspects(system, effect, value)
        parts = {aspect: _SUPPORT_BY_FORMAT[form][aspect] for aspect in sorted(aspects)} | (
            {"reading": _READING} if "reading" in aspects else {}
        )
        found[label] = FormatSupport.worst_of(parts.values())
    return found


def _neutral(effect: Any) -> dict[str, float]:
    """Neutral value of the parameters whose neutral value makes an effect vanish."""
    neutral: Mapping[str, float] = getattr(effect, "neutral_values", {})
    return {name: neutral[name] for name in getattr(effect, "amplitude_names", ())}


def parameter_support(system: System, effects: Mapping[str, FormatSupport], form: str) -> dict[str, FormatSupport]:
    """Support of a format for every parameter; an effect's parameters have the support of the effect."""
    found = {}
    for entry in system.parameters:
        owner = entry.name.rpartition(".")[0]
        if owner in effects:
            found[entry.name] = effects[owner]
            continue
        aspects = aspects_of_parameters(system, entry.symbol)
        found[entry.name] = (
            FormatSupport.worst_of(_SUPPORT_BY_FORMAT[form][aspect] for aspect in sorted(aspects))
            if aspects
            else _UNUSED
        )
    return found

"""The library of unmodelled effects: kinds, their possible locations, and `make_effect`; a new kind is one file.

A kind's equation, quantities, units, bounds and ranges stand at its class; `docs/extending.md` shows a new one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from importlib import import_module
from pkgutil import iter_modules

from yid_ocp.effects import base
from yid_ocp.effects.base import EFFECTS as EFFECTS
from yid_ocp.effects.base import EffectBase as EffectBase
from yid_ocp.effects.base import ParameterDefinition as ParameterDefinition
from yid_ocp.effects.base import ReportedParameter as ReportedParameter
from yid_ocp.errors import ModelError, UnknownNameDetails, unknown_name_details
from yid_ocp.model.system import System

SENSOR_KINDS = ("joints.position", "joints.effort", "camera", "nominal_clock")
"""Kinds of recorded signals on which candidates depend; `nominal_clock` is a sample index times a nominal period."""

# every file of this folder registers its kinds when it is imported
for _family in iter_modules(__path__):
    import_module(f"{__name__}.{_family.name}")


def make_effect(kind: str, location: str, system: System, values: Mapping[str, float] | None = None) -> EffectBase:
    """An effect of a kind at a location, to be added with `System.with_effects`.

    Parameters
    ----------
    kind : str
        A registered kind, `kelvin_voigt` for example.
    location : str
        Where it sits: a segment, point, arm joint, grasp or arm, `base`, `object`, `world`, `camera` or `clock`.
    system : System
        The system that it will be added to.
    values : mapping of quantity to value, optional
        Where they are not neutral; a compliance may be given as its `stiffness`.

    Returns
    -------
    EffectBase
        Its parameters are named `kind@location.quantity`.

    Raises
    ------
    ConfigError
        No such kind or quantity, or a value outside its bounds.
    ModelError
        The system has no such place for it.
    """
    cls = EFFECTS[kind]
    places = cls.possible_locations(system)
    if location not in places:
        if not places:
            said = UnknownNameDetails(allowed="nothing in this system", hint="leave it out")
        else:
            said = unknown_name_details(location, places)
        raise ModelError(f"{kind} does not fit '{location}'", where=f"{kind}@{location}", **said)
    return base.build_effect(kind, location, system, values)


def candidate_effects(system: System, recorded_sensors: Collection[str]) -> list[tuple[str, str]]:
    """Every (kind, location) that is possible in a system and visible in a recording.

    Parameters
    ----------
    system : System
        Without the effects in question.
    recorded_sensors : collection of str
        What was recorded, among `SENSOR_KINDS`.

    Returns
    -------
    list of (str, str)
        By kind, then in the order of the system. What works only on prescribed joints is left out where no effort was
        recorded, for there nothing would show it.

    Raises
    ------
    ModelError
        An entry that is not in `SENSOR_KINDS`.
    """
    present = set(recorded_sensors)
    for name in sorted(present - set(SENSOR_KINDS)):
        raise ModelError(f"there is no kind of sensor '{name}'", **unknown_name_details(name, SENSOR_KINDS))
    unseen = set() if "joints.effort" in present else set(system.prescribed)
    found = []
    for kind in EFFECTS:
        cls = EFFECTS[kind]
        if cls.required_sensors <= present:
            found += [(kind, place) for place in cls.candidate_locations(system) if place not in unseen]
    return found


def effect_overview() -> list[tuple[str, str, str]]:
    """Every kind with its equation and the sensors that it requires."""
    return [(kind, EFFECTS[kind].equation, ", ".join(sorted(EFFECTS[kind].required_sensors))) for kind in EFFECTS]

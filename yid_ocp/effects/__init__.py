"""The library of unmodelled effects and their possible locations. A new kind is one file.

A kind's equation, quantities, units, bounds and ranges stand at its class; `docs/howto/extending.md` shows a new one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from importlib import import_module
from pkgutil import iter_modules

from yid_ocp.effects import base
from yid_ocp.effects.base import EFFECTS as EFFECTS
from yid_ocp.effects.base import EffectBase as EffectBase
from yid_ocp.effects.base import ParameterDefinition as ParameterDefinition
from yid_ocp.effects.base import ReportedParameterValue as ReportedParameterValue
from yid_ocp.errors import ModelError, unknown_name_error_arguments
from yid_ocp.model.system import System

# kinds of recorded signals on which candidates depend; `nominal_clock` is a sample index times a nominal period
_SENSOR_KINDS = ("joints.position", "joints.effort", "camera", "nominal_clock")

# every file of this folder registers its kinds when it is imported
for _family in iter_modules(__path__):
    import_module(f"{__name__}.{_family.name}")


def make_effect(kind: str, location: str, system: System, values: Mapping[str, float] | None = None) -> EffectBase:
    """Make an effect of the given kind at a location. `System.with_effects` adds it to a system.

    Its parameters are named `kind@location.parameter`. `values` holds what is not neutral, by parameter; a compliance
    may be given as its `stiffness`. `ConfigError` of no such kind or parameter or a value outside its bounds,
    `ModelError` where the system has no such place for it.
    """
    places = EFFECTS[kind].possible_locations(system)
    # points may be of any frame, those of the arm included, which are not among `system.point_frames`
    if location not in places and not (EFFECTS[kind].is_at_point_groups and location.partition("_")[0] == "points"):
        said = {"allowed": "nothing in this system", "hint": "leave it out"}
        said = unknown_name_error_arguments(location, places) if places else said
        raise ModelError(f"{kind} does not fit '{location}'", where=f"{kind}@{location}", **said)
    return base.build_effect(kind, location, system, values or {})


def signal_kinds_required_by_any_effect() -> frozenset[str]:
    """Kinds of recorded signals that registered effects can require, such as `joints.effort`. Plug-ins are included."""
    return frozenset(_SENSOR_KINDS).union(*(EFFECTS[kind].required_sensors for kind in EFFECTS))


def candidate_kinds_and_locations(system: System, recorded_sensors: Collection[str]) -> list[tuple[str, str]]:
    """List all effect kinds and locations that the system allows and the recorded signals can reveal.

    The system is without the effects in question, the signals are among `signal_kinds_required_by_any_effect`, or a
    sensor on a frame such as `wrist:FRAME`, or `points:GROUP`, points with a clock of their own. What works only on
    prescribed joints is left out where no effort was recorded, for there nothing would show it. `ModelError` of
    another signal.
    """
    present, known = set(recorded_sensors), signal_kinds_required_by_any_effect()
    for name in sorted(name for name in present - known if ":" not in name):
        raise ModelError(f"there is no kind of sensor '{name}'", **unknown_name_error_arguments(name, sorted(known)))
    unseen = set() if "joints.effort" in present else set(system.prescribed)
    found = []
    for kind in EFFECTS:
        cls = EFFECTS[kind]
        if cls.required_sensors <= present:
            places = [*(cls.candidate_locations or cls.possible_locations)(system)]
            if cls.is_at_recorded_sensor or cls.is_at_point_groups:
                places = [place for place in places if place in present]
            if cls.is_at_point_groups:
                kinds_and_groups = (name.split(":") for name in sorted(present) if ":" in name)
                places += [group for signal, group in kinds_and_groups if signal == "points"]
            found += [(kind, place) for place in places if place not in unseen]
    return found

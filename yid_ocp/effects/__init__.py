"""The library of effects, which are mechanisms and sensor errors that the nominal model lacks.

The class of a kind states its equation, parameters, units and bounds. To add a kind, see `docs/howto/extending.md`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from importlib import import_module
from pkgutil import iter_modules

import casadi as ca

from yid_ocp.effects import base
from yid_ocp.effects.base import EFFECTS as EFFECTS
from yid_ocp.effects.base import EffectBase as EffectBase
from yid_ocp.errors import ConfigError, ModelError, require_known_names, unknown_name_error_arguments
from yid_ocp.model.parameters import Parameter, Parameters
from yid_ocp.model.system import System

# kinds of recorded signals on which candidates depend; `nominal_clock` means times computed as sample index x period
_SENSOR_KINDS = ("joints.position", "joints.effort", "camera", "nominal_clock")

# every file of this folder registers its kinds when it is imported
for _family in iter_modules(__path__):
    import_module(f"{__name__}.{_family.name}")


def make_effect(kind: str, location: str, system: System, values: Mapping[str, float] | None = None) -> EffectBase:
    """Create an effect of the given kind at a location of `system`. `System.with_effects` then adds it to the system.

    Its parameters are named `kind@location.parameter`. `values`, by `parameter`, replaces neutral values; a compliance
    may be given as `stiffness`. Raises `ConfigError` for an unknown kind or parameter or a value outside its bounds,
    and `ModelError` if the kind cannot act at this location of the system.
    """
    cls, label = EFFECTS[kind], f"{kind}@{location}"
    places = cls.possible_locations(system)
    # a payload or point mass may be at any frame, including frames of the arm that are not in `system.point_frames`
    if location not in places and not (cls.is_at_point_groups and location.partition("_")[0] == "points"):
        said = {"allowed": "no location of this model, which has nothing on which the effect acts"}
        said |= {"hint": "remove the effect from model.effects, or set another model.arms.mode"}
        said = unknown_name_error_arguments(location, places) if places else said
        raise ModelError(f"the effect {kind} is not possible at '{location}'", where=label, **said)
    definitions = cls.parameter_definitions(location, system)
    names = {q.name: q for q in definitions} | {q.reported_name_and_unit[0]: q for q in definitions}
    given, values = dict[str, float](), values or {}
    require_known_names(values, names, "parameter", label, ConfigError)
    for name, value in values.items():
        definition = names[name]
        if name != definition.name:
            signed, unit = definition.lower < 0, definition.reported_name_and_unit[1]
            if not (value > 0 or (signed and value < 0)):
                allowed = f"{'a number other than zero' if signed else 'a positive number'} [{unit}]"
                what, hint = f"{name} is {value}, but must be {allowed}", "correct the value, or leave it out"
                raise ConfigError(what, where=label, allowed=allowed, hint=hint)
            value = definition.internal_from_reported_value(value)
        given[definition.name] = float(value)
    entries = (
        Parameter(f"{label}.{q.name}", given.get(q.name, q.neutral_value), q.unit, q.lower, q.upper, q.description)
        for q in definitions
    )
    inner = (f"{label}.{name}" for name in cls.internal_coordinate_names(location, system))
    internal = {name: ca.SX.sym(name) for name in inner}
    arm_joints = base.joint_names_by_arm(system).get(location, ())
    return cls(kind, location, Parameters(entries), internal, definitions, arm_joints)


def signal_kinds_required_by_any_effect() -> frozenset[str]:
    """Return the kinds of recorded signals, such as `joints.effort`, that some effect (also of a plug-in) requires."""
    return frozenset(_SENSOR_KINDS).union(*(EFFECTS[kind].required_sensors for kind in EFFECTS))


def candidate_kinds_and_locations(system: System, recorded_sensors: Collection[str]) -> list[tuple[str, str]]:
    """List the pairs of effect kind and location that the system allows and the recorded signals can reveal.

    `system` does not contain the candidate effects. `recorded_sensors` lists the recorded signals: names in
    `signal_kinds_required_by_any_effect`, sensors on a frame such as `wrist:FRAME`, and `points:GROUP` for points with
    a separate clock. Without recorded efforts, effects on prescribed joints change no measurement and are omitted,
    except errors of their encoders, which move the whole arm. Raises `ModelError` for another signal.
    """
    present, known = set(recorded_sensors), signal_kinds_required_by_any_effect()
    named = sorted(name for name in present if ":" not in name)
    require_known_names(named, sorted(known), "kind of recorded signal", "argument recorded_sensors", ModelError)
    unseen = set() if "joints.effort" in present else set(system.prescribed)
    found = []
    for kind in EFFECTS:
        cls = EFFECTS[kind]
        if cls.required_sensors <= present:
            places = [*(cls.candidate_locations or cls.possible_locations)(system)]
            if cls.is_at_recorded_sensor or cls.is_at_point_groups:
                places = [place for place in places if place in present]
            if cls.is_at_point_groups:
                places += [name.removeprefix("points:") for name in sorted(present) if name.startswith("points:")]
            found += [(kind, place) for place in places if cls.moves_prescribed_joint or place not in unseen]
    return found

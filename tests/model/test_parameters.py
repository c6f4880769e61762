from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest

from yid_ocp.errors import ConfigError, ModelError, YidError, nearest_name_hint, unknown_name_details
from yid_ocp.model import Parameter, Parameters


@pytest.fixture
def three():
    bend, mass = Parameter("T1.bend", 3.0, "N m/rad", 0.0), Parameter("T1.mass", 0.064, "kg", 0.0, 1.0)
    return Parameters([bend, mass, Parameter("wind@object.speed", -2.0, "m/s")])


def test_order_of_theta(three):
    assert three.names == ("T1.bend", "T1.mass", "wind@object.speed")
    np.testing.assert_array_equal(three.vector(), [3.0, 0.064, -2.0])
    np.testing.assert_array_equal(three.vector({"T1.mass": 0.1, "T1.bend": 22.0}), [22.0, 0.1, -2.0])
    assert [three.index(name) for name in three.names] == [0, 1, 2]
    assert [entry.name for entry in three] == list(three.names)
    assert len(three) == 3
    assert "T1.mass" in three
    assert "T1.weight" not in three


def test_symbols_stand_for_the_entries(three):
    function = ca.Function("f", [three.symbols], [three["T1.bend"].symbol * 10 + three["T1.mass"].symbol])
    assert float(function([1.0, 2.0, 3.0])) == 12.0
    assert three.symbols.shape == (3, 1)
    assert Parameters().symbols.shape == (0, 1)


def test_changed_sets_keep_order_and_symbols(three):
    changed = three.with_nominal_values({"T1.bend": 5.0})
    assert changed.names == three.names
    assert (changed["T1.bend"].value, changed["T1.bend"].lower) == (5.0, 0.0)
    assert three["T1.bend"].value == 3.0
    assert ca.is_equal(changed["T1.bend"].symbol, three["T1.bend"].symbol)
    more = three.with_added([Parameter("a", 1.0, "1")], [Parameter("b", 2.0, "1")])
    assert more.names == (*three.names, "a", "b")
    lower, upper = three.bounds(["T1.mass", "wind@object.speed"])
    assert (lower.tolist(), upper.tolist()) == ([0.0, -math.inf], [1.0, math.inf])


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda p: p["T1.bent"], ["'T1.bent'", "did you mean 'T1.bend'?"]),
        (lambda p: p.vector({"zz": 1.0}), ["'zz'", "T1.bend, T1.mass, wind@object.speed"]),
        (lambda p: p.vector({"T1.bend": math.nan}), ["T1.bend = nan", "finite"]),
        (lambda p: p.with_nominal_values({"T1.mass": 2.0}), ["T1.mass = 2 kg", "0 to 1 kg"]),
        (lambda p: p.with_nominal_values({"T1.mas": 2.0}), ["did you mean 'T1.mass'?"]),
        (lambda p: p.bounds(["T2.bend"]), ["'T2.bend'", "'T1.bend'"]),
        (lambda p: p.with_added([Parameter("T1.bend", 1.0, "1")]), ["named twice", "T1.bend"]),
        (lambda p: Parameter("x", math.inf, "1"), ["x = inf"]),
        (lambda p: Parameter("x", 1.0, "1", lower=2.0), ["x = 1 1", "2 to inf"]),
    ],
)
def test_errors_name_what_is_wrong_and_what_is_allowed(three, action, words):
    with pytest.raises(ConfigError) as caught:
        action(three)
    for word in words:
        assert word in str(caught.value)


def test_an_error_has_its_parts_on_lines_of_their_own():
    error = ModelError("it broke", where="here", allowed="this", hint="that")
    assert str(error) == "it broke\n  where: here\n  allowed: this\n  try: that"
    assert isinstance(error, YidError)
    assert (error.what, error.where, error.allowed, error.hint) == ("it broke", "here", "this", "that")
    lines = str(ModelError("it broke")).splitlines()
    assert [line.split(":")[0] for line in lines] == ["it broke", "  where", "  allowed", "  try"]


def test_a_long_error_is_shortened_where_it_is_long_and_obeyed_by_no_terminal():
    error = ModelError("what \x1b[2J\n  where: elsewhere", where="here", allowed="a" * 100_000, hint="h" * 300)
    assert len(str(error)) <= 600
    assert str(error).isprintable() == (str(error).count("\n") == 0)
    what, where, allowed, hint = str(error).split("\n")
    assert (what, where) == (r"what \x1b[2J\n  where: elsewhere", "  where: here")
    assert " ... " in allowed
    assert len(hint) > 200


def test_nearest_name():
    assert nearest_name_hint("left_s3", ["left_s0", "head"]) == "did you mean 'left_s0'?"
    assert nearest_name_hint("zzz", ["b", "a"]) == "known: a, b"
    assert nearest_name_hint("zzz", []) == "known: none"
    assert nearest_name_hint("W_t1", ["w_T2", "w_T1"]) == "did you mean 'w_T1'?"


def test_names_are_listed_once_and_long_lists_are_cut():
    few, many, more = ["b", "a"], [f"joint_{i}" for i in range(30)], [f"frame_{i}" for i in range(70)]
    assert unknown_name_details("zzz", few) == {"allowed": "b, a", "hint": ""}
    assert unknown_name_details("zzz", []) == {"allowed": "none", "hint": ""}
    # nothing is near: all of them, for somebody who looks for a name
    assert unknown_name_details("zzz", many) == {"allowed": ", ".join(many), "hint": ""}
    said = unknown_name_details("joint_7x", many)
    assert said["hint"] == "did you mean 'joint_7'?"
    assert said["allowed"].startswith("joint_7, ")
    assert said["allowed"].endswith(" and 22 more")
    assert unknown_name_details("zzz", more)["allowed"] == ", ".join(more[:8]) + " and 62 more"
    assert nearest_name_hint("zzz", more).count("frame_") == 8

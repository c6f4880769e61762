"""Options say of themselves what is allowed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass
from typing import Annotated, Literal

import pytest
from annotated_types import Ge, Gt, Le, Len, Lt

from yid_ocp.errors import ConfigError
from yid_ocp.options import OptionInfo, check_option_bounds, class_options_by_key, describe_type
from yid_ocp.solvers import GaussNewton, MultipleShooting, SteepestDescent


@dataclass(frozen=True)
class Wheel:
    """An example."""

    radius: Annotated[float, Gt(0), Le(2), OptionInfo("of the tyre", "m")]
    spokes: Annotated[int | None, Ge(3), OptionInfo("none when absent")] = None
    wear: Annotated[tuple[Annotated[float, Ge(0), Lt(1)], ...], Len(1), OptionInfo("of each tread")] = (0.5,)
    tyre: Annotated[Literal["slick", "grooved"], OptionInfo("kind of tyre")] = "slick"
    load: Annotated[Annotated[float, Ge(0)] | Mapping[str, float], OptionInfo("by axle", "N")] = 0.0
    serial: int = -1

    def __post_init__(self) -> None:
        check_option_bounds(self, "wheel")


WORDS = {
    "radius": "a number above 0 up to 2 [m]",
    "spokes": "a whole number from 3",
    "wear": "a list, each a number from 0 below 1, 1 at least",
    "tyre": "slick, grooved",
    "load": "a number from 0 [N] or a section, such as {NAME: VALUE}, with a number as VALUE",
}


def test_options_are_the_fields_that_say_what_they_are():
    options = class_options_by_key(Wheel)
    assert (options["radius"].default_value, options["spokes"].default_value) == (MISSING, None)
    assert {name: describe_type(option.type_hint) for name, option in options.items()} == WORDS


@pytest.mark.parametrize(
    ("name", "value"),
    [("radius", 0.0), ("radius", 2.1), ("radius", float("nan")), ("spokes", 2), ("wear", (0.2, 1.0)), ("load", -1.0)],
)
def test_numbers_outside_their_bounds_are_refused(name, value):
    with pytest.raises(ConfigError) as caught:
        Wheel(**{"radius": 1.0, name: value})
    assert (caught.value.where, caught.value.allowed) == ("wheel", WORDS[name])


def test_numbers_on_their_bounds_and_none_are_allowed():
    Wheel(2.0)
    Wheel(1.0, 3, (0.0,), load={"rear": -1.0}, serial=-5)


@pytest.mark.parametrize("kind", [GaussNewton, MultipleShooting, SteepestDescent])
def test_solvers_refuse_them_too(kind):
    with pytest.raises(ConfigError, match="max_iterations is -3"):
        kind(max_iterations=-3)

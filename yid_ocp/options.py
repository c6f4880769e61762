"""What an option says of itself, beside its type and bounds: words and a unit, for reader, schema and documentation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class About:
    """What a key means and its unit; markers may stand in any part of a type.

    Attributes
    ----------
    text : str
    unit : str
        SI, empty for text and pure numbers.
    path : bool
        Whether the text names a file, relative to the configuration; `package:NAME` and `default:NAME` are kept.
    """

    text: str = ""
    unit: str = ""
    path: bool = False

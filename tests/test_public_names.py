"""The front door of the package."""

from __future__ import annotations

import pytest

import yid_ocp as yid


def test_the_public_names_exist():
    for name in yid.__all__:
        assert getattr(yid, name) is not None
    assert set(yid.__all__) <= set(dir(yid))
    with pytest.raises(AttributeError, match="no attribute 'slove'"):
        yid.slove  # noqa: B018

"""What the command `compare` shows beside its own results."""

from __future__ import annotations

from dataclasses import replace

import pytest

from yid_ocp.analysis.published import PUBLISHED
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import CompareSettings
from yid_ocp.errors import ConfigError
from yid_ocp.workflow.compare import published_answers


def test_the_papers_answers_are_shown_where_the_configuration_asks_for_them(repository):
    for name in PUBLISHED:
        run = load_config(repository / "configs" / f"{name}.yaml")
        assert published_answers(run) == PUBLISHED[name]
        assert published_answers(replace(run, compare=CompareSettings())) == {}
    with pytest.raises(ConfigError, match="no experiment 'triple'"):
        published_answers(replace(run, compare=CompareSettings(published="triple")))

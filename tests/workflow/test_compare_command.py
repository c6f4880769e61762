"""The command `compare`."""

from __future__ import annotations

from dataclasses import replace

import pytest

from yid_ocp.analysis.compare import PAPER_ESTIMATES
from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import CompareSettings
from yid_ocp.errors import ConfigError
from yid_ocp.workflow.compare import _paper_estimates


def test_the_papers_answers_are_shown_where_the_configuration_asks_for_them(repository):
    for name in PAPER_ESTIMATES:
        run = load_config(repository / "configs" / f"{name}.yaml")
        assert _paper_estimates(run) == PAPER_ESTIMATES[name]
        assert _paper_estimates(replace(run, compare=CompareSettings())) == {}
    with pytest.raises(ConfigError, match="no experiment 'triple'"):
        _paper_estimates(replace(run, compare=CompareSettings(paper_experiment="triple")))

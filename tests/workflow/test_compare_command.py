"""The command `compare`."""

from __future__ import annotations

import pytest

from yid_ocp.analysis.compare import PAPER_ESTIMATES
from yid_ocp.config.reader import load_config


@pytest.mark.parametrize("name", PAPER_ESTIMATES)
def test_the_papers_configurations_ask_for_its_answers(repository, cli, name):
    file = repository / "configs" / f"{name}.yaml"
    assert load_config(file).compare.paper_experiment == name
    refused = cli("compare", file, "--set", "compare.paper_experiment=triple")
    assert (refused.code, "no experiment 'triple'" in refused.err) == (2, True)

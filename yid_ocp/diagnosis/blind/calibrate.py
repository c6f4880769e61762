"""Thresholds from an ensemble whose labels are known: quantiles of what clean recordings, and true effects, show."""

from __future__ import annotations

import math
from dataclasses import replace

from yid_ocp.diagnosis.thresholds import Thresholds


def opened_wide(limits: Thresholds) -> Thresholds:
    """Thresholds by which anything is a gap and the best candidate is added, whatever it brings.

    A diagnosis of clean recordings with these shows how far chance alone goes.
    """
    limits = replace(limits, level=1.0 + 1e-9, smallest_gap=-1.0, shapeless=1.0)
    return replace(limits, worth=1e-9, places=1, closure=-math.inf, relevance=-math.inf, effects=1)

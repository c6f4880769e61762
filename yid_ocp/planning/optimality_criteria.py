"""Optimality criteria of an experiment, as functions of the sensitivities of its measurements.

Every parameter has a prior standard deviation of 400 % of its value (`judgement.MAX_WEAK_RELATIVE_STD`), so that a criterion stays
finite where no measurement informs a parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from yid_ocp.inference.uncertainty import MAX_WEAK_RELATIVE_STD

Array = NDArray[np.float64]


class OptimalityCriterion(Protocol):
    """A criterion to maximise [nat], with its gradient by the sensitivities (nr, columns)."""

    def value_and_gradient(self, rows: Array, slope: bool = True) -> tuple[float, Array]:
        """Criterion and gradient at sensitivities (nr, columns) to relative changes; the gradient may be left empty."""
        ...


def _prior(columns: int, bounded: Sequence[int]) -> Array:
    """Information beforehand: of parameters that of `MAX_WEAK_RELATIVE_STD`, of all else next to none (theirs stands in the rows)."""
    prior = np.full(columns, 1e-6)
    prior[list(bounded)] = MAX_WEAK_RELATIVE_STD**-2
    return prior


@dataclass(frozen=True)
class DOptimality:
    """Minus half the log determinant of the covariance of some parameters, all others and nuisances eliminated.

    With all parameters chosen that is D-optimality, with some of them D_s-optimality, with one its standard deviation.

    Attributes
    ----------
    chosen_columns : tuple of int
        Columns whose precision counts.
    parameter_columns : tuple of int
        Columns of all parameters.

    References
    ----------
    Atkinson, Donev and Tobias (2007), Optimum Experimental Designs, with SAS, sections 10.2 and 10.3.
    """

    chosen_columns: tuple[int, ...]
    parameter_columns: tuple[int, ...]

    def column_covariance(self, rows: Array) -> Array:
        """Covariance of all columns' unknowns with the prior, shape (columns, columns)."""
        information = rows.T @ rows
        information[np.diag_indices_from(information)] += _prior(len(information), self.parameter_columns)
        return np.asarray(scipy.linalg.inv(information))

    def value_and_gradient(self, rows: Array, slope: bool = True) -> tuple[float, Array]:
        """In nat, and by the rows."""
        whole, chosen = self.column_covariance(rows), list(self.chosen_columns)
        own = whole[np.ix_(chosen, chosen)]
        found = -0.5 * float(np.linalg.slogdet(own)[1])
        if not slope:
            return found, np.zeros((0, 0))
        # d C = -C d(J'J) C
        wide = whole[:, chosen]
        return found, rows @ (wide @ np.linalg.solve(own, wide.T))


@dataclass(frozen=True)
class EffectDiscrimination:
    """Distance of each effect's change of the readings from what another effect and all free unknowns can imitate.

    d_ij^2 = min_b |J_i a - J_j b|^2, over what j and the nuisances can do; the smaller distances count most:
    -1/2 log sum_ij 1 / (1 + d_ij^2).

    Attributes
    ----------
    amplitude_columns : tuple of tuple of int
        Columns of every effect's amplitudes.
    amplitude_cases : tuple of ndarray, shape (amplitudes, cases)
        Of the amplitudes, in units of the columns: one case where they are known, else one for each.
    parameter_columns : tuple of int
        Columns with a prior: of the nominal parameters and of the effects.
    """

    amplitude_columns: tuple[tuple[int, ...], ...]
    amplitude_cases: tuple[Array, ...]
    parameter_columns: tuple[int, ...]

    def effect_distances(self, rows: Array) -> Array:
        """d_ij in standard deviations of the data, from i (row) to j; the diagonal is infinite."""
        count = len(self.amplitude_columns)
        found = np.full((count, count), np.inf)
        for i in range(count):
            for j in range(count):
                if i != j:
                    found[i, j] = np.sqrt(self._apart(rows, i, j)[0])
        return found

    def value_and_gradient(self, rows: Array, slope: bool = True) -> tuple[float, Array]:
        """In nat, and by the rows."""
        total, by_rows = 0.0, np.zeros_like(rows)
        for i in range(len(self.amplitude_columns)):
            for j in range(len(self.amplitude_columns)):
                if i == j:
                    continue
                square, rest, others, used = self._apart(rows, i, j)
                weight = 1.0 / (1.0 + square)
                total += weight
                if slope:
                    factor = 2.0 * weight**2 / len(self.amplitude_cases[i].T)
                    by_rows[:, list(self.amplitude_columns[i])] += factor * rest @ self.amplitude_cases[i].T
                    by_rows[:, others] -= factor * rest @ used.T
        return -0.5 * float(np.log(total)), 0.5 * by_rows / total if slope else np.zeros((0, 0))

    def _apart(self, rows: Array, i: int, j: int) -> tuple[float, Array, list[int], Array]:
        """Squared distance, what is left of the change by i, the columns of what may explain it, and how they do."""
        away = {column for k, effect in enumerate(self.amplitude_columns) if k != j for column in effect}
        others = [column for column in range(rows.shape[1]) if column not in away]
        change, basis = rows[:, list(self.amplitude_columns[i])] @ self.amplitude_cases[i], rows[:, others]
        prior = _prior(rows.shape[1], self.parameter_columns)[others]
        used = scipy.linalg.solve(basis.T @ basis + np.diag(prior), basis.T @ change, assume_a="pos")
        rest = change - basis @ used
        square = float(np.sum(rest**2) + np.sum(prior[:, None] * used**2)) / change.shape[1]
        return square, rest, others, used

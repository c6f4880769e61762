"""Finished refits, kept so that an interrupted diagnosis can resume."""

from __future__ import annotations

from dataclasses import dataclass

from yid_ocp.solvers import Solution


@dataclass(frozen=True)
class StoredFit:
    """The stored values and standard deviations of a refit. One evaluation restores a `RefittedModel` from them."""

    values: dict[str, float]  # values of all unknowns
    std: dict[str, float]  # inflated by the misfit as in `solve`; infinite if not informed by the data
    p_values: dict[str, float]  # by effect: p-value of its amplitudes, at fixed shape parameters
    solver_message: str  # why the solver ended


class RefitStore:
    """A base class for stores of finished refits, which keeps nothing. Two threads call it."""

    def stored_refit(self, name: str) -> StoredFit | None:
        """Return the refit that is stored under a name, or None."""
        return None

    def put(self, name: str, refitted: StoredFit) -> None:
        """Store a refit under a name."""


NO_REFIT_STORE = RefitStore()
"""Store of a diagnosis that no other one resumes."""


@dataclass(frozen=True)
class NominalSolutionAndRefitStore:
    """The results that an interrupted diagnosis left: the nominal solution and the finished refits."""

    solution: Solution | None = None
    store: RefitStore = NO_REFIT_STORE  # receives every new refit

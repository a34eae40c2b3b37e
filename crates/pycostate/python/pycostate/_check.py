"""What follows from a problem."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


class Check:
    """What follows from a problem.

    Attributes
    ----------
    summary : dict
        What ``costate check --json`` prints.
    P, K : numpy.ndarray
        V = s'Ps/2 and u = u_e - K s about the equilibrium, (states, states) and (controls, states);
        None on a finite horizon.
    eigenvalues : numpy.ndarray
        Of the closed loop at the equilibrium, complex.
    hamiltonian : str
    optimal_control, state_equations, adjoint_equations : dict of str
    """

    def __init__(self, text, summary):
        self.text = text
        self.summary = summary

    def _array(self, name):
        import numpy as np

        given = self.summary[name]
        return None if given is None else np.array(given, dtype=float)

    @property
    def P(self) -> np.ndarray | None:
        return self._array("riccati")

    @property
    def K(self) -> np.ndarray | None:
        return self._array("gain")

    @property
    def eigenvalues(self) -> np.ndarray | None:
        pairs = self._array("closed_loop_eigenvalues")
        return None if pairs is None else pairs[:, 0] + 1j * pairs[:, 1]

    @property
    def hamiltonian(self) -> str:
        return self.summary["hamiltonian"]

    @property
    def optimal_control(self) -> dict:
        return dict(zip(self.summary["controls"], self.summary["optimal_control"]))

    @property
    def state_equations(self) -> dict:
        return dict(zip(self.summary["states"], self.summary["state_equations"]))

    @property
    def adjoint_equations(self) -> dict:
        return dict(zip(self.summary["states"], self.summary["adjoint_equations"]))

    def __repr__(self):
        return self.text.rstrip()

    def _repr_html_(self):
        from html import escape

        return f"<pre>{escape(self.text)}</pre>"

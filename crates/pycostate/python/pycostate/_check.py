"""What follows from a problem."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


class Check:
    """What follows from a problem, as :meth:`Problem.check` tells it: printed it is the ``text`` of
    ``costate check``, and ``summary`` is what ``costate check --json`` prints, as a dict."""

    def __init__(self, text, summary):
        self.text = text
        self.summary = summary

    def _array(self, name):
        import numpy as np

        given = self.summary[name]
        return None if given is None else np.array(given, dtype=float)

    @property
    def P(self) -> np.ndarray | None:
        """V = s'Ps/2 about the equilibrium, s the deviation from it: shape (states, states), in units of V
        by those of the states; None on a finite horizon."""
        return self._array("riccati")

    @property
    def K(self) -> np.ndarray | None:
        """u = u_e - K s there: shape (controls, states), in units of controls by those of the states; None on
        a finite horizon."""
        return self._array("gain")

    @property
    def eigenvalues(self) -> np.ndarray | None:
        """Of the closed loop at the equilibrium: complex, shape (states,), by time; None on a finite horizon."""
        pairs = self._array("closed_loop_eigenvalues")
        return None if pairs is None else pairs[:, 0] + 1j * pairs[:, 1]

    @property
    def hamiltonian(self) -> str:
        """H(x, p, u) as an expression."""
        return self.summary["hamiltonian"]

    @property
    def optimal_control(self) -> dict:
        """u*(x, p) of each control, as expressions."""
        return dict(zip(self.summary["controls"], self.summary["optimal_control"]))

    @property
    def state_equations(self) -> dict:
        """x' of each state, as expressions."""
        return dict(zip(self.summary["states"], self.summary["state_equations"]))

    @property
    def adjoint_equations(self) -> dict:
        """p' of each state, as expressions."""
        return dict(zip(self.summary["states"], self.summary["adjoint_equations"]))

    def __repr__(self):
        return self.text.rstrip()

    def _repr_html_(self):
        from html import escape

        return f"<pre>{escape(self.text)}</pre>"

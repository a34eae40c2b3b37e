"""Feedback laws."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from . import _engine
from ._places import states_of
from .errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from ._problem import Problem


class Law:
    """A feedback law u(x), as :meth:`Problem.fit` or :func:`load_law` makes it.

    >>> law([0.5, -0.2]), law(theta=np.linspace(-1, 1, 11), omega=0.0)

    ``problem`` is that whose states it is of.
    """

    def __init__(self, law, problem):
        self._law = law
        self.problem = problem

    @property
    def name(self) -> str:
        """Its name in the scene's ``[feedback]``."""
        return self._law.name

    @property
    def outputs(self) -> tuple[str, ...]:
        """What it gives: names of controls (or of commanded states)."""
        return tuple(self._law.outputs)

    def __call__(self, x=None, /, **states) -> np.ndarray:
        """What it gives at states.

        Parameters
        ----------
        x : array_like, shape (..., states)
            States, absolute and in the scene's units; or by name, with the usual broadcasting (those
            that are not named are at the equilibrium).

        Returns
        -------
        numpy.ndarray, shape (..., outputs)
            In the controls' units, within their bounds.
        """
        rows, shape = states_of(self.problem, x, states)
        return self._law.eval(rows).reshape(shape + (-1,))

    def to_toml(self) -> str:
        """The weights file's text."""
        return self._law.to_toml()

    def to_c(self, path=None) -> str:
        """A header of C without dependencies; also written to the file ``path``."""
        text = self._law.to_c()
        if path is not None:
            Path(path).write_text(text, encoding="utf-8")
        return text

    def to_onnx(self, path=None) -> bytes:
        """An ONNX model, as bytes; also written to the file ``path``."""
        model = bytes(self._law.to_onnx())
        if path is not None:
            Path(path).write_bytes(model)
        return model

    def to_fmu(self, path, *, compiled=False) -> None:
        """Writes an FMU (FMI 3.0, model exchange and co-simulation): states in, controls out.

        Parameters
        ----------
        path : path
            The file, ``.fmu``; it has the C source inside.
        compiled : bool
            Also the binary for this machine (Linux, with a C compiler).
        """
        from . import _fmu

        header = self.to_c()
        found = re.search(r"static inline void (\w+_u)\(", header)
        if found is None:
            raise InputError(f"law {self.name} commands states ({', '.join(self.outputs)}), not controls")
        scene = self.problem._scene
        _fmu.write(
            path,
            self.name,
            f"{self.name}: {self.problem.title}",
            header,
            f"{found[1]}(x, u);",
            scene.states,
            scene.controls,
            scene.reference,
            compiled,
        )

    def save(self, path) -> None:
        """Writes the file ``path`` by its ending: ``.toml`` (weights), ``.h``, ``.onnx`` or ``.fmu``."""
        ending = Path(path).suffix.lower()
        if ending == ".onnx":
            self.to_onnx(path)
        elif ending == ".h":
            self.to_c(path)
        elif ending == ".fmu":
            self.to_fmu(path)
        elif ending == ".toml":
            Path(path).write_text(self.to_toml(), encoding="utf-8")
        else:
            raise InputError(f"{path}: name a file .toml (weights), .h (C), .onnx or .fmu")

    def __repr__(self):
        return f"<pycostate.Law {self.name!r} of {self.problem.title!r}: {', '.join(self.outputs)}>"


def load_law(path, problem: Problem) -> Law:
    """The law of a weights file (``path``, ``.toml``) for a ``problem`` with its states and controls."""
    path = Path(path)
    text = path.read_text(encoding="utf-8")
    return Law(_engine.Law.parse(path.stem, text, str(path), problem._scene), problem)

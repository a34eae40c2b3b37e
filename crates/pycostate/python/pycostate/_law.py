"""Feedback laws."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import _engine, _files
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

    def __call__(self, x: Any = None, /, **states: Any) -> np.ndarray:
        """What it gives at states.

        Parameters
        ----------
        x : array_like, shape (..., states)
            States, absolute and in the scene's units; or by name, with the usual broadcasting (those
            that are not named are at the equilibrium).

        Returns
        -------
        numpy.ndarray, shape (..., controls)
            In the order of the scene's controls, in their units, within their bounds; of a law that gives
            not all of them, or commanded states, (..., outputs).
        """
        rows, shape = states_of(self.problem, x, states)
        given = self._law.eval(rows).reshape(*shape, len(self.outputs))
        if set(self.outputs) == set(self.problem.controls):
            given = given[..., [self.outputs.index(name) for name in self.problem.controls]]
        return given

    def __reduce__(self):
        return _restored, (self.name, self.to_toml(), self.problem)

    def to_toml(self) -> str:
        """The weights file's text."""
        return self._law.to_toml()

    def to_c(self, path: str | os.PathLike[str] | None = None) -> str:
        """A header of C without dependencies, which gives :attr:`outputs` in their order; also written to
        the file ``path``."""
        return _files.write(path, self._law.to_c())

    def to_onnx(self, path: str | os.PathLike[str] | None = None) -> bytes:
        """An ONNX model, as bytes, which gives :attr:`outputs` in their order; also written to the file ``path``."""
        return _files.write_bytes(path, bytes(self._law.to_onnx()))

    def to_fmu(self, path: str | os.PathLike[str], *, compiled: bool = False) -> None:
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
        # In the order in which the header gives them.
        described = {control[0]: control for control in scene.controls}
        _fmu.write(
            _files._file(path),
            self.name,
            f"{self.name}: {self.problem.title}",
            header,
            f"{found[1]}(x, u);",
            scene.states,
            [described[name] for name in self.outputs],
            scene.reference,
            compiled,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the file ``path`` by its ending: ``.toml`` (weights), ``.h``, ``.onnx`` or ``.fmu``."""
        ending = Path(path).suffix.lower()
        if ending == ".onnx":
            self.to_onnx(path)
        elif ending == ".h":
            self.to_c(path)
        elif ending == ".fmu":
            self.to_fmu(path)
        elif ending == ".toml":
            _files.write(path, self.to_toml())
        else:
            raise InputError(f"{path}: name a file .toml (weights), .h (C), .onnx or .fmu")

    def __repr__(self):
        return f"<pycostate.Law {self.name!r} of {self.problem.title!r}: {', '.join(self.outputs)}>"


def load_law(path: str | os.PathLike[str], problem: Problem) -> Law:
    """The law of a weights file (``path``, ``.toml``) for a ``problem`` with its states and controls."""
    file = Path(path)
    if not hasattr(problem, "_scene"):
        raise InputError(f"problem = {problem!r}: a Problem is needed")
    if file.suffix.lower() in (".onnx", ".fmu", ".h", ".h5"):
        raise InputError(f"{path}: a law is read from its weights file, .toml")
    try:
        text = file.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{path} is no weights file (.toml)") from None
    return Law(_engine.Law.parse(file.stem, text, str(path), problem._scene), problem)


def _restored(name, text, problem):
    """A law that was pickled."""
    return Law(_engine.Law.parse(name, text, name, problem._scene), problem)

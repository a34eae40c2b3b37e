"""What may go wrong."""

from __future__ import annotations

import contextlib
import os
import sys
import warnings

__all__ = [
    "CostateError",
    "CostateWarning",
    "InputError",
    "Interrupted",
    "OutOfTime",
    "SceneError",
]


class CostateError(Exception):
    """Something could not be done."""


class InputError(CostateError, ValueError):
    """What was given is at fault; the message says how to mend it."""


class SceneError(InputError):
    """A scene is at fault.

    The message is what ``costate check`` prints, with the text underlined.

    Attributes
    ----------
    file : str
        The scene's file.
    problems : list of dict
        Each with ``message``, ``line`` and ``column`` (from 1; None where no place is at fault) and
        ``help`` (None where there is none).
    line, column : int or None
        Those of the first problem that has a place.
    """

    def __init__(self, text: str, file: str = "", problems: list | None = None):
        super().__init__(text)
        self.file = file
        self.problems = problems or []
        placed = [p for p in self.problems if p["line"] is not None]
        self.line = placed[0]["line"] if placed else None
        self.column = placed[0]["column"] if placed else None

    def __reduce__(self):
        return type(self), (self.args[0], self.file, self.problems)


class OutOfTime(CostateError, TimeoutError):
    """The time limit has come before there was anything to show."""


class Interrupted(KeyboardInterrupt):
    """Ctrl-C has ended a computation; what was done by then is in ``result``.

    Attributes
    ----------
    result : xarray.Dataset, xarray.DataTree or None
        What is done, as the call would have returned it; states that are not solved have the status
        ``out_of_time``.
    """

    def __init__(self, message: str = "", result=None):
        super().__init__(message)
        self.result = result


class CostateWarning(UserWarning):
    """A remark that a run makes: the computation goes on, and its result is to be read with it."""


def warn(text: str) -> None:
    """Warns whoever has called the package."""
    here, between = os.path.dirname(__file__), contextlib.__file__
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and (
        os.path.dirname(frame.f_code.co_filename) == here or frame.f_code.co_filename == between
    ):
        frame, level = frame.f_back, level + 1
    warnings.warn(text, CostateWarning, stacklevel=level)

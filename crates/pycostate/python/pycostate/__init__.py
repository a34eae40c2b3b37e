"""Value functions and optimal feedback of nonlinear systems, as labelled arrays.

>>> import pycostate
>>> p = pycostate.Problem.load("pendulum.toml")
>>> ds = p.solve(theta=[0.5, 1.0], omega=0.0)   # an xarray.Dataset
>>> v = p.value(p.map(error=1e-3))              # V(x), v.p(x), v.u(x)
"""

from __future__ import annotations

import sys as _sys

from . import _pictures, errors
from ._check import Check
from ._command import adapters, check_least, command, import_urdf
from ._law import Law, load_law
from ._problem import Problem
from ._reports import Report, open, report
from ._value import Value
from .errors import (
    CostateError,
    CostateWarning,
    InputError,
    Interrupted,
    OutOfTime,
    SceneError,
)

__all__ = [
    "Check",
    "CostateError",
    "CostateWarning",
    "InputError",
    "Interrupted",
    "Law",
    "OutOfTime",
    "Problem",
    "Report",
    "SceneError",
    "Value",
    "adapters",
    "check_least",
    "command",
    "errors",
    "import_urdf",
    "load_law",
    "main",
    "open",
    "report",
]


if "xarray" in _sys.modules:
    # Else it is made when the first result is.
    _pictures.register()


def main() -> None:
    """The command ``costate``."""
    from ._engine import run_command

    _sys.exit(run_command(["costate", *_sys.argv[1:]]))


def __getattr__(name):
    if name == "__version__":
        from importlib.metadata import version

        return version("pycostate")
    raise AttributeError(f"module 'pycostate' has no attribute {name!r}")

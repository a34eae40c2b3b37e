"""Options of calls, and what is wrong with them."""

from __future__ import annotations

import difflib
import math
import numbers
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal, TypedDict

from .errors import CostateError, InputError, warn


class Numerics(TypedDict, total=False):
    """The options of `Problem.using`."""

    backend: Literal["auto", "cpu", "gpu"]
    adapter: str | None
    precision: Literal["f64", "f32"] | None
    method: Literal["rk4", "tsit5", "dop853", "taylor"] | None
    rtol: float | None
    seed: int
    time_limit: float | None
    progress: bool | Callable[[str | None], object] | None


NUMERICS: dict[str, Any] = {
    "backend": "auto",
    "adapter": None,
    "precision": None,
    "method": None,
    "rtol": None,
    "seed": 0,
    "time_limit": None,
    "progress": None,
}
_CHOICES = {
    "backend": ("auto", "cpu", "gpu"),
    "precision": ("f64", "f32"),
    "method": ("rk4", "tsit5", "dop853", "taylor"),
}
#: The process that has computed first: threads do not survive a fork.
_process: int | None = None


def number(name: str, value, *, low=-math.inf, high=math.inf) -> float:
    """A finite number above ``low`` and at most ``high``."""
    if isinstance(value, (str, bytes)) or not hasattr(value, "__float__"):
        raise InputError(f"{name} = {value!r}: a number is needed")
    value = float(value)
    if not (low < value <= high and math.isfinite(value)):
        above = f" above {low:g}" if low > -math.inf else ""
        most = f", at most {high:g}" if high < math.inf else ""
        raise InputError(f"{name} = {value:g}: a finite number{above}{most}")
    return value


def whole(name: str, value, low: int = 0, high: int = 10_000_000) -> int:
    """A whole number from ``low`` to ``high``."""
    whole_ = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not whole_ or not low <= int(value) <= high:
        raise InputError(f"{name} = {value!r}: a whole number from {low} to {high}")
    return int(value)


def yes(name: str, value) -> bool:
    """True or False."""
    if value not in (True, False):
        raise InputError(f"{name} = {value!r}: True or False")
    return bool(value)


def words(value) -> list[str]:
    """A list of names; one alone is a list of one."""
    return [value] if isinstance(value, str) else list(value)


def path(name: str, value) -> str:
    try:
        return os.fspath(value)
    except TypeError:
        raise InputError(f"{name} = {value!r}: a path is needed") from None


def out(value) -> str | None:
    """Where a result file goes, whatever the working folder is then."""
    if value is None:
        return None
    name = path("out", value)
    ending = os.path.splitext(name)[1].lower()
    if ending in (".csv", ".txt", ".json", ".toml", ".zarr", ".parquet"):
        raise InputError(
            f"out = {name}: a result file is HDF5, name it .h5 (ds.to_dataframe() makes a table of a result)"
        )
    return os.path.abspath(name)


def known(given: Mapping[str, Any], states: Sequence[str] = ()) -> dict[str, Any]:
    """The options of `Problem.using` among what was given by name."""
    done = {}
    for name, value in given.items():
        if name not in NUMERICS:
            near = difflib.get_close_matches(name, [*states, *NUMERICS], 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            of_states = f"no state ({', '.join(states)}) and " if states else ""
            raise TypeError(f"{name} is {of_states}no option ({', '.join(NUMERICS)}){hint}")
        if name in _CHOICES and not (value is None and name != "backend"):
            if value not in _CHOICES[name]:
                raise InputError(f"{name} = {value!r}: one of {', '.join(_CHOICES[name])}")
        elif name == "adapter" and not (value is None or isinstance(value, str)):
            raise InputError(f"adapter = {value!r}: a part of its name")
        elif name == "rtol" and value is not None:
            value = number(name, value, low=0.0, high=0.5)
        elif name == "time_limit" and value is not None:
            value = number(name, value, low=0.0)
        elif name == "progress" and not (value in (None, True, False) or callable(value)):
            raise InputError(f"progress = {value!r}: True, or a function of a text")
        elif name == "seed":
            value = whole(name, value, 0, 2**64 - 1)
        done[name] = value
    return done


def in_first_process() -> None:
    """Refuses to compute in a process that was forked from one that has computed."""
    global _process
    if _process is None:
        _process = os.getpid()
    elif _process != os.getpid():
        raise CostateError(
            "this process was forked from one in which pycostate had computed, whose threads it does not have: "
            "use multiprocessing.get_context('spawn'), or fork first"
        )


def _shown(wanted):
    """A callable for the steps of a computation, and what ends it."""
    if wanted is None or wanted is False:
        return None, lambda: None
    if callable(wanted):
        return wanted, lambda: None
    try:
        from tqdm.auto import tqdm
    except ModuleNotFoundError:
        warn("progress is shown by tqdm, which is not installed (pip install pycostate[progress])")
        return None, lambda: None
    bar = tqdm(bar_format="{desc} [{elapsed}]", leave=False)

    def show(step):
        bar.set_description_str(step or "", refresh=True)

    return show, bar.close


@contextmanager
def how(options: dict):
    """How to compute, and who is told, for the engine."""
    in_first_process()
    progress, close = _shown(options["progress"])
    # The Vulkan loader complains on standard error where this is unset, though nothing needs it.
    lacks = os.name == "posix" and options["backend"] != "cpu" and "XDG_RUNTIME_DIR" not in os.environ
    if lacks:
        os.environ["XDG_RUNTIME_DIR"] = tempfile.gettempdir()
    try:
        yield {**options, "progress": progress, "note": warn}
    finally:
        close()
        if lacks:
            os.environ.pop("XDG_RUNTIME_DIR", None)

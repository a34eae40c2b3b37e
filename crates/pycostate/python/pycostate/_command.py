"""What only the command has, as calls: it runs in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from . import _engine
from .errors import CostateError, InputError, OutOfTime, warn

_ERRORS = {2: InputError, 75: OutOfTime}


def command(*arguments) -> str:
    """Runs ``costate`` with ``arguments`` and returns what it prints.

    >>> print(pycostate.command("reference", "scene"))

    Raises :class:`InputError` where it ends with the status 2, :class:`OutOfTime` with 75, and
    :class:`CostateError` with another, with what it says. Ctrl-C ends it, too.
    """
    return _ended(_run(arguments))


def _run(arguments) -> subprocess.CompletedProcess:
    words = [os.fspath(a) if isinstance(a, os.PathLike) else str(a) for a in arguments]
    return subprocess.run(
        [sys.executable, "-m", "pycostate", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        check=False,
    )


def _ended(done: subprocess.CompletedProcess, *, of_python: bool = False) -> str:
    if done.returncode:
        said = done.stderr.strip().removeprefix("error: ")
        said = _engine.in_python(said) if of_python else said
        raise _ERRORS.get(done.returncode, CostateError)(said or f"exit status {done.returncode}")
    return done.stdout


def spoken(*arguments) -> str:
    """The same with messages in Python's words."""
    return _ended(_run(arguments), of_python=True)


def of_json(*arguments) -> Any:
    """The same with ``--json``, as dicts and lists."""
    return json.loads(spoken(*arguments, "--json"))


def adapters() -> list[dict]:
    """The GPU adapters that there are: name, api, driver, kind, hardware, f64 and sizes in bytes."""
    return of_json("adapters")


def import_urdf(robot, out=None):
    """A scene's text of a ``robot`` in URDF (a file), with remarks as warnings; also written to ``out``."""
    from . import _files

    with tempfile.TemporaryDirectory(dir=_files.folder()) as folder:
        path = Path(folder, "robot.toml") if out is None else Path(out)
        summary = of_json("import", robot, "--out", path)
        for note in summary.get("notes", []):
            warn(note)
        return path.read_text(encoding="utf-8")


def check_least(result, *, nodes=(), margin=None, seconds=None, apart=None, backend="auto") -> dict:
    """Asks a second method, V on a grid (dynamic programming), whether V at the solved states of a
    result is the least: what ``costate check-least --json`` prints, with ``not_least`` True where the
    grid found something cheaper.

    Parameters
    ----------
    result : path, Dataset or DataTree
        With solved states.
    nodes : int or list of int
        Of the grid along each axis.
    margin : float
        Widths of the region by which the grid goes beyond it.
    seconds : float
        For the grid.
    apart : float
        The grid and V are apart where they differ by more than this share of V.
    backend : {"auto", "cpu", "gpu"}
    """
    from . import _files

    file = _files.file_of(result)
    given = {"--margin": margin, "--seconds": seconds, "--apart": apart, "--backend": backend}
    options = [str(w) for pair in given.items() if pair[1] is not None for w in pair]
    nodes = [nodes] if hasattr(nodes, "__index__") else list(nodes)
    if nodes:
        options += ["--nodes", ",".join(map(str, nodes))]
    done = _run(["check-least", file.path, *options, "--json"])
    # 1 with an answer: V is not the least somewhere.
    found = done.returncode == 1 and done.stdout.lstrip().startswith(("{", "["))
    answer = json.loads(done.stdout if found else _ended(done, of_python=True))
    answer["not_least"] = found
    return answer


def scene_file(problem, folder) -> tuple[Path, list[str]]:
    """The file of a problem, and the options that set its parameters; one of its own where the text is no file's."""
    path = Path(problem._scene.file_name)
    try:
        same = path.read_text(encoding="utf-8") == problem.text
    except (OSError, UnicodeDecodeError):
        same = False
    if not same:
        path = Path(folder, path.name or "problem.toml")
        path.write_text(problem.text, encoding="utf-8")
    options = [word for name, value in problem._scene.set for word in ("--set", f"{name}={value}")]
    return path, options

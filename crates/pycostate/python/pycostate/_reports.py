"""Result files, and their reports."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from . import _engine, _files, _options
from .errors import InputError

if TYPE_CHECKING:
    import xarray as xr


def open(path) -> xr.DataTree:
    """The result file ``path`` as an ``xarray.DataTree``: its groups, by the names of the file."""
    if not Path(path).exists():
        raise FileNotFoundError(f"{path} is not there")
    # What is no result file is told with its reason.
    _engine.scene_of_file(os.fspath(path))
    return _files.tree(_files.ResultFile(path))


class Report:
    """A ``page`` of HTML with ``pictures`` (their names) and what is ``missing`` (with reasons); a
    notebook shows it."""

    def __init__(self, page, pictures, missing):
        self.page = Path(page)
        self.pictures = list(pictures)
        self.missing = dict(missing)
        #: What it was made of, which it keeps.
        self.file: _files.ResultFile | None = None

    @property
    def html(self) -> str:
        """The page's text."""
        return self.page.read_text(encoding="utf-8")

    def _repr_html_(self):
        from html import escape

        return f'<iframe srcdoc="{escape(self.html, quote=True)}" width="100%" height="800" style="border:0"></iframe>'

    def __repr__(self):
        return f"<pycostate.Report {self.page}: {', '.join(self.pictures)}>"


def report(result, page=None, *, axes=None, slice=None, levels=(), width=None) -> Report:
    """The report of a result: a page of HTML, and its pictures beside it.

    Parameters
    ----------
    result : path, Dataset or DataTree
    page : path
        Where it goes; default: beside the result file.
    axes : pair of str
        The states of the plane that is shown.
    slice : dict of float
        Where the plane lies.
    levels : list of float
        Contours of V.
    width : int
        Of the pictures, in pixels.
    """
    _options.in_first_process()
    if isinstance(levels, (int, float)):
        levels = [levels]
    axes = None if axes is None else _options.words(axes)
    if axes is not None and len(axes) != 2:
        raise InputError(f"axes = {axes}: two states")
    file = _files.file_of(result)
    page = file.path.with_name(file.path.stem + "_report.html") if page is None else Path(page)
    made = _engine.report(
        file.path,
        page,
        axes=axes,
        slice=[(k, _options.number(f"slice of {k}", v)) for k, v in (slice or {}).items()],
        levels=[_options.number("levels", v) for v in levels],
        width=None if width is None else _options.whole("width", width, 100, 10_000),
    )
    done = Report(*made)
    done.file = file
    return done

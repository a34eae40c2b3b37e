"""Result files as labelled arrays: the names are the file's."""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from pathlib import Path

from . import _pictures
from .errors import InputError

_KEY = "pycostate"
#: Attributes of HDF5 that say how dimensions hang together: xarray knows that itself.
_PLUMBING = {"CLASS", "NAME", "REFERENCE_LIST", "DIMENSION_LIST", "_FillValue"}


class ResultFile:
    """A result file that lives as long as something made of it; one of ours is then removed."""

    __slots__ = ("path", "_folder", "__weakref__")

    def __init__(self, path, folder: str | None = None):
        self.path = Path(path)
        self._folder = folder
        if folder is not None:
            weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)

    def __repr__(self):
        return f"ResultFile({str(self.path)!r})"

    def __deepcopy__(self, memo):
        return self

    def __copy__(self):
        return self

    def __reduce__(self):
        # Elsewhere only a file with a name of its own is there.
        return ResultFile, (self.path,)


class Target:
    """Where a result goes: a file that the user has named, or one of ours."""

    def __init__(self, out):
        self.folder = tempfile.mkdtemp(prefix="pycostate-") if out is None else None
        self.path = os.path.join(self.folder, "result.h5") if out is None else os.fspath(out)

    def file(self, path=None) -> ResultFile:
        folder, self.folder = self.folder, None
        return ResultFile(path or self.path, folder)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)


def _attribute(value):
    if isinstance(value, bytes):
        return value.decode()
    if hasattr(value, "ndim") and value.ndim == 0:
        return value.item()
    return value


def _attributes(item) -> dict:
    return {k: _attribute(v) for k, v in item.attrs.items() if k not in _PLUMBING}


def _variable(dataset):
    import h5py
    import xarray as xr

    dimensions = []
    for axis, dimension in enumerate(dataset.dims):
        # A scale is its own dimension.
        own = dimension[0].name if len(dimension) else dataset.name
        dimensions.append(own.rsplit("/", 1)[-1])
    if h5py.check_string_dtype(dataset.dtype) is not None:
        data = dataset.asstr()[()].astype(object)
    else:
        data = dataset[()]
    return xr.Variable(dimensions, data, _attributes(dataset))


def _dataset(group):
    import xarray as xr

    variables = {name: _variable(item) for name, item in group.items()}
    names = {d for v in variables.values() for d in v.dims}

    def is_coordinate(name):
        # Axes, and what is said of them.
        return name in names or name.endswith(("_units", "_long_name"))

    coordinates = {k: v for k, v in variables.items() if is_coordinate(k)}
    return xr.Dataset(
        {k: v for k, v in variables.items() if k not in coordinates},
        coords=coordinates,
        attrs=_attributes(group),
    )


def _held(thing, file: ResultFile):
    _pictures.register()
    thing.encoding = {"source": str(file.path), _KEY: file}
    return thing


def dataset(file: ResultFile, name: str):
    """A group as an ``xarray.Dataset``; the root's attributes come after its own."""
    import h5py

    with h5py.File(file.path) as stored:
        if name not in stored:
            there = ", ".join(stored) or "none"
            raise InputError(f"{file.path} has no group /{name} (there: {there})")
        made = _dataset(stored[name])
        made.attrs = {**_attributes(stored), **made.attrs}
    return _held(made, file)


def tree(file: ResultFile):
    """The whole file as an ``xarray.DataTree``."""
    import h5py
    import xarray as xr

    with h5py.File(file.path) as stored:
        root = xr.Dataset(attrs=_attributes(stored))
        groups = {name: _held(_dataset(group), file) for name, group in stored.items()}
    made = xr.DataTree.from_dict({"/": _held(root, file), **groups})
    made.encoding = root.encoding
    return made


def has(file: ResultFile, name: str) -> bool:
    import h5py

    with h5py.File(file.path) as stored:
        return name in stored


def file_of(thing) -> ResultFile:
    """The result file that something was made of: a path, or a Dataset or DataTree of ours."""
    if isinstance(thing, ResultFile):
        return thing
    if isinstance(thing, (str, os.PathLike)):
        return ResultFile(thing)
    encoding = getattr(thing, "encoding", {}) or {}
    if _KEY in encoding:
        return encoding[_KEY]
    if str(encoding.get("source", "")).endswith(".h5"):
        return ResultFile(encoding["source"])
    raise InputError(
        "what is needed here is a result file: its path, or the Dataset or DataTree as pycostate has made it "
        "(parts and results of arithmetic no longer know where they come from)"
    )

"""Result files as labelled arrays: the names are the file's."""

from __future__ import annotations

import _thread
import atexit
import builtins
import glob
import os
import shutil
import tempfile
import threading
import time
import weakref
from pathlib import Path

from . import _pictures
from .errors import InputError

_KEY = "pycostate"
_PREFIX, _LOCK = "pycostate-", "in_use"
#: Attributes of HDF5 that say how dimensions hang together: xarray knows that itself.
_PLUMBING = {"CLASS", "NAME", "REFERENCE_LIST", "DIMENSION_LIST", "_FillValue"}


class _Folder:
    """The folder of a process for results without a name of their own. It is locked while the process
    lives, so that what a killed one has left is seen by others, and removed."""

    def __init__(self):
        self.pid = os.getpid()
        self.path = tempfile.mkdtemp(prefix=_PREFIX)
        self._lock = builtins.open(os.path.join(self.path, _LOCK), "w")
        _lock(self._lock)
        atexit.register(self.remove)
        for other in glob.glob(os.path.join(tempfile.gettempdir(), _PREFIX + "*", _LOCK)):
            _remove_dead(other)

    def remove(self):
        if self.pid == os.getpid():
            self._lock.close()
            shutil.rmtree(self.path, ignore_errors=True)


def _lock(file) -> bool:
    """Whether nobody else holds it."""
    try:
        import fcntl
    except ModuleNotFoundError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _remove_dead(lock: str) -> None:
    try:
        # It may not be locked yet.
        if time.time() - os.path.getmtime(lock) < 60:
            return
        with builtins.open(lock, "r+") as file:
            if _lock(file):
                shutil.rmtree(os.path.dirname(lock), ignore_errors=True)
    except OSError:
        pass


_folder: _Folder | None = None


def folder() -> str:
    """A new folder, for a result of this process."""
    global _folder
    if _folder is None or _folder.pid != os.getpid():
        _folder = _Folder()
    return tempfile.mkdtemp(dir=_folder.path)


def remove(path: str, process: int | None = None) -> None:
    """Removes a folder, also where Ctrl-C comes meanwhile. ``process``: whose it is."""
    if process not in (None, os.getpid()):
        return
    try:
        shutil.rmtree(path, ignore_errors=True)
    except KeyboardInterrupt:
        shutil.rmtree(path, ignore_errors=True)
        # An exception here would be heard by nobody.
        threading.Timer(0.01, _thread.interrupt_main).start()


def _stamp(path):
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


def _record(path):
    """What tells the run that has made a file from others, whatever is added to the file later."""
    import h5py

    try:
        with h5py.File(path) as stored:
            names = ("created", "wall_seconds", "scenario", "set", "command")
            return tuple(str(_attribute(stored.attrs.get(name, ""))) for name in names)
    except OSError:
        return None


class ResultFile:
    """A result file that lives as long as something made of it; one of ours is then removed."""

    __slots__ = ("__weakref__", "_folder", "_record", "_stamp", "path")

    def __init__(self, path, folder: str | None = None, record=None):
        self.path = Path(os.path.abspath(path))
        self._folder = folder
        self._stamp = None if record else _stamp(self.path)
        self._record = record or _record(self.path)
        if folder is not None:
            weakref.finalize(self, remove, folder, os.getpid())

    def same(self) -> ResultFile:
        """This, if it is what it was, but for laws and evaluations that were added."""
        stamp = _stamp(self.path)
        if stamp is None:
            if self._record is not None:
                raise InputError(f"{self.path} is no longer there")
        elif stamp != self._stamp:
            if self._record is not None and _record(self.path) != self._record:
                raise InputError(
                    f"{self.path} is another file by now than the one that this was made of: pycostate.open reads it again"
                )
            self._stamp = stamp
        return self

    def __repr__(self):
        return f"ResultFile({str(self.path)!r})"

    def __deepcopy__(self, memo):
        return self

    def __copy__(self):
        return self

    def __reduce__(self):
        # Elsewhere only a file with a name of its own is there.
        return ResultFile, (self.path, None, self._record)


class Target:
    """Where a result goes: a file that the user has named, or one of ours."""

    def __init__(self, out):
        self.folder = folder() if out is None else None
        self.path = os.path.join(self.folder, "result.h5") if out is None else out

    def file(self, path=None) -> ResultFile:
        folder, self.folder = self.folder, None
        return ResultFile(path or self.path, folder)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.folder is not None:
            remove(self.folder)


def _attribute(value):
    if isinstance(value, bytes):
        return value.decode()
    if hasattr(value, "ndim") and value.ndim == 0:
        return value.item()
    return value


def _attributes(item) -> dict:
    return {k: _attribute(v) for k, v in item.attrs.items() if k not in _PLUMBING}


def _variable(dataset, later=None):
    """``later``: what makes an array that is not read yet, or None where it is small."""
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
        data = None if later is None else later(dataset)
        data = dataset[()] if data is None else data
    return xr.Variable(dimensions, data, _attributes(dataset))


def _dataset(group, later=None):
    import xarray as xr

    variables = {name: _variable(item, later) for name, item in group.items()}
    names = {d for v in variables.values() for d in v.dims}

    def is_coordinate(name):
        # Axes, and what is said of them.
        return name in names or name.endswith(("_units", "_long_name"))

    coordinates = {k: v.load() for k, v in variables.items() if is_coordinate(k)}
    return xr.Dataset(
        {k: v for k, v in variables.items() if k not in coordinates},
        coords=coordinates,
        attrs=_attributes(group),
    )


def _held(thing, file: ResultFile):
    _pictures.register()
    thing.encoding = {"source": str(file.path), _KEY: file}
    return thing


def dataset(file: ResultFile, name: str, later=None):
    """A group as an ``xarray.Dataset``; the root's attributes come after its own."""
    import h5py

    with h5py.File(file.path) as stored:
        if name not in stored:
            there = ", ".join(stored) or "none"
            raise InputError(f"{file.path} has no group /{name} (there: {there})")
        made = _dataset(stored[name], later)
        made.attrs = {**_attributes(stored), **made.attrs}
    return _held(made, file)


class _Later:
    """An array of a result file that is read when it is wanted."""

    def __init__(self, path, dataset):
        self.path, self.name = str(path), dataset.name
        self.shape, self.dtype, self.ndim = dataset.shape, dataset.dtype, dataset.ndim

    def __getitem__(self, key):
        import h5py

        with h5py.File(self.path) as stored:
            return stored[self.name][key]


#: Numbers of an array from which on it is read later, and about as many of a piece.
_LARGE, _PIECE = 4096, 1 << 20


def lazy(file: ResultFile, name: str):
    """The same as :func:`dataset`, with arrays of Dask that read the file when they are computed."""
    import dask.array

    def later(item):
        if item.size < _LARGE:
            return None
        inner = item.size // item.shape[0]
        chunks = (max(1, _PIECE // max(inner, 1)), *item.shape[1:])
        return dask.array.from_array(_Later(file.path, item), chunks=chunks, asarray=True, name=False)

    return dataset(file, name, later)


def tree(file: ResultFile):
    """The whole file as an ``xarray.DataTree``."""
    import h5py
    import xarray as xr

    with h5py.File(file.path) as stored:
        groups = {name: _held(_dataset(item), file) for name, item in stored.items() if isinstance(item, h5py.Group)}
        # What xarray has written has variables here.
        loose = {name: _variable(item) for name, item in stored.items() if isinstance(item, h5py.Dataset)}
        root = xr.Dataset(loose, attrs=_attributes(stored))
    made = xr.DataTree.from_dict({"/": _held(root, file), **groups})
    made.encoding = root.encoding
    return made


def root(file: ResultFile):
    """The root's attributes alone, as a Dataset."""
    return tree(file).to_dataset()


def write(path, text: str) -> str:
    """Writes a text to a file, if there is one to be; the text."""
    if path is not None:
        _file(path).write_text(text, encoding="utf-8")
    return text


def write_bytes(path, data: bytes) -> bytes:
    if path is not None:
        _file(path).write_bytes(data)
    return data


def _file(path) -> Path:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def has(file: ResultFile, name: str) -> bool:
    import h5py

    with h5py.File(file.path) as stored:
        return name in stored


def file_of(thing) -> ResultFile:
    """The result file that something was made of: a path, or a Dataset or DataTree of ours."""
    if isinstance(thing, ResultFile):
        return thing.same()
    if isinstance(thing, (str, os.PathLike)):
        return ResultFile(thing)
    encoding = getattr(thing, "encoding", {}) or {}
    if _KEY in encoding:
        return encoding[_KEY].same()
    if str(encoding.get("source", "")).endswith(".h5"):
        return ResultFile(encoding["source"])
    raise InputError(
        "what is needed here is a result: the path of its file, or a Dataset or DataTree as pycostate has made it"
    )


def said(file: ResultFile) -> dict:
    """The summary in a result file."""
    import json

    import h5py

    with h5py.File(file.path) as stored:
        return json.loads(_attribute(stored.attrs.get("summary", "{}")))

"""The engine: what pycostate is made of. It promises nothing."""

from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

_Path = str | PathLike[str]
_Set = list[tuple[str, str]]
# The file, a summary as JSON, whether it was ended before all was done, and what ended it.
_Written = tuple[str, str, bool, BaseException | None]

class Scene:
    text: str
    file_name: str
    set: _Set
    title: str
    states: list[tuple[str, str, str]]
    controls: list[tuple[str, str, str]]
    parameters: list[tuple[str, float]]
    reference: list[float]
    region: list[list[float]]
    time: tuple[str, float | None]
    laws: list[str]
    @staticmethod
    def load(path: _Path, set: _Set) -> Scene: ...
    @staticmethod
    def parse(text: str, name: str, set: _Set) -> Scene: ...
    def check(self) -> tuple[str, str, list[str]]: ...
    def is_taken(self, name: str) -> bool: ...
    def no_axis(self) -> str | None: ...
    def simulation(self) -> tuple[list[float], float | None, int, int, int | None]: ...
    def local_to_c(self, name: str, degree: int) -> str: ...

class Law:
    name: str
    outputs: list[str]
    @staticmethod
    def parse(name: str, text: str, file: str, scene: Scene) -> Law: ...
    def eval(self, x: NDArray[np.float64]) -> NDArray[np.float64]: ...
    def to_toml(self) -> str: ...
    def to_c(self) -> str: ...
    def to_onnx(self) -> bytes: ...

class Value:
    file: str
    scene: Scene
    has_time: bool
    def __init__(self, file: _Path) -> None: ...
    def to_c(self, name: str) -> str: ...
    @staticmethod
    def statuses() -> list[tuple[int, str]]: ...
    def many(self, x: NDArray[np.float64]) -> dict[str, NDArray[Any]]: ...
    def at(
        self, x: NDArray[np.float64], t: NDArray[np.float64], errors: bool
    ) -> dict[str, NDArray[Any]]: ...
    def write(
        self,
        out: _Path,
        x: NDArray[np.float64],
        t: NDArray[np.float64],
        axes: list[list[float]] | None = None,
    ) -> str: ...

class MapWorker:
    def __init__(self, scene: Scene, how: dict[str, Any]) -> None: ...
    def work(self, task: bytes) -> bytes: ...

def run_command(arguments: list[str]) -> int: ...
def in_python(text: str) -> str: ...
def scene_of_file(file: _Path) -> Scene: ...
def run(
    scene: Scene,
    what: str,
    out: _Path,
    how: dict[str, Any],
    x: NDArray[np.float64] | None = None,
    *,
    one_sheet: bool = False,
    samples: int | None = None,
    grid_guesses: bool = False,
    kept: str = "all",
    shard: tuple[int, int] | None = None,
    workers: Any = None,
) -> _Written: ...
def merge(parts: list[_Path], out: _Path, partial: bool) -> tuple[str, list[int], list[int]]: ...
def shard_owner(units: int, of: int) -> list[int]: ...
def study(scene: Scene, out: _Path, how: dict[str, Any]) -> _Written: ...
def attenuation(scene: Scene, out: _Path, how: dict[str, Any]) -> _Written: ...
def simulate(
    scene: Scene,
    out: _Path,
    how: dict[str, Any],
    x: NDArray[np.float64] | None = None,
    *,
    time: float | None = None,
    events: int | None = None,
    samples: int | None = None,
    law: str | None = None,
    weights: tuple[str, str] | None = None,
    cycle: int | None = None,
) -> _Written: ...
def evaluate(
    scene: Scene,
    out: _Path,
    how: dict[str, Any],
    stored: _Path | None = None,
    *,
    laws: list[str] | None = None,
    weights: list[tuple[str, str]] = ...,
    random: int | None = None,
    solve: bool = False,
) -> _Written: ...
def fit(
    scene: Scene,
    file: _Path,
    directory: _Path,
    how: dict[str, Any],
    *,
    names: list[str] | None = None,
    starts: int | None = None,
    seed: int | None = None,
) -> tuple[list[Law], list[str], BaseException | None]: ...
def report(
    file: _Path,
    page: _Path,
    *,
    axes: list[str] | None = None,
    slice: list[tuple[str, float]] = ...,
    levels: list[float] = ...,
    width: int | None = None,
) -> tuple[str, list[str], list[tuple[str, str]]]: ...

class System:
    events: list[str]
    guards: list[str]
    sizes: list[float]
    bounds: list[tuple[float, float]]
    def __init__(self, scene: Scene) -> None: ...
    def rates(self, x: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]: ...
    def conditions(self, x: NDArray[np.float64], u: NDArray[np.float64]) -> NDArray[np.float64]: ...
    def write(self, out: _Path, flown: dict[str, Any]) -> str: ...
    def jump(self, event: int, x: list[float]) -> tuple[list[float], bool] | None: ...

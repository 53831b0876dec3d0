"""What every reconstructor is given: two boolean grids, checked once, and the volume that claims nothing."""

from __future__ import annotations

import io
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from tslam_bench import grids
from tslam_bench.constants import GRID_SIZE
from tslam_bench.errors import InvalidInputError
from tslam_bench.files import read_plain_file
from tslam_bench.reconstruction.volume import Volume

GRID_SHAPE = (GRID_SIZE,) * 3
_MAX_SIZE = 64 * 2**20
_REMEDY = "give an .npz file with the arrays 'touched' and 'visited'"


def check_grid(grid: NDArray, name: str) -> NDArray[np.bool_]:
    """Returns ``grid`` as (32, 32, 32) bool.

    Raises:
        InvalidInputError: another shape, or values other than 0 and 1.
    """
    grid = np.asarray(grid)
    if grid.shape != GRID_SHAPE:
        raise InvalidInputError(f"{name}: shape {grid.shape}; expected {GRID_SHAPE}")
    if grid.dtype != np.bool_ and not np.isin(grid, (0, 1)).all():
        raise InvalidInputError(f"{name}: holds values other than 0 and 1; give a boolean grid")
    return grid.astype(bool)


def check_grids(touched: NDArray, visited: NDArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Both grids through :func:`check_grid`."""
    return check_grid(touched, "touched"), check_grid(visited, "visited")


def empty_volume() -> Volume:
    """The volume that is solid nowhere."""
    return Volume(np.zeros(GRID_SHAPE, dtype=np.float32), "nearest")


def read_grids(path: Path) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Touched and visited grids of an ``.npz`` file with the arrays ``touched`` and, optionally, ``visited``.

    Each is (32, 32, 32) of 0 and 1, or (4096,) uint8 of packed bits (:func:`tslam_bench.grids.pack`). Without
    ``visited``, the visited grid is empty.

    Raises:
        InvalidInputError: the file cannot be read, lacks ``touched``, or an array has another form.
    """
    data = read_plain_file(path, _MAX_SIZE)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in ("touched", "visited") if name in file.files}
    except (OSError, ValueError, EOFError, BadZipFile, AttributeError, TypeError) as error:
        raise InvalidInputError(f"{path}: not an .npz file of plain arrays; {_REMEDY}") from error
    if "touched" not in arrays:
        raise InvalidInputError(f"{path}: has no array 'touched'; {_REMEDY}")
    arrays.setdefault("visited", np.zeros(GRID_SHAPE, dtype=bool))
    read = []
    for name, array in arrays.items():
        try:
            read.append(grids.unpack(array) if array.ndim == 1 else check_grid(array, name))
        except InvalidInputError as error:
            raise InvalidInputError(f"{path}: {name}: {error}") from error
    return read[0], read[1]

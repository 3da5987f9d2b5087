"""netCDF files that grow along time, block by block, in flat memory; CF-style, written aside and moved into place."""

from __future__ import annotations

import io
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import xarray as xr
from xarray.backends import BackendArray, BackendEntrypoint
from xarray.core.indexing import (
    ExplicitIndexer,
    IndexingSupport,
    LazilyIndexedArray,
    explicit_indexing_adapter,
)

from obsnet.console import patiently
from obsnet.errors import OutputError
from obsnet.layout import from_posix, to_posix

UNITS = {"frequency": "Hz", "line_frequency": "Hz", "spectrogram_frequency": "Hz", "quefrency": "s"}
"""Units of the coordinates that are not given with them."""

PACKED = {"range_llr": 0.05}
"""Variables stored as 16-bit integers, and their resolution (CF `scale_factor`)."""

FILL = np.int16(-32768)
"""Stands for NaN in packed variables."""

LARGEST = 1600.0
"""Greatest magnitude of a packed value: what 16 bits hold at the resolutions of `PACKED`."""

_CELLS_AT_ONCE = 1 << 17
_ROWS_AT_ONCE = 64
_BINDING = ("CLASS", "NAME", "REFERENCE_LIST", "DIMENSION_LIST", "scale_factor")


class TimeWriter:
    """Appends Datasets along their `time` dimension to one netCDF file; complex variables become real and imaginary ones.

    The file appears under its name when the writer closes without an error, never before.
    """

    def __init__(self, path: str | Path, attrs: dict[str, Any] | None = None) -> None:
        self.path = Path(path)
        self._partial = self.path.with_name(f".{self.path.name}.{os.getpid()}.tmp")
        self._attrs = attrs or {}
        self._file: Any = None
        self._bytes: _PatientFile | None = None

    @patiently()
    def append(self, block: xr.Dataset) -> None:
        """Write the next block; the first one sets variables, coordinates and dims."""
        if not block.sizes.get("time", 0):
            return
        try:
            if self._file is None:
                self._file = self._create(block)
            self._extend("time", to_posix(block["time"].values))
            for name, values in _real(block).items():
                self._extend(name, pack(name, values.transpose("time", ...).values))
        except OSError as error:
            if isinstance(error, OutputError):
                raise
            raise OutputError(f"cannot write {self.path}: {error.strerror or error}") from None
        self._require_written()

    def _extend(self, name: str, rows: np.ndarray) -> None:
        variable = self._file[name]
        first = len(variable)
        variable.resize(first + len(rows), axis=0)
        variable[first:] = rows

    @patiently()
    def close(self) -> None:
        """Finish the file and move it to its name."""
        if self._file is None:
            return
        try:
            self._release()
            self._require_written()
            os.replace(self._partial, self.path)
        except OSError as error:
            self._partial.unlink(missing_ok=True)
            if isinstance(error, OutputError):
                raise
            raise OutputError(f"cannot write {self.path}: {error.strerror or error}") from None

    def __enter__(self) -> TimeWriter:
        return self

    @patiently()
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
            return
        self._release()
        self._partial.unlink(missing_ok=True)

    def _release(self) -> None:
        if self._file is not None:
            self._file.close()
        if self._bytes is not None:
            self._bytes.close()
        self._file = None

    def _require_written(self) -> None:
        if self._bytes is not None and self._bytes.failure is not None:
            raise OutputError(f"cannot write {self.path}: {self._bytes.failure.strerror}; make room for it")

    def _create(self, block: xr.Dataset) -> Any:
        self._partial.parent.mkdir(parents=True, exist_ok=True)
        self._bytes = _PatientFile(self._partial, "w+")
        import h5netcdf
        import h5py

        with h5netcdf.File(self._bytes, "w") as file:
            self._lay_out(file, block)
        self._require_written()
        # Every growth through h5netcdf asks each variable of each dimension for its length: 5 ms a variable.
        return h5py.File(self._bytes, "r+")

    def _lay_out(self, file: Any, block: xr.Dataset) -> None:
        """Dimensions, coordinates and empty variables."""
        file.attrs["Conventions"] = "CF-1.11"
        for key, value in self._attrs.items():
            file.attrs[key] = value
        file.dimensions["time"] = None
        time = file.create_variable("time", ("time",), "f8", chunks=(4096,))
        time.attrs.update(
            {"units": "seconds since 1970-01-01T00:00:00Z", "standard_name": "time", "calendar": "standard"}
        )
        for name, coordinate in block.coords.items():
            if name == "time" or coordinate.dims != (name,):
                continue
            file.dimensions[name] = coordinate.size
            variable = file.create_variable(str(name), (name,), "f8")
            variable[:] = coordinate.values
            units = {"units": UNITS[str(name)]} if name in UNITS else {}
            variable.attrs.update(units | coordinate.attrs)
        for name, values in _real(block).items():
            values = values.transpose("time", ...)
            packed = name in PACKED
            rows = max(1, 2**18 // max(int(np.prod(values.shape[1:])), 1))
            variable = file.create_variable(
                name,
                values.dims,
                "i2" if packed else "f4",
                chunks=(min(rows, 4096), *values.shape[1:]),
                fillvalue=FILL if packed else np.float32(np.nan),
            )
            variable.attrs.update(values.attrs)
            if packed:
                variable.attrs.update({"scale_factor": np.float32(PACKED[name])})


class _PatientFile(io.FileIO):
    """A file that keeps its first failure for the writer to ask about: a write that fails makes HDF5 crash."""

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        """Write all of `data`, or pretend to."""
        view = memoryview(data).cast("B")
        done = 0
        try:
            while self.failure is None and done < len(view):
                done += super().write(view[done:]) or 0
        except OSError as error:
            self.failure = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Set the length, or pretend to."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.failure = self.failure or error
            return size or 0


def read(path: str | Path) -> xr.Dataset:
    """Open a file of `TimeWriter` lazily; pairs ``x_real``, ``x_imag`` come back as complex ``x`` when loaded.

    Raises
    ------
    OSError, KeyError, ValueError : the file is not there, or not one of `TimeWriter`.
    """
    return xr.open_dataset(path, engine=_Grown)


class _Grown(BackendEntrypoint):
    """Files of `TimeWriter`, past h5netcdf, which asks the file for every dimension of every variable: ten times as long."""

    open_dataset_parameters = ("filename_or_obj", "drop_variables")

    def open_dataset(self, filename_or_obj: Any, *, drop_variables: Any = None) -> xr.Dataset:
        import h5py

        path = Path(filename_or_obj)
        with h5py.File(path, "r") as file:
            stored = dict(file.items())
            axes = {name for name, values in stored.items() if values.is_scale}
            coords = {name: (name, stored[name][:], _attrs(stored[name])) for name in axes - {"time"}}
            coords["time"] = ("time", from_posix(stored["time"][:]), {"standard_name": "time"})
            variables = {
                name: (_dims(file, values), LazilyIndexedArray(_Stored(path, name, values)), _attrs(values))
                for name, values in stored.items()
                if name not in axes
            }
            return xr.Dataset(variables, coords, _attrs(file))


class _Stored(BackendArray):
    """A variable on disk, read and unpacked a few rows at a time."""

    def __init__(self, path: Path, name: str, stored: Any) -> None:
        self.path, self.name, self.shape = path, name, stored.shape
        self.dtype = np.dtype(np.float32 if name in PACKED else stored.dtype)

    def __getitem__(self, key: ExplicitIndexer) -> np.ndarray:
        return explicit_indexing_adapter(key, self.shape, IndexingSupport.OUTER, self._take)

    def _take(self, key: tuple[Any, ...]) -> np.ndarray:
        import h5py

        first, *rest = key
        index = np.arange(self.shape[0])[first]
        chosen = np.empty((index.size, *self.shape[1:]), self.dtype)
        with h5py.File(self.path, "r") as file:
            stored = file[self.name]
            if stored.shape != self.shape:
                raise OSError(f"{self.path} was written anew; open it again")
            for start in range(0, index.size, _ROWS_AT_ONCE):
                part = index.reshape(-1)[start : start + _ROWS_AT_ONCE]
                if part[-1] - part[0] < 4 * len(part):
                    block = stored[part[0] : part[-1] + 1]
                    block = block if len(block) == len(part) else block[part - part[0]]
                else:
                    block = np.stack([stored[row] for row in part])
                chosen[start : start + _ROWS_AT_ONCE] = unpack(self.name, block)
        for axis, part in enumerate(rest, 1):  # integers last: they take their axis away
            if not isinstance(part, (int, np.integer)):
                chosen = chosen[(slice(None),) * axis + (part,)]
        numbers = (part if isinstance(part, (int, np.integer)) else slice(None) for part in rest)
        return chosen[(0 if index.ndim == 0 else slice(None), *numbers)]


def _dims(file: Any, stored: Any) -> tuple[str, ...]:
    return tuple(file[axis[0]].name.removeprefix("/") for axis in stored.attrs["DIMENSION_LIST"])


def _attrs(stored: Any) -> dict[str, Any]:
    """What a file says of itself or of a variable, without what binds variables to dimensions and integers to values."""
    return {
        name: value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
        for name, value in stored.attrs.items()
        if name not in _BINDING and not name.startswith("_")
    }


def join_complex(dataset: xr.Dataset) -> xr.Dataset:
    """Complex variables of a Dataset whose real and imaginary parts are variables of their own."""
    names = [str(name).removesuffix("_real") for name in dataset if str(name).endswith("_real")]
    joined = {name: dataset[f"{name}_real"] + 1j * dataset[f"{name}_imag"] for name in names}
    return dataset.drop_vars([f"{name}_{part}" for name in names for part in ("real", "imag")]).assign(joined)


def _real(block: xr.Dataset) -> dict[str, xr.DataArray]:
    variables: dict[str, xr.DataArray] = {}
    for key, values in block.data_vars.items():
        name = str(key)
        if np.iscomplexobj(values):
            variables[f"{name}_real"] = values.real.assign_attrs(values.attrs)
            variables[f"{name}_imag"] = values.imag.assign_attrs(values.attrs)
        else:
            variables[name] = values
    return variables


def pack(name: str, values: np.ndarray) -> np.ndarray:
    """Values of a variable as a file holds them."""
    if name not in PACKED:
        return values
    cells = np.ravel(values)
    packed = np.empty(cells.shape, np.int16)
    for first in range(0, len(cells), _CELLS_AT_ONCE):
        part = slice(first, first + _CELLS_AT_ONCE)
        scaled = np.clip(cells[part], -LARGEST, LARGEST)
        scaled /= np.float32(PACKED[name])
        np.copyto(np.rint(scaled, out=scaled), np.float32(FILL), where=np.isnan(scaled))
        packed[part] = scaled
    return packed.reshape(values.shape)


def unpack(name: str, packed: np.ndarray) -> np.ndarray:
    """Values of a variable from what `pack` made of them."""
    if name not in PACKED:
        return packed
    values = packed * np.float32(PACKED[name])
    values[packed == FILL] = np.nan
    return values

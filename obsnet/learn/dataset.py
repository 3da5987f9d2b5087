"""Prepared records on disk: what a station heard, as the detectors see it, beside what AIS says of the ships.

A prepared set is a folder of Zarr groups, one a record, and ``provenance.json`` (configuration, versions, commit, digests).
A record appears whole or not at all. A group has the attributes ``id``, ``split`` (train, validation, test), ``source``
(twin, archive), ``station``, ``depth_m``, ``ambiguity_deg``, ``absence_known`` and a free ``scene``; and the arrays

| array | dims | |
|---|---|---|
| cell_index | (cell) int64 | `obsnet.detectors.azimuth_features`, consecutive |
| invariants | (cell, channel, frequency) float16 | 0 without data |
| phasor | (cell, frequency) int16 | argument over π times 32767; −32768 without data |
| frame_time | (frame) float64 | s since 1970 |
| cepstra | (frame, quefrency) float16 | clutter filtered, over `noise_std`; NaN without data |
| quefrency | (quefrency) float64 | s |
| minute | (minute) float64 | s since 1970, UTC multiples of 60 s |
| azimuth_deg, range_m, range_rate_mps | (minute, ship) float32 | of each ship as it is heard; NaN where AIS does not say |
| known | (minute, ship) bool | False: a ship may be there, AIS does not say where (interpolated too far, another split's ship) |
| path, range | (path) int64, (range) float64 | of the believed propagation table |
| delay, slowness, pressure_real, pressure_imag | (path, range) float32 | NaN where the path does not exist |

The azimuth arrays are empty where the station lacks a horizontal, the cepstral ones where it lacks the hydrophone. Ships are
those of AIS within the propagation table's reach. ``absence_known`` is False where vessels without AIS may be about: what
AIS does not show is then unknown, not "no ship".
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr

from obsnet.detectors.azimuth_features import Cells
from obsnet.errors import ConfigError, OutputError

NO_PHASOR = -32768


@dataclass(frozen=True)
class Record:
    """One prepared record; arrays as the module says."""

    attributes: dict[str, Any]
    arrays: dict[str, np.ndarray] = field(repr=False)

    def __getattr__(self, name: str) -> np.ndarray:
        try:
            return self.arrays[name]
        except KeyError:
            raise AttributeError(name) from None

    @property
    def id(self) -> str:
        """Its name, unique within the set."""
        return str(self.attributes["id"])

    @property
    def absence_known(self) -> bool:
        """Whether a minute without a ship in AIS is a minute without a ship."""
        return bool(self.attributes["absence_known"])

    def cells(self) -> Cells:
        """The azimuth detector's cells."""
        there = self.phasor != NO_PHASOR
        angle = np.pi / 32767.0 * self.phasor.astype(np.float32)
        phasor = np.where(there, np.exp(1j * angle), 0).astype(np.complex64)
        ambiguity = int(self.attributes["ambiguity_deg"])
        return Cells(self.cell_index, self.invariants.astype(np.float32), phasor, ambiguity)

    def table(self) -> xr.Dataset:
        """The believed propagation table."""
        arrays = self.arrays
        pressure = arrays["pressure_real"] + 1j * arrays["pressure_imag"].astype(np.complex64)
        columns = {"delay": arrays["delay"], "slowness": arrays["slowness"], "pressure": pressure}
        coords = {"path": arrays["path"], "range": arrays["range"]}
        attrs = {"depth_m": float(self.attributes["depth_m"])}
        return xr.Dataset({k: (("path", "range"), v) for k, v in columns.items()}, coords, attrs)


def packed_cells(cells: Cells) -> dict[str, np.ndarray]:
    """Arrays `cell_index`, `invariants` and `phasor` of a record."""
    there = np.abs(cells.phasor) > 0
    angle = np.rint(np.angle(cells.phasor) / np.pi * 32767.0)
    return {
        "cell_index": cells.index.astype(np.int64),
        "invariants": cells.invariants.astype(np.float16),
        "phasor": np.where(there, angle, NO_PHASOR).astype(np.int16),
    }


def packed_table(table: xr.Dataset) -> dict[str, np.ndarray]:
    """Arrays of a propagation table."""
    table = table.transpose("path", "range")
    return {
        "path": table["path"].values.astype(np.int64),
        "range": table["range"].values.astype(float),
        "delay": table["delay"].values.astype(np.float32),
        "slowness": table["slowness"].values.astype(np.float32),
        "pressure_real": table["pressure"].values.real.astype(np.float32),
        "pressure_imag": table["pressure"].values.imag.astype(np.float32),
    }


class PreparedSet:
    """A folder of prepared records.

    Raises
    ------
    ConfigError : the folder holds no prepared record.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def has(self, name: str) -> bool:
        """Whether a record is there, whole."""
        return (self.folder / f"{name}.zarr").is_dir()

    def empty(self) -> bool:
        """Whether it holds no record."""
        return not any(self.folder.glob("*.zarr"))

    def write(self, record: Record) -> None:
        """Store a record, whole or not at all."""
        target = self.folder / f"{record.id}.zarr"
        partial = self.folder / f".{record.id}.{os.getpid()}.tmp"
        attributes = record.attributes | {"digest": digest(record.arrays)}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            group = zarr.open_group(partial, mode="w", attributes=attributes)
            for name, values in record.arrays.items():
                chunks = (min(len(values), 512) or 1, *(size or 1 for size in values.shape[1:]))
                array = group.create_array(name, shape=values.shape, dtype=values.dtype, chunks=chunks)
                if values.size:
                    array[...] = values
            os.replace(partial, target)
        except OSError as error:
            raise OutputError(f"cannot write {target}: {error.strerror}; make room for it") from None
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    def names(self, split: str | None = None) -> list[str]:
        """Ids of the records, of one split or of all, in order."""
        found = sorted(path.stem for path in self.folder.glob("*.zarr"))
        if not found:
            raise ConfigError(f"{self.folder} holds no prepared record; run train/prepare.py first")
        return [name for name in found if split in (None, self.attributes(name)["split"])]

    def attributes(self, name: str) -> dict[str, Any]:
        """Attributes of a record."""
        try:
            return dict(zarr.open_group(self.folder / f"{name}.zarr", mode="r").attrs)
        except (OSError, ValueError, KeyError) as error:
            raise ConfigError(
                f"record {name} of {self.folder} cannot be read: {error}; prepare it again"
            ) from None

    def read(self, name: str, only: tuple[str, ...] | None = None) -> Record:
        """A record, or some of its arrays."""
        attributes = self.attributes(name)
        group = zarr.open_group(self.folder / f"{name}.zarr", mode="r")
        names = [key for key in group.array_keys() if only is None or key in only]
        return Record(attributes, {key: np.asarray(group[key]) for key in names})

    def records(self, split: str | None = None, only: tuple[str, ...] | None = None) -> Iterator[Record]:
        """Records of a split, one by one."""
        for name in self.names(split):
            yield self.read(name, only)

    def digest(self) -> str:
        """One digest of all records."""
        total = hashlib.sha256()
        for name in self.names():
            total.update(f"{name} {self.attributes(name)['digest']}\n".encode())
        return total.hexdigest()

    def write_provenance(self, provenance: dict[str, Any]) -> None:
        """Write provenance.json."""
        from obsnet.output import write_text

        write_text(self.folder / "provenance.json", json.dumps(provenance, indent=1, default=str))


class JoinedSets:
    """Prepared folders used as one, to train on."""

    def __init__(self, folders: Sequence[str | Path]) -> None:
        self.sets = [PreparedSet(folder) for folder in folders]

    @property
    def folder(self) -> str:
        """Names of the folders."""
        return ", ".join(str(held.folder) for held in self.sets)

    def records(self, split: str | None = None, only: tuple[str, ...] | None = None) -> Iterator[Record]:
        """Records of a split, folder by folder."""
        return itertools.chain.from_iterable(held.records(split, only) for held in self.sets)

    def digest(self) -> str:
        """Digests of the folders."""
        return " ".join(held.digest() for held in self.sets)


def digest(arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 of named arrays."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {values.dtype} {values.shape}".encode() + values.tobytes())
    return total.hexdigest()

"""Files of a simulated record: miniSEED, StationXML, AIS and truth, each written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import pandas as pd
from obspy import Stream
from obspy.core.inventory import Inventory

from obsnet.console import patiently
from obsnet.errors import OutputError
from obsnet.layout import iso
from obsnet.twin.scenario import Scenario
from obsnet.twin.truth import Truth

WAVEFORMS, METADATA, AIS, MINUTES, PASSAGES = (
    "waveforms.mseed",
    "station.xml",
    "ais.csv",
    "truth.csv",
    "truth.json",
)
STAMP = "%Y-%m-%dT%H:%M:%S.%fZ"


@patiently()
def append_stream(file: BinaryIO, stream: Stream) -> None:
    """Append every trace to an open miniSEED file."""
    for trace in stream:
        buffer = BytesIO()
        trace.write(buffer, format="MSEED", encoding="STEIM2", reclen=4096)
        file.write(buffer.getvalue())


def write_tables(
    target: Path, inventory: Inventory, ais: pd.DataFrame, truth: Truth, scenario: Scenario
) -> list[Path]:
    """Write station.xml, ais.csv, truth.csv (minutes) and truth.json (passages) into `target`."""
    with whole_file(target / METADATA) as file:
        inventory.write(file, format="STATIONXML")
    for name, frame in ((AIS, ais), (MINUTES, truth.minutes)):
        text = frame.copy()
        for column in {"time", "emitted"} & set(text.columns):
            text[column] = text[column].dt.strftime(STAMP).str.replace(".000000Z", "Z", regex=False)
        with whole_file(target / name) as file:
            file.write(text.to_csv(index=False, float_format="%.9g").encode())
    rows = truth.passages.assign(
        cpa_time=[iso(time) for time in truth.passages["cpa_time"].to_numpy("datetime64[ns]")]
    )
    known = {
        "simulated": True,
        "station": scenario.recorder.code,
        "start": iso(scenario.start),
        "end": iso(scenario.end),
        "seed": scenario.seed,
        "orientation_deg": scenario.recorder.orientation_deg,
        "hydrophone_polarity": scenario.recorder.hydrophone_polarity,
        "passages": rows.to_dict("records"),
    }
    with whole_file(target / PASSAGES) as file:
        file.write(json.dumps(known, indent=2).encode())
    return [target / name for name in (METADATA, AIS, MINUTES, PASSAGES)]


@contextmanager
def writing(folder: Path) -> Iterator[Path]:
    """Make the output folder; what the system refuses is an `OutputError`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    except (FileExistsError, NotADirectoryError):
        raise OutputError(f"cannot write the simulation to {folder}: it is a file, name a folder") from None
    except OSError as error:
        raise OutputError(f"cannot write the simulation to {folder}: {error.strerror or error}") from None


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file that takes its name only when it is complete."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(partial, "wb") as file:
            yield file
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)

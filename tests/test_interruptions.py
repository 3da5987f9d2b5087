"""A signal within a library's call of our code crashes the process if it raises there; so it waits until the library is done."""

import subprocess
import sys

import pytest

BEGIN = """
import io, os, signal, sys
import numpy as np
folder, asked = sys.argv[1], int(sys.argv[2])
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell are started deaf to it
calls = []
def called():
    if len(calls) == asked:
        os.kill(os.getpid(), signal.SIGINT)
    calls.append(0)
def within(call):
    def interrupted(*given):
        called()
        return call(*given)
    return interrupted
"""

END = """
except KeyboardInterrupt:
    sys.exit(130)
sys.exit(f"{len(calls)} calls, {done} done")
"""

NETCDF = """
import xarray as xr
from obsnet import netcdf
netcdf._PatientFile.write = within(netcdf._PatientFile.write)
time = np.datetime64("2013-05-21", "ns") + np.arange(3) * np.timedelta64(60, "s")
block = xr.Dataset({"azimuth_llr": (("time", "azimuth"), np.ones((3, 360), "f4"))}, {"time": time, "azimuth": np.arange(360.0)})
done = 0
try:
    with netcdf.TimeWriter(folder + "/maps.nc") as writer:
        for done in range(4):
            writer.append(block)
"""

WAVEFORMS = """
import obspy
from pathlib import Path
from obspy.io.mseed import core
from obsnet.signals.records import RecordReader
trace = obspy.Trace(np.arange(5000, dtype=np.int32), {"station": "RR03", "channel": "BDH"})
path = Path(folder) / "one.mseed"
trace.write(str(path), format="MSEED", reclen=512)
pieces, _ = RecordReader().pieces(path)
class Types(dict):
    __getitem__ = within(dict.__getitem__)
core.DATATYPES = Types(core.DATATYPES)
done = 0
try:
    for _, piece in pieces:
        done += piece.read(0, 4000).size
"""

TWIN = """
import obspy
from obsnet.twin import files
class Records(io.BytesIO):
    write = within(io.BytesIO.write)
files.BytesIO = Records
trace = obspy.Trace(np.arange(5000, dtype=np.int32), {"station": "RR03", "channel": "BDH"})
done = 0
try:
    files.append_stream(io.BytesIO(), obspy.Stream([trace]))
    done = 1
"""


@pytest.mark.parametrize(
    ("work", "call", "left"),
    [
        (NETCDF, 0, ([], ["maps.nc"])),
        (NETCDF, 3, ([], ["maps.nc"])),
        (NETCDF, 15, ([], ["maps.nc"])),
        (WAVEFORMS, 0, (["one.mseed"],)),
        (TWIN, 0, ([],)),
    ],
    ids=["netcdf-first", "netcdf", "netcdf-later", "waveforms", "twin"],
)
def test_an_interruption_waits_for_the_library_to_be_done(tmp_path, work, call, left):
    script = BEGIN + work + END
    given = [sys.executable, "-c", script, str(tmp_path), str(call)]
    made = subprocess.run(given, capture_output=True, text=True, check=False, timeout=60)
    assert made.returncode == 130, made.stderr
    assert made.stderr == ""
    assert sorted(path.name for path in tmp_path.iterdir()) in left

"""The learned detectors on the noise of a real ocean-bottom seismometer, which no simulator made."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from obsnet.pipeline import RunConfig
from obsnet.run import track
from obsnet.signals.station import Station


@pytest.fixture(scope="module")
def recording():
    """45 min of four channels at 250 Hz that package lcheapo carries; it does not say how deep they were recorded."""
    lcheapo = pytest.importorskip("lcheapo")
    folder = Path(lcheapo.__file__).parent
    raw = folder / "_examples" / "20191107T14_SPOBS09_F02.raw.lch"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from lcheapo import lcread

        stream = lcread.read(str(raw), 0, 3600, network="XX", station="SPOB2", obs_type="SPOBS2")
    return stream, Station.from_stationxml(folder / "data" / "SPOBS2.station.xml", depth_m=2000.0)


def test_an_instruments_own_noise_is_no_ship(recording):
    stream, station = recording
    run = track(stream, station, replace(RunConfig(), detector="learned"))
    minutes = run.detections
    assert len(minutes) >= 44
    assert minutes["coverage"].median() == 1.0
    assert np.isfinite(minutes[["azimuth_llr", "range_llr"]]).all(axis=None)
    # On this record the analytic detector is sure of a ship, at 13.7 nats.
    assert minutes["azimuth_llr"].max() < 1.0
    assert minutes["range_llr"].max() < 2.0
    assert run.tracks == []

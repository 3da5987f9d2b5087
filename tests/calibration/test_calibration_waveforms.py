"""What calibration asks of waveforms is what a run asks of them."""

import numpy as np
import obspy
import pandas as pd
import pytest

from obsnet.ais import reference_tracks
from obsnet.calibration import calibrate_waveforms
from obsnet.errors import WaveformError
from obsnet.pipeline import RunConfig
from obsnet.signals.spectra import SpectraConfig
from obsnet.signals.station import Channel, Station

START = 1_369_100_000.0
STATION = Station(
    "XX.A",
    -20.0,
    50.0,
    4000.0,
    (
        Channel("XX.A.00.BDH", "pressure"),
        Channel("XX.A.00.BH1", "motion", 0.0),
        Channel("XX.A.00.BH2", "motion", 90.0),
        Channel("XX.A.00.BHZ", "motion", 0.0, -90.0),
    ),
)


def noise(rate_hz):
    """An hour of noise on all channels."""
    generator = np.random.default_rng(0)
    stream = obspy.Stream()
    for channel in STATION.channels:
        data = generator.standard_normal(round(3600 * rate_hz)).astype(np.float32)
        trace = obspy.Trace(data, {"sampling_rate": rate_hz, "starttime": obspy.UTCDateTime(START)})
        trace.id = channel.seed_id
        stream.append(trace)
    return stream


@pytest.fixture(scope="module")
def tracks():
    times = pd.to_datetime(START + np.arange(-600.0, 4500.0, 60.0), unit="s")
    ais = pd.DataFrame({"mmsi": 1, "time": times, "lon": np.linspace(49.7, 50.3, len(times)), "lat": -20.05})
    return reference_tracks(ais, (STATION.latitude, STATION.longitude))


def test_a_slow_station_is_calibrated_at_its_own_rate(tracks):
    settings = RunConfig(spectra=SpectraConfig(analysis_rate_hz=40.0, window_s=20.5))
    assert calibrate_waveforms(noise(40.0), STATION, tracks, settings).station == "XX.A"


def test_channels_slower_than_the_analysis_are_refused(tracks):
    settings = RunConfig(spectra=SpectraConfig(analysis_rate_hz=100.0))
    with pytest.raises(WaveformError, match="sampled at 50 Hz, below the 100 Hz needed"):
        calibrate_waveforms(noise(50.0), STATION, tracks, settings)

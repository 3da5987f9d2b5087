"""The azimuth detectors on a real ship: a directional sonobuoy's clips, played sixty times slower into the detectors' band."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import obspy
import pytest
from scipy.io import wavfile

from obsnet.errors import ModelError
from obsnet.pipeline import RunConfig
from obsnet.run import detect
from obsnet.signals.station import Channel, Station

REFERENCE = Path(__file__).parents[2] / "../shared/reference"
pytestmark = pytest.mark.skipif(not REFERENCE.exists(), reason="reference data not here")
OPERATOR_DEG = 229.0
SLOWER = 60.0


@pytest.fixture(scope="module")
def recording():
    """Three clips of 5 s at 3 kHz as one record of 15 min at 50 Hz: the ship's 1000–1250 Hz become 16.7–20.8 Hz."""
    clips = [wavfile.read(path) for path in sorted(REFERENCE.glob("difar_vessel_*.wav"))]
    samples = np.concatenate([values for _, values in clips]).astype(np.float32)
    # This sensor's pressure is positive where its velocity points to the source: a reversed hydrophone.
    samples[:, 0] *= -1.0
    header = {"network": "XX", "station": "DIFAR", "sampling_rate": clips[0][0] / SLOWER}
    names = ("BDH", "BHE", "BHN")
    stream = obspy.Stream(
        [obspy.Trace(samples[:, i].copy(), header | {"channel": name}) for i, name in enumerate(names)]
    )
    channels = (
        Channel("XX.DIFAR..BDH", "pressure"),
        Channel("XX.DIFAR..BHE", "motion", 90.0),
        Channel("XX.DIFAR..BHN", "motion", 0.0),
    )
    return stream, Station("XX.DIFAR", 32.5, -119.0, 1000.0, channels)


@pytest.mark.parametrize(("detector", "share"), [("analytic", 0.7), ("learned-azimuth", 0.9)])
def test_a_real_ship_is_pointed_at(recording, detector, share):
    stream, station = recording
    try:
        run = detect(stream, station, replace(RunConfig(), detector=detector))
    except ModelError as error:
        pytest.skip(str(error))
    azimuth = run.detections["azimuth_deg"].to_numpy(float)
    error = (azimuth - OPERATOR_DEG + 180.0) % 360.0 - 180.0
    assert np.isfinite(azimuth).mean() > share
    assert np.nanmax(np.abs(error)) < 10.0
    assert abs(np.nanmedian(error)) < 3.0

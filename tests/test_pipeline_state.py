"""A pipeline that is stopped and goes on from its state says what one that never stopped says."""

import numpy as np
import pytest

from obsnet.errors import ConfigError
from obsnet.pipeline import Pipeline, RunConfig
from obsnet.signals.spectra import SpectraConfig, iter_spectra
from obsnet.signals.station import Station
from obsnet.signals.waveforms import open_waveforms


@pytest.fixture(scope="module")
def blocks(record):
    station = Station.from_stationxml(record / "station.xml")
    source = open_waveforms(record / "waveforms.mseed", station, endtime="2013-05-21T11:00:00Z")
    return station, list(iter_spectra(source, SpectraConfig(block_s=122.88)))


def stored(state):
    """The state's arrays as another process would read them."""
    return {
        name: np.frombuffer(value.tobytes(), value.dtype).reshape(value.shape)
        for name, value in state.items()
    }


@pytest.mark.parametrize("detector", ["analytic", "learned"])
def test_going_on_from_a_state_changes_nothing(blocks, detector):
    station, spectra = blocks
    config = RunConfig(detector=detector)
    whole, current = (Pipeline(station, config) for _ in range(2))
    expected = [minutes for block in spectra for minutes in whole.push(block)]
    got = []
    for number, block in enumerate(spectra):
        if number in (0, 1, 2, 20):
            state, current = (
                stored(current.state()),
                Pipeline(station, config, table=whole.table),
            )
            current.restore(state)
        got += current.push(block)
    for a, b in zip([*expected, *whole.flush()], [*got, *current.flush()], strict=True):
        assert a.maps.identical(b.maps)
        assert a.detections.equals(b.detections)
        assert a.features.identical(b.features)


def test_what_is_complete_stays_the_same_object(blocks):
    station, spectra = blocks
    pipeline = Pipeline(station, RunConfig())
    for block in spectra[:12]:
        pipeline.push(block)
    before = pipeline.state()
    for block in spectra[12:18]:
        pipeline.push(block)
    after = pipeline.state()
    kept = [name for name in after if after[name] is before.get(name)]
    assert any(name.startswith("clutter/frames/") for name in kept)
    assert any("background/sum/" in name for name in kept)


def test_a_tracker_without_a_state_is_refused(blocks):
    with pytest.raises(ConfigError, match="focalization tracker cannot be stopped"):
        Pipeline(blocks[0], RunConfig(tracker="focalization")).state()

"""Table I through every detector, on two simulated hours in place of the week."""

import shutil

import pytest

from obsnet.ais import read, reference_tracks
from obsnet.errors import ConfigError, ModelError
from obsnet.experiments import table1
from obsnet.signals.station import Station


@pytest.fixture
def short_week(monkeypatch, record):
    station = Station.from_stationxml(record / "station.xml")
    ships = reference_tracks(read(record / "ais.csv"), station)
    monkeypatch.setattr(table1, "ships", lambda: ships)
    monkeypatch.setattr(
        table1, "simulate", lambda folder, *_: shutil.copytree(record, folder, dirs_exist_ok=True)
    )


def test_every_detector_that_has_a_model_gets_a_line(short_week, monkeypatch):
    track = table1.track

    def without_range_model(waveforms, station, config, **options):
        if config.detector in ("learned-range", "learned"):
            raise ModelError("no range model")
        return track(waveforms, station, config, **options)

    monkeypatch.setattr(table1, "track", without_range_model)
    steps = []
    result = table1.reproduce(jobs=1, detector="all", progress=lambda done, total: steps.append(done / total))
    assert "analytic" in result.detectors and "learned" not in result.detectors
    assert set(result.to_json()["detectors"]) == set(result.detectors)
    assert steps == sorted(steps)
    lines = result.table().splitlines()
    first = lines.index("every detector on the same waveforms:")
    assert lines[first + 2].split()[0] == "analytic"
    assert float(lines[first + 2].split()[1]) > 0.5


def test_one_detector_is_one_run(short_week):
    result = table1.reproduce(jobs=1, detector="analytic")
    assert not result.detectors
    assert "every detector" not in result.table()
    assert result.obsnet.ships[0].track == 1


def test_unknown_detectors_are_refused():
    with pytest.raises(ConfigError, match=r"detector must be one of analytic, .*, all; found 'odd'"):
        table1.reproduce(detector="odd")

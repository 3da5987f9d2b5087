"""A hydrophone that stops working costs the range and the azimuth's side, not the azimuth."""

from dataclasses import replace

import numpy as np
import obspy
import pandas as pd
import pytest

import obsnet
from obsnet.detectors.maps import two_sided
from obsnet.experiments.ablation_minutes import minute_table
from obsnet.kinematics import wrap180
from obsnet.layout import to_posix
from obsnet.pipeline import Pipeline, RunConfig
from obsnet.signals.azigram import AzigramConfig
from obsnet.signals.spectra import SpectraConfig, iter_spectra
from obsnet.signals.station import Station
from obsnet.signals.waveforms import open_waveforms

CPA = obspy.UTCDateTime("2013-05-21T11:00:00Z")
"""Of the record's ship, 6 km off, on course 60° at 8 m/s."""


@pytest.fixture(scope="module")
def station(record):
    return Station.from_stationxml(record / "station.xml")


@pytest.fixture(scope="module", params=["analytic", "learned"])
def runs(request, stream, station):
    """The whole record, and as it is when the hydrophone sticks at one value from the CPA on."""
    broken = stream.copy()
    for trace in broken.select(channel="BDH"):
        trace.data = trace.data.copy()
        trace.data[round((CPA - trace.stats.starttime) * trace.stats.sampling_rate) :] = 1234
    return tuple(obsnet.track(given, station, detector=request.param) for given in (stream, broken))


def after(run, seconds):
    return to_posix(run.maps["time"].values) > CPA.timestamp + seconds


def test_azimuths_go_on_up_to_180_degrees(runs):
    whole, broken = runs
    late, early = after(broken, 120.0), ~after(broken, -900.0)  # the network looks at its neighbours
    said, expected = (run.maps["azimuth_llr"].values for run in runs)
    assert np.array_equal(said[early], expected[early], equal_nan=True)
    llr = broken.maps["azimuth_llr"].values
    assert two_sided(llr)[late].mean() > 0.9 and not two_sided(llr)[early].any()
    assert (broken.maps["azimuth_coverage"].values[late][:-3] > 0.9).all()
    heard = late & (whole.detections["azimuth_llr"].to_numpy() > 3)
    axis = broken.maps["azimuth"].values[llr[heard].argmax(axis=1)]
    azimuth = whole.detections["azimuth_deg"].to_numpy()[heard]
    off = abs(wrap180(2.0 * (axis - azimuth))) / 2.0
    assert heard.sum() > 20 and np.median(off) < 3.0


def test_no_side_is_made_up(runs):
    _, broken = runs
    late = after(broken, 120.0)
    said = broken.detections["azimuth_deg"].to_numpy()
    assert np.isnan(said[late]).all() and np.isfinite(said[~after(broken, -120.0)]).any()
    assert (broken.detections["azimuth_llr"].to_numpy()[late] > 0).any()
    assert any("hydrophone is silent" in note for note in broken.info["notes"])


def test_minutes_known_up_to_180_degrees_are_scored_so(runs, record):
    _, broken = runs
    table = minute_table(broken.maps, pd.read_csv(record / "truth.csv"))
    said = (after(broken, 120.0) & (table["azimuth_llr"] > 1)).to_numpy()
    assert said.sum() > 10 and table["azimuth_right"][said].mean() > 0.9


def test_the_ship_is_tracked_once_and_past_the_fault(runs):
    whole, broken = runs
    (expected,), (track,) = whole.tracks, broken.tracks
    assert track.end > CPA.timestamp + 600.0
    assert abs(track.motion.cpa_time - expected.motion.cpa_time) < 60.0
    assert abs(wrap180(track.motion.course_deg - expected.motion.course_deg)) < 3.0
    assert "ambiguous" not in track.method and broken.info["ambiguous_tracks"] == []


@pytest.mark.parametrize("detector", ["analytic", "learned"])
def test_no_minute_depends_on_how_the_record_is_cut_or_stopped(record, station, detector):
    config = RunConfig(detector=detector)

    def blocks(block_s):
        source = open_waveforms(record / "waveforms.mseed", station, endtime="2013-05-21T11:00:00Z")
        for block in iter_spectra(source, SpectraConfig(block_s=block_s)):
            times = to_posix(block["time"].values)
            silent = (times > CPA.timestamp - 2400.0) & (times < CPA.timestamp - 900.0)
            block["p"].values[:, silent] = np.nan
            yield block

    whole, cut = Pipeline(station, config), Pipeline(station, config)
    expected = [m for block in blocks(1024.0) for m in whole.push(block)] + whole.flush()
    got = []
    for number, block in enumerate(blocks(122.88)):
        got += cut.push(block)
        if number % 5 == 4:
            state, cut = cut.state(), Pipeline(station, config, table=whole.table)
            cut.restore(state)
    got += cut.flush()
    maps = [np.concatenate([m.maps["azimuth_llr"].values for m in made]) for made in (expected, got)]
    assert two_sided(maps[0]).sum() > 15
    np.testing.assert_allclose(*maps, atol=1e-3)


@pytest.mark.parametrize("detector", ["analytic", "learned"])
def test_a_hydrophone_without_a_number_is_as_none(stream, station, detector):
    """As `Stream.merge(fill_value=nan)` leaves one that never recorded."""
    broken = stream.copy()
    for trace in broken.select(channel="BDH"):
        trace.data = np.full(trace.stats.npts, np.nan, np.float32)
    run = obsnet.detect(broken, station, RunConfig(detector=detector), endtime=CPA)
    alone = obsnet.detect(
        stream, station.without("XX.SIM01.00.BDH"), RunConfig(detector=detector), endtime=CPA
    )
    assert run.maps["azimuth"].attrs["ambiguity_deg"] == 180
    assert run.detections["azimuth_deg"].notna().any()
    pd.testing.assert_frame_equal(run.detections, alone.detections)
    assert "never works" in run.info["waveforms"]["left_aside"]["XX.SIM01.00.BDH"]


def without_hydrophones(stream):
    return obspy.Stream([trace for trace in stream if trace.stats.channel != "BDH"])


def test_a_hydrophone_without_waveforms_is_said_to_have_none(stream, station, monkeypatch):
    """And the record is listened to once."""
    opened = []
    monkeypatch.setattr(
        "obsnet.run.open_waveforms",
        lambda *given, **options: opened.append(open_waveforms(*given, **options)) or opened[-1],
    )
    run = obsnet.detect(without_hydrophones(stream), station, RunConfig(detector="analytic"), endtime=CPA)
    assert len(opened) == 1
    assert run.maps["azimuth"].attrs["ambiguity_deg"] == 180
    assert run.info["waveforms"]["notes"] == ["XX.SIM01.00.BDH has no waveforms"]
    assert run.info["waveforms"]["left_aside"] == {}


def test_of_two_hydrophones_neither_need_work(stream, station):
    """One that never works beside one that has no waveforms, and two that never work."""
    (hydrophone,) = (channel for channel in station.epochs if channel.seed_id.endswith("BDH"))
    gauge = replace(hydrophone, seed_id="XX.SIM01.00.BDF")
    two = replace(station, epochs=(*station.epochs, gauge)).at()
    (trace,) = stream.select(channel="BDH")
    dead = [trace.copy(), trace.copy()]
    for item, code in zip(dead, ("BDH", "BDF"), strict=True):
        item.data, item.stats.channel = np.zeros_like(item.data), code
    plain, config = without_hydrophones(stream), RunConfig(detector="analytic")
    expected = obsnet.detect(plain, station, config, endtime=CPA).detections
    for broken in (dead, dead[1:]):
        run = obsnet.detect(plain + obspy.Stream(broken), two, config, endtime=CPA)
        pd.testing.assert_frame_equal(run.detections, expected)
        assert run.info["waveforms"]["left_aside"].keys() == {item.id for item in broken}


def test_a_least_length_is_enough_wherever_it_begins(stream, station):
    begin = stream[0].stats.starttime
    for detector in ("analytic", "learned"):
        for late in (0.0, 17.3, 31.0, 41.9, 50.2, 59.9):
            part = stream.slice(begin + late, begin + late + 101.0)
            found = obsnet.detect(part, station, RunConfig(detector=detector)).detections
            assert (found["coverage"] > 0).any()


@pytest.mark.parametrize("detector", ["analytic", "learned"])
def test_polarisation_is_what_the_horizontals_alone_say_where_it_is_asked_for(stream, station, detector):
    end = CPA
    asked = RunConfig(detector=detector, azigram=AzigramConfig(method="polarisation"))
    told = obsnet.detect(stream, station, asked, endtime=end)
    expected = obsnet.detect(without_hydrophones(stream), station, RunConfig(detector=detector), endtime=end)
    assert told.maps["azimuth"].attrs["ambiguity_deg"] == 180 == told.info["azimuth_ambiguity_deg"]
    assert "range_llr" in told.maps and "range_llr" not in expected.maps
    assert told.info["notes"] == ["azimuth from polarisation, ambiguous by 180°"]
    said, wanted = (run.maps["azimuth_llr"].values for run in (told, expected))
    assert np.isfinite(said).any() and np.allclose(said, wanted, atol=1e-4, equal_nan=True)


def test_parameters_that_the_learned_detector_does_not_take_are_said(stream, station):
    begin, asked = CPA - 3600.0, RunConfig(azigram=AzigramConfig(fmin_hz=8.0))
    learned = obsnet.detect(stream, station, asked, starttime=begin, endtime=begin + 900.0)
    assert any(note.startswith("azigram.fmin_hz:") for note in learned.info["notes"])
    analytic = replace(asked, detector="analytic")
    analytic = obsnet.detect(stream, station, analytic, starttime=begin, endtime=begin + 900.0)
    assert not any("azigram" in note for note in analytic.info["notes"])

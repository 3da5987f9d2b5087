"""Every bad input ends with exit status 2 and one line that says what was found, and leaves nothing behind."""

import copy

import numpy as np
import pytest

from obsnet.cli import main

JUNK = np.random.default_rng(0).bytes(4000)


@pytest.fixture
def refused(obsnet, record, tmp_path):
    """Run ``obsnet track`` on the record with something wrong; the one line that it says."""

    def run(*options, waveforms=record / "waveforms.mseed", station=record / "station.xml", command="track"):
        out = tmp_path / "out"
        given = ("--station", station, "--out", out)
        status, _, errors = obsnet(command, waveforms, *given, *options)
        assert status == 2, errors
        assert not out.exists()
        return only_line(errors)

    return run


@pytest.fixture
def said(obsnet):
    """Run a whole command that is wrong; the one line that it says."""

    def run(*arguments):
        status, _, errors = obsnet(*arguments)
        assert status == 2, errors
        return only_line(errors)

    return run


def only_line(errors):
    assert len(errors) == 1, errors
    assert errors[0].startswith("obsnet: error: ")
    return errors[0]


def write(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "empty"),
        (JUNK, "no format that obspy reads"),
        (b"These are notes.\n" * 50, "no format that obspy reads"),
    ],
)
def test_what_is_no_waveform(refused, tmp_path, content, found):
    line = refused(waveforms=write(tmp_path / "w.mseed", content))
    assert "no usable waveforms of XX.SIM01" in line
    assert found in line


def test_waveforms_that_are_not_there(refused, tmp_path):
    assert "no file, folder or archive" in refused(waveforms=tmp_path / "none.mseed")
    assert "empty text" in refused(waveforms="")
    (tmp_path / "folder").mkdir()
    assert "found no files" in refused(waveforms=tmp_path / "folder")


def test_waveforms_cut_in_the_header(refused, record, tmp_path):
    head = (record / "waveforms.mseed").read_bytes()[:100]
    assert "no usable waveforms" in refused(waveforms=write(tmp_path / "w.mseed", head))


def test_samples_that_cannot_be_read(refused, record, tmp_path):
    head = (record / "waveforms.mseed").read_bytes()[:64]
    assert "no minute of XX.SIM01" in refused(waveforms=write(tmp_path / "w.mseed", head + JUNK + b"\0" * 32))


def test_waveforms_of_another_station(refused, stream, tmp_path):
    other = stream.copy()
    for trace in other:
        trace.stats.station = "OTHER"
    other.write(str(tmp_path / "other.mseed"), "MSEED")
    assert "XX.OTHER.00.BDH not described for XX.SIM01" in refused(waveforms=tmp_path / "other.mseed")


def test_a_record_in_which_nothing_works(refused, stream, tmp_path):
    dead = stream.copy()
    for trace in dead:
        trace.data[:] = 7
    dead.write(str(tmp_path / "dead.mseed"), "MSEED")
    line = refused(waveforms=tmp_path / "dead.mseed")
    assert "no minute of XX.SIM01 from 2013-05-21T10:00:00Z to 2013-05-21T12:00:00Z has usable data" in line
    assert "BH1: 0 s of gaps, 70" in line


def test_a_hydrophone_that_never_works_is_left_out(obsnet, record, stream, inventory, tmp_path, unplotted):
    for trace in (dead := stream.copy()).select(channel="BDH"):
        trace.data[:] = 0
    dead.write(str(tmp_path / "dead.mseed"), "MSEED")
    said = obsnet(
        "detect", tmp_path / "dead.mseed", "--station", record / "station.xml", "--out", tmp_path / "found"
    )
    assert said[0] == 0
    assert any("ambiguous by 180°" in line for line in said[1])
    assert any("BDH never works: gone on as if there were no hydrophone" in line for line in said[1])
    keep("BH1", "BH2", "BHZ")((without := copy.deepcopy(inventory))[0])
    without.write(str(tmp_path / "s.xml"), "STATIONXML")
    given = (
        "detect",
        tmp_path / "dead.mseed",
        "--station",
        tmp_path / "s.xml",
        "--out",
        tmp_path / "azimuths",
    )
    assert obsnet(*given, "--quiet") == (0, [], [])
    assert (tmp_path / "found" / "detections.csv").read_text() == (
        tmp_path / "azimuths" / "detections.csv"
    ).read_text()


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("hello", "no FDSNStationXML element"),
        ("", "is empty"),
        (JUNK, "is not a StationXML"),
        ("<?xml version='1.0'?><quakeml><event/></quakeml>", "no FDSNStationXML element"),
    ],
)
def test_what_is_no_stationxml(refused, tmp_path, content, found):
    assert found in refused(station=write(tmp_path / "s.xml", content))


def test_stationxml_missing_or_cut(refused, record, tmp_path):
    assert "No such file" in refused(station=tmp_path / "none.xml")
    assert "Is a directory" in refused(station=tmp_path)
    cut = (record / "station.xml").read_bytes()[:5000]
    assert "is not a StationXML that can be read" in refused(station=write(tmp_path / "s.xml", cut))


def azimuths(value):
    def change(network):
        for channel in network[0]:
            channel.azimuth = value

    return change


def keep(*codes):
    def change(network):
        network[0].channels = [channel for channel in network[0] if channel.code in codes]

    return change


def twice(network):
    other = copy.deepcopy(network[0])
    other.code = "SIM02"
    network.stations.append(other)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda network: setattr(network[0], "code", "OTHER"), "no usable waveforms of XX.OTHER"),
        (lambda network: setattr(network, "code", "ZZ"), "no usable waveforms of ZZ.SIM01"),
        (lambda network: setattr(network, "stations", []), "describes no station"),
        (keep(), "no hydrophone and no motion channel"),
        (keep("BHZ"), "neither two horizontals nor a hydrophone"),
        (azimuths(None), "BH1 has no azimuth in its StationXML; give --orientation"),
        (azimuths(0.0), "not independent; give --orientation"),
        (lambda network: setattr(network[0], "elevation", 10.0), "give its depth (--depth)"),
        (twice, "describes 2 stations; name one with --code: XX.SIM01, XX.SIM02"),
    ],
)
def test_stationxml_that_does_not_serve(refused, inventory, tmp_path, change, found):
    changed = copy.deepcopy(inventory)
    change(changed[0])
    changed.write(str(tmp_path / "s.xml"), "STATIONXML")
    assert found in refused(station=tmp_path / "s.xml")


@pytest.mark.parametrize(
    ("options", "found"),
    [
        (["--code", "XX.NONE"], "has XX.SIM01, not XX.NONE"),
        (["--code", ""], "has XX.SIM01, not empty text"),
        (["--orientation", "nan"], "must be an azimuth"),
        (["--hydrophone-polarity", "2"], "must be 1 or -1"),
        (["--depth", "-5"], "cannot have a depth of -5 m; give its depth below the surface, above 0"),
        (["--latitude", "100"], "cannot lie at latitude 100"),
        (["--start", "2013-05-21T12:00:00Z", "--end", "2013-05-21T11:00:00Z"], "is not before the end"),
        (["--start", "yesterday"], "cannot read the time 'yesterday'; give ISO 8601"),
        (["--end", "2013-13-45"], "cannot read the time '2013-13-45'"),
        (["--start", ""], "cannot read the time ''"),
        (["--end", "nat"], "cannot read the time 'nat'"),
        (["--start", "99999-01-01"], "cannot read the time '99999-01-01'"),
        (
            ["--start", "2014-01-01"],
            "no waveforms from 2014-01-01T00:00:00Z on; they span 2013-05-21T10:00:00Z",
        ),
        (["--end", "2012-01-01"], "no waveforms before 2012-01-01"),
        (["--end", "2013-05-21T10:00:10Z"], "no whole frame"),
        (
            ["--start", "2013-05-21T10:00:02Z", "--end", "2013-05-21T10:00:52Z"],
            "no minute of XX.SIM01 from 2013-05-21T10:00:02Z to 2013-05-21T10:00:52Z: 50 s of waveforms are too short; "
            "give at least 101 s",
        ),
        (
            ["--detector", "magic"],
            "detector must be one of learned, analytic, learned-azimuth, learned-range, found 'magic'",
        ),
        (["--tracker", "magic"], "tracker must be one of grid, bernoulli, focalization, found 'magic'"),
        (["--jobs", "0"], "--jobs"),
        (["--calibration", "none.yaml"], "cannot read the configuration none.yaml"),
        (["--propagation", "none.nc"], "none.nc as netCDF 4"),
    ],
)
def test_options_that_do_not_serve(refused, options, found):
    assert found in refused(*options)


def test_a_span_in_a_gap(refused, stream, tmp_path):
    start = stream[0].stats.starttime
    (stream.slice(start, start + 1800) + stream.slice(start + 5400)).write(str(tmp_path / "w.mseed"), "MSEED")
    span = ("--start", str(start + 2400), "--end", str(start + 4800))
    line = refused(*span, waveforms=tmp_path / "w.mseed")
    assert "no minute of XX.SIM01" in line and "BH1: 2400 s of gaps, 0 dead" in line


def test_a_short_record_in_a_long_span(refused, stream, tmp_path):
    start = stream[0].stats.starttime
    stream.slice(start + 605, start + 635).write(str(tmp_path / "w.mseed"), "MSEED")
    line = refused("--start", start, waveforms=tmp_path / "w.mseed")
    assert ": 30.02 s of waveforms are too short; give at least 101 s" in line


def test_one_horizontal_alone(refused, stream, tmp_path):
    stream.select(channel="BH1").write(str(tmp_path / "w.mseed"), "MSEED")
    line = refused(waveforms=tmp_path / "w.mseed")
    assert "neither two horizontals nor a hydrophone" in line and "XX.SIM01.00.BH1 alone" in line


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("spectr: {}", "unknown key 'spectr' in the configuration; did you mean 'spectra'?"),
        (
            "spectra: {windw_s: 20}",
            "unknown key 'spectra.windw_s' in the configuration; did you mean 'window_s'?",
        ),
        ("spectra: {window_s: long}", "spectra.window_s must be a number, found 'long'"),
        ("spectra: {window_s: .nan}", "spectra.window_s must be a finite number"),
        ("spectra: {window_s: -1}", "window_s must be positive, found -1"),
        ("spectra: 5", "spectra must be a mapping of keys, found 5"),
        ("range: {pairs: 1-3}", "range.pairs must be a list"),
        ("range: {pairs: [1-2]}", "no amplitude is known of the pairs 1-2"),
        ("azimuth: {step_s: 30}", "must share window_s and step_s"),
        (
            "azigram: {average_frames: 5}",
            "a run takes single frames: azigram.average_frames must be 1",
        ),
        (
            "{azimuth: {window_s: 300}, range: {window_s: 300}, detector: analytic}",
            "tile_s must be a multiple of step_s",
        ),
        ("grid_search: {seed: -1}", "grid_search: the seed must be a whole number of at least 0, found -1"),
        ("grid_search: {max_speed_mps: 1.0e+9}", "make a grid of 2e+11 cells"),
        ("grid_search: {max_cpa_range_m: 1.0e+9}", "make a grid of 5e+07 cells"),
        ("detector: magic", "detector must be one of learned, analytic"),
        ("- a\n- b", "must hold a mapping of keys, found a list"),
        ("just text", "must hold a mapping of keys, found a str"),
        ("5", "must hold a mapping of keys, found a int"),
        ("a: [1", "is not a valid YAML configuration"),
        ("a: ${b}", "is not a valid YAML configuration"),
        ("!!python/object/apply:os.system ['true']", "is not a valid YAML configuration"),
        (JUNK, "is not a valid YAML configuration"),
    ],
)
def test_configurations_that_do_not_serve(refused, tmp_path, content, found):
    assert found in refused("--config", write(tmp_path / "c.yaml", content))


@pytest.mark.parametrize(
    ("override", "found"),
    [
        ("spectra", "must read section.key=value"),
        ("=1", "must read section.key=value"),
        ("[=1", "must read section.key=value"),
        ("spectra.window_s=[1", "cannot be applied"),
        ("spectra.windw_s=1", "did you mean 'window_s'?"),
        ("spectra.window_s=", "must be a number, found None"),
    ],
)
def test_overrides_that_do_not_serve(refused, override, found):
    assert found in refused("--set", override)


def test_a_model_that_is_none_is_refused(refused, tmp_path):
    junk = write(tmp_path / "junk.onnx", "no model")
    assert "is no ONNX model" in refused("--detector", "learned-azimuth", "--set", f"models.azimuth={junk}")
    absent = refused("--detector", "learned-azimuth", "--set", f"models.azimuth={tmp_path}/none.onnx")
    assert "cannot read the model" in absent


@pytest.mark.parametrize(
    ("content", "found"),
    [
        ("", "is empty"),
        ("mmsi,time,lon,lat\n", "a header and no rows"),
        ("mmsi,time,lon,lat\n1,2013-05-21T10:00:00Z,,\n2,soon,1,2\n", "1 no readable time, 1 no position"),
        ("a,b\n1,2\n", "found columns a, b"),
        (JUNK, "no known AIS dialect"),
        (b"PK\x03\x04" + b"x" * 300, "is damaged"),
        ("!AIVDM,1,1,,A,garbage,0*00\n" * 5, "5 undecodable sentence"),
    ],
)
def test_ais_without_positions(refused, tmp_path, content, found):
    assert found in refused("--ais", write(tmp_path / "a.csv", content))


def test_ais_that_is_not_there(refused, tmp_path):
    assert "No such file" in refused("--ais", tmp_path / "none.csv")


def test_an_output_that_is_a_file_is_kept(said, record, tmp_path):
    file = write(tmp_path / "file", "keep me")
    given = ("track", record / "waveforms.mseed", "--station", record / "station.xml", "--out")
    assert "is a file; give a folder" in said(*given, file)
    assert "Not a directory" in said(*given, file / "below" / "it")
    assert "is a file" in said("simulate", "--hours", "0.2", "--out", file)
    assert "empty text" in said(*given, "")
    assert file.read_text() == "keep me"


def test_a_place_that_cannot_be_written(said, record, tmp_path):
    try:
        (tmp_path / "closed").mkdir(mode=0o500)
        (tmp_path / "closed" / "x").touch()
    except PermissionError:
        given = ("track", record / "waveforms.mseed", "--station", record / "station.xml")
        assert "cannot write into" in said(*given, "--out", tmp_path / "closed" / "out")
    else:
        pytest.skip("this user may write anywhere")


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ([], "Missing command; see obsnet --help"),
        (["trak"], "Did you mean 'track'?"),
        (["track"], "Missing argument"),
        (["track", "w.mseed"], "Missing option '--station'"),
        (["track", "w.mseed", "--nonsense"], "No such option: --nonsense"),
        (["reproduce", "magic"], "no experiment 'magic'; choose one of table1"),
        (["reproduce", "tkbd", "--detector", "all"], "experiment tkbd has no detectors to choose from"),
        (["reproduce", "table1", "--detector", "odd"], "detector must be one of analytic"),
        (["reproduce", "tkbd", "--runs", "0"], "--runs"),
        (["reproduce", "table1", "--seed", "-1"], "seed must be a whole number of at least 0"),
        (["reproduce", "tkbd", "--seed", "-1"], "seed must be a whole number of at least 0"),
        (["bench", "station", "--detector", "odd"], "obsnet: error: detector must be one of learned"),
        (["plot", ".", "--figure", "4"], "no figure 4; choose one of 3, 5, 6, 7, 8"),
        (["plot", "nowhere"], "is not a folder of `obsnet track`"),
        (["evaluate", "nowhere", "--ais", "none.csv"], "nowhere is not a folder"),
        (["simulate", "--out", "o", "--hours", "inf"], "hours must lie between"),
        (["simulate", "--out", "o", "--seed", "-1"], "seed must be a whole number of at least 0"),
        (["simulate", "--out", "o", "--start", "soon"], "cannot read the start 'soon'"),
        (["simulate", "--out", "o", "--ais", "none.csv"], "cannot read the AIS file none.csv"),
        (["fetch", "YV", "--start", "2013-01-01", "--end", "2013-01-02", "--out", "o"], "given as NET.STA"),
        (["fetch", "YV.A", "--start", "2013-01-03", "--end", "2013-01-02", "--out", "o"], "before the end"),
    ],
)
def test_commands_that_cannot_be(said, tmp_path, monkeypatch, arguments, found):
    monkeypatch.chdir(tmp_path)
    assert found in said(*arguments)
    assert not list(tmp_path.iterdir())


def test_of_several_stations_one_is_simulated(obsnet, said, inventory, tmp_path):
    twice((changed := copy.deepcopy(inventory))[0])
    changed.write(str(tmp_path / "s.xml"), "STATIONXML")
    given = ("simulate", "--hours", "0.1", "--out", tmp_path / "o", "--station", tmp_path / "s.xml")
    assert "name one with --code" in said(*given)
    assert obsnet(*given, "--code", "XX.SIM02", "--quiet") == (0, [], [])
    assert "XX.SIM02" in (tmp_path / "o" / "truth.json").read_text()


def test_a_folder_that_is_no_run(said, record):
    assert "detections.csv" in said("evaluate", record, "--ais", record / "ais.csv")
    assert "detections.csv is missing" in said("plot", record)


def test_calibration_without_a_passage(said, record, tmp_path):
    later = (record / "ais.csv").read_text().replace("2013-", "2014-")
    given = ("calibrate", record / "waveforms.mseed", "--station", record / "station.xml", "--out")
    line = said(*given, tmp_path / "out", "--ais", write(tmp_path / "later.csv", later), "--quiet")
    assert "none of 1 AIS tracks passes" in line
    assert "give AIS of the record's own time and place" in line
    assert not (tmp_path / "out").exists()


def test_a_failure_leaves_the_run_before_as_it_was(said, record, finished):
    before = {path.name: path.read_bytes() for path in finished.iterdir()}
    given = ("track", record / "waveforms.mseed", "--station", record / "station.xml", "--out", finished)
    said(*given, "--end", "2013-05-21T10:00:50Z")
    said(*given, "--tracker", "magic")
    assert {path.name: path.read_bytes() for path in finished.iterdir()} == before


def test_a_defect_of_ours_is_not_dressed_as_bad_input(record, tmp_path, monkeypatch):
    def broken(*given, **options):
        raise ZeroDivisionError

    monkeypatch.setattr("obsnet.run.open_waveforms", broken)
    with pytest.raises(ZeroDivisionError):
        main(["track", "w", "--station", str(record / "station.xml"), "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_help_keeps_units(obsnet):
    """Brackets are no markup."""
    for command, unit in (("track", "[deg]"), ("evaluate", "[km]")):
        _, told, _ = obsnet(command, "-h")
        assert unit in "\n".join(told)


def test_help_is_help(obsnet):
    for arguments in (["--help"], ["-h"], ["track", "-h"]):
        status, told, errors = obsnet(*arguments)
        assert (status, errors) == (0, [])
        assert any("Usage" in line for line in told)

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import CubicSpline

import obsnet
from obsnet.detectors.learned import LearnedAzimuthDetector, _spline
from obsnet.detectors.model_card import MODELS, ModelFile, shipped
from obsnet.errors import ModelError
from obsnet.layout import from_posix, to_posix
from obsnet.pipeline import Pipeline, RunConfig
from obsnet.signals.station import Channel, Station

HOP = 10.24
T0 = 1369130400.0


def made_spectra(rng, frames=300, azimuth=None, stretch=slice(None)):
    """Isotropic noise, and a ship: lines and some broadband noise that come from one azimuth."""
    frequency = np.arange(513) / 20.48
    time = np.ceil(T0 / HOP) * HOP + HOP * np.arange(frames)

    def noise():
        shape = (len(frequency), frames)
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)

    p, east, north = noise(), noise() / 1.5e6 / 1.7, noise() / 1.5e6 / 1.7
    if azimuth is not None:
        ship = 0.7 * noise()
        ship[[240, 270, 300, 330, 390, 450]] *= 25
        mask = np.zeros(frames)
        mask[stretch] = 1
        ship *= mask
        p += ship
        east -= ship / 1.5e6 * np.sin(np.deg2rad(azimuth))
        north -= ship / 1.5e6 * np.cos(np.deg2rad(azimuth))
    dims = ("frequency", "time")
    return xr.Dataset(
        {"p": (dims, p), "east": (dims, east), "north": (dims, north)},
        {"frequency": frequency, "time": from_posix(time)},
    )


@pytest.fixture(scope="module")
def station():
    channels = (Channel("XX.A.00.BDH", "pressure"), Channel("XX.A.00.BH1", "motion"))
    return Station("XX.A", -21.4, 54.2, 4340.0, channels)


def maps_of(station, spectra, size=97, middle=None):
    """Azimuth maps of a run cut into blocks; with `middle`, stopped and continued at that frame."""
    config = RunConfig(detector="learned-azimuth")
    spectra = spectra[["east", "north", *(["p"] if "p" in spectra else [])]]
    pipeline, found = Pipeline(station, config), []
    before = 0
    edges = sorted(
        {*range(size, spectra.sizes["time"], size), spectra.sizes["time"], *([middle] if middle else [])}
    )
    for edge in edges:
        found += pipeline.push(spectra.isel(time=slice(before, edge)))
        if edge == middle:
            state = {key: value.copy() for key, value in pipeline.state().items()}
            pipeline = Pipeline(station, config)
            pipeline.restore(state)
        before = edge
    found += pipeline.flush()
    return xr.concat([part.maps[["azimuth_llr", "azimuth_coverage"]] for part in found], "time")


def test_the_shipped_model_is_small_and_verified():
    found = ModelFile.read(shipped("azimuth"), "azimuth")
    assert len(found.content) < 2_000_000 and found.card.data_digest and found.card.metrics
    assert found.card.about["parameters"] < 300_000


def test_a_shipped_model_that_was_altered_is_refused(tmp_path, monkeypatch):
    target = tmp_path / "azimuth.onnx"
    content = bytearray(shipped("azimuth").read_bytes())
    content[-40] ^= 1
    target.write_bytes(bytes(content))
    (tmp_path / "digests.json").write_text((MODELS / "digests.json").read_text())
    monkeypatch.setattr("obsnet.detectors.model_card.MODELS", tmp_path)
    with pytest.raises(ModelError, match="altered"):
        LearnedAzimuthDetector()
    target.unlink()
    with pytest.raises(ModelError, match="use --detector analytic"):
        LearnedAzimuthDetector()


def test_a_session_keeps_no_identity_and_tells_nobody(tmp_path):
    """onnxruntime's telemetry writes the device's identity, and what it has not sent yet, below the user's cache."""
    code = "from obsnet.detectors.model_card import ModelFile, shipped; ModelFile.read(shipped('range')).session()"
    paths = {
        "XDG_CACHE_HOME": str(tmp_path),
        "HOME": str(tmp_path),
        "PYTHONPATH": str(Path(obsnet.__file__).parents[1]),
    }
    clean = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    subprocess.run([sys.executable, "-c", code], env=clean | paths, check=True)
    assert [path for path in tmp_path.rglob("*") if "onnxruntime" in path.name] == []


def test_any_cut_of_the_record_gives_the_same_maps(station):
    spectra = made_spectra(np.random.default_rng(0), azimuth=70.0)
    whole = maps_of(station, spectra, 300)
    for size in (13, 60):
        np.testing.assert_array_equal(maps_of(station, spectra, size)["azimuth_llr"], whole["azimuth_llr"])


def test_a_station_that_was_stopped_goes_on(station):
    spectra = made_spectra(np.random.default_rng(1), azimuth=70.0)
    through, again = maps_of(station, spectra, 60), maps_of(station, spectra, 60, middle=151)
    np.testing.assert_array_equal(again["azimuth_llr"], through["azimuth_llr"])


def test_a_ship_is_found_where_it_is_and_nothing_where_it_is_not(station):
    spectra = made_spectra(np.random.default_rng(2), azimuth=70.0, stretch=slice(100, 200))
    maps = maps_of(station, spectra)
    minutes, times = to_posix(maps["time"].values), to_posix(spectra["time"].values)
    llr = maps["azimuth_llr"].values
    inside = (minutes > times[100] + 120) & (minutes < times[200] - 120)
    outside = (minutes < times[100] - 120) | (minutes > times[200] + 120)
    assert np.all(abs(maps["azimuth"].values[llr[inside].argmax(axis=1)] - 70) <= 3)
    assert np.all(llr[inside].max(axis=1) > 5)
    assert np.median(llr[outside].max(axis=1)) < 2
    assert maps["azimuth_llr"].dtype == np.float32


def test_turning_the_station_turns_the_map(station):
    spectra = made_spectra(np.random.default_rng(3), azimuth=70.0)
    angle = np.deg2rad(36.0)
    east = spectra["east"] * np.cos(angle) + spectra["north"] * np.sin(angle)
    north = spectra["north"] * np.cos(angle) - spectra["east"] * np.sin(angle)
    before = maps_of(station, spectra)["azimuth_llr"].values
    after = maps_of(station, spectra.assign(east=east, north=north))["azimuth_llr"].values
    np.testing.assert_allclose(after, np.roll(before, 36, axis=1), atol=0.05)


def test_gaps_cost_coverage(station):
    spectra = made_spectra(np.random.default_rng(4), azimuth=70.0)
    for name in ("p", "east", "north"):
        spectra[name].values[:, 120:180] = np.nan
    maps = maps_of(station, spectra)
    silent = maps["azimuth_coverage"].values == 0
    assert silent.any() and np.isnan(maps["azimuth_llr"].values[silent]).all()
    assert np.isfinite(maps["azimuth_llr"].values[~silent]).all()


def test_without_a_hydrophone_the_side_is_unknown(station):
    spectra = made_spectra(np.random.default_rng(5), azimuth=70.0).drop_vars("p")
    maps = maps_of(station, spectra)
    llr = maps["azimuth_llr"].values
    np.testing.assert_allclose(llr[:, :180], llr[:, 180:], atol=1e-4)
    assert maps["azimuth"].attrs["ambiguity_deg"] == 180
    assert np.median(abs(llr[5:-5, :180].argmax(axis=1) - 70)) <= 5


@pytest.mark.parametrize("count", [24, 120])
def test_between_the_models_azimuths_runs_the_periodic_cubic_spline(count):
    knots = np.arange(count + 1) * 360.0 / count
    values = np.random.default_rng(0).standard_normal(count)
    azimuth = np.arange(-180.0, 540.0, 0.7)
    exact = CubicSpline(knots, np.append(values, values[0]), bc_type="periodic")(azimuth % 360.0)
    np.testing.assert_allclose(values @ _spline(count, azimuth), exact, atol=2e-6)

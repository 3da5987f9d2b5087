import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import uniform_filter1d

from obsnet.detectors.azimuth_features import CHANNELS, AzimuthFeatures, Cells, _smooth, cell_index
from obsnet.errors import LayoutError, ModelError
from obsnet.layout import from_posix

HOP = 10.24
T0 = 1369130400.0


def random_spectra(rng, frames=300, top_hz=25.0, azimuth=None):
    frequency = np.arange(0.0, top_hz + 1e-6, 1 / 20.48)
    time = np.ceil(T0 / HOP) * HOP + HOP * np.arange(frames)
    shape = (len(frequency), frames)

    def noise():
        return (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)).astype(np.complex64)

    p, east, north = noise(), 1e-6 * noise(), 1e-6 * noise()
    if azimuth is not None:
        line = slice(int(15 * 20.48), int(15 * 20.48) + 3)
        p[line] *= 30
        east[line] -= 1e-6 * p[line] * np.sin(np.deg2rad(azimuth))
        north[line] -= 1e-6 * p[line] * np.cos(np.deg2rad(azimuth))
    dims = ("frequency", "time")
    return xr.Dataset(
        {"p": (dims, p), "east": (dims, east), "north": (dims, north)},
        {"frequency": frequency, "time": from_posix(time)},
    )


def cells_of(spectra, size):
    features = AzimuthFeatures()
    parts = [
        features.push(spectra.isel(time=slice(i, i + size))) for i in range(0, spectra.sizes["time"], size)
    ]
    parts = [part for part in [*parts, features.flush()] if len(part.index)]
    whole = parts[0]
    for part in parts[1:]:
        whole = whole.joined(part)
    return whole


def test_any_split_gives_the_same_cells():
    spectra = random_spectra(np.random.default_rng(0))
    spectra["p"].values[:, 100:130] = np.nan
    whole = cells_of(spectra, 300)
    for size in (1, 7, 61):
        parts = cells_of(spectra, size)
        np.testing.assert_array_equal(parts.index, whole.index)
        np.testing.assert_array_equal(parts.invariants, whole.invariants)
        np.testing.assert_array_equal(parts.phasor, whole.phasor)
    assert np.all(np.diff(whole.index) == 1)


def test_memory_survives_a_restart():
    spectra = random_spectra(np.random.default_rng(1), frames=200)
    through = AzimuthFeatures()
    through.push(spectra.isel(time=slice(0, 130)))
    state = {key: value.copy() for key, value in through.state().items()}
    after = through.push(spectra.isel(time=slice(130, 200)))
    again = AzimuthFeatures()
    again.restore(state)
    restored = again.push(spectra.isel(time=slice(130, 200)))
    np.testing.assert_array_equal(restored.invariants, after.invariants)
    assert len(after.index) > 20


def test_turning_the_station_turns_the_phasors_and_nothing_else():
    spectra = random_spectra(np.random.default_rng(2), frames=120, azimuth=70.0)
    angle = np.deg2rad(37.0)
    east = spectra["east"] * np.cos(angle) + spectra["north"] * np.sin(angle)
    north = spectra["north"] * np.cos(angle) - spectra["east"] * np.sin(angle)
    before, after = cells_of(spectra, 50), cells_of(spectra.assign(east=east, north=north), 50)
    np.testing.assert_allclose(after.invariants, before.invariants, atol=2e-3)
    np.testing.assert_allclose(after.phasor, before.phasor * np.exp(1j * angle), atol=2e-3)


def test_a_line_stands_out_and_points_to_the_ship():
    cells = cells_of(random_spectra(np.random.default_rng(3), azimuth=70.0), 300)
    line = int(np.argmax(cells.invariants[20:-5, CHANNELS.index("focus_near")].mean(axis=0)))
    assert abs(line - int((15 - 11) * 20.48)) <= 3
    azimuth = np.rad2deg(np.angle(cells.phasor[20:-5, line].mean()))
    assert abs(azimuth - 70.0) < 2.0
    assert cells.invariants[20:-5, CHANNELS.index("line"), line].mean() > 1.0


def test_a_gap_is_no_data_not_silence():
    spectra = random_spectra(np.random.default_rng(4), frames=150)
    for name in ("p", "east", "north"):
        spectra[name].values[:, 60:90] = np.nan
    cells = cells_of(spectra, 150)
    assert 12 <= np.count_nonzero(~cells.valid) <= 15
    assert np.all(cells.invariants[~cells.valid] == 0) and np.isfinite(cells.invariants).all()
    padded = cells.between(int(cells.index[0]) - 4, int(cells.index[0]) + 2)
    assert padded.valid.tolist() == [False] * 4 + [True] * 2


def test_cells_fill_a_window_about_a_minute():
    minute = np.ceil(T0 / 60) * 60
    inside = cell_index(minute + np.array([-90.0, 89.9]))
    assert inside[1] - inside[0] == 8
    assert cell_index(minute + 90.0) == inside[1] + 1


def test_without_a_hydrophone_the_angle_is_doubled():
    spectra = random_spectra(np.random.default_rng(5), azimuth=70.0)
    cells = cells_of(spectra.drop_vars("p"), 300)
    assert cells.ambiguity_deg == 180
    line = int((15 - 11) * 20.48) + 1
    azimuth = np.rad2deg(np.angle(cells.phasor[20:-5, line].mean())) / 2 % 180
    assert abs(azimuth - 70.0) < 3.0


def test_what_cannot_serve_is_refused():
    spectra = random_spectra(np.random.default_rng(6), frames=5)
    with pytest.raises(LayoutError, match="east"):
        AzimuthFeatures().push(spectra.drop_vars("east"))
    with pytest.raises(ModelError, match="24 Hz"):
        AzimuthFeatures().push(random_spectra(np.random.default_rng(6), frames=5, top_hz=12.5))
    assert isinstance(AzimuthFeatures().flush(), Cells)


@pytest.mark.parametrize("count", [5, 43])
def test_smoothing_is_a_running_mean_reflected_about_the_ends(count):
    values = np.random.default_rng(0).standard_normal((7, 266)).astype(np.float32)
    np.testing.assert_allclose(_smooth(values, count), uniform_filter1d(values, count, axis=1), atol=1e-6)

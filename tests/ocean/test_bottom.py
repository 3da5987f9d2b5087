import numpy as np
import pytest

from obsnet.ocean.bottom import Bottom

WATER_SPEED = 1530.0
SLOWNESS = np.linspace(0.0, 1.0 / WATER_SPEED, 2001)


def boundary_system(p, bottom, c):
    """Oracle: R from the boundary conditions on potentials exp(iω(t − px − qz)), as a linear system."""

    def q(speed):
        return np.conj(np.sqrt(1.0 / speed**2 - p**2 + 0j))

    qw, qa, qb = q(c), q(bottom.p_speed_mps), q(bottom.s_speed_mps)
    rho, rho_w, mu = (
        bottom.density_kgm3,
        bottom.water_density_kgm3,
        bottom.density_kgm3 * bottom.s_speed_mps**2,
    )
    # Unknowns: reflected, P and S potentials; displacement u = ∇φ + (−∂zψ, ∂xψ).
    bulk = rho * (1.0 - 2.0 * bottom.s_speed_mps**2 * p**2)
    system = np.array(
        [
            [-qw, -qa, -p],  # vertical displacement: qw(1 − r) = qa·φ + p·ψ
            [rho_w, -bulk, -2.0 * mu * p * qb],  # normal stress against water pressure
            [0.0, 2.0 * p * qa, p**2 - qb**2],  # no shear stress
        ]
    )
    return np.linalg.solve(system, np.array([-qw, -rho_w, 0.0]))[0]


@pytest.mark.parametrize("bottom", [Bottom(), Bottom(1700.0, 300.0, 1800.0), Bottom(5000.0, 2500.0, 2700.0)])
def test_reflection_solves_the_boundary_conditions(bottom):
    slowness = SLOWNESS[1:-1:40]
    expected = [boundary_system(p, bottom, WATER_SPEED) for p in slowness]
    np.testing.assert_allclose(bottom.reflection(slowness, WATER_SPEED), expected, atol=1e-9)


def test_normal_incidence_is_the_contrast_of_impedance():
    bottom = Bottom(2000.0, 500.0, 2060.0, 1030.0)
    expected = (2060.0 * 2000.0 - 1030.0 * 1530.0) / (2060.0 * 2000.0 + 1030.0 * 1530.0)
    assert bottom.reflection(0.0, 1530.0) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("shear", [0.0, 200.0, 500.0, 1000.0, 1700.0])
def test_no_energy_is_made(shear):
    assert np.abs(Bottom(2000.0, shear).reflection(SLOWNESS, WATER_SPEED)).max() <= 1.0 + 1e-12


def test_a_fluid_bottom_reflects_everything_beyond_its_critical_angle():
    reflection = Bottom(2000.0, 0.0).reflection(SLOWNESS, WATER_SPEED)
    beyond = SLOWNESS > 1.0 / 2000.0 + 1e-9
    np.testing.assert_allclose(np.abs(reflection[beyond]), 1.0, rtol=1e-12)
    assert np.abs(reflection[SLOWNESS < 0.99 / 2000.0]).max() < 0.95


def test_shear_waves_carry_energy_away_unless_they_are_evanescent_too():
    slow = np.abs(Bottom(2000.0, 500.0).reflection(SLOWNESS[1900], WATER_SPEED))
    fast = np.abs(Bottom(5000.0, 2500.0).reflection(1.0 / 2000.0, WATER_SPEED))
    assert slow < 0.999
    assert fast == pytest.approx(1.0, rel=1e-12)


def test_total_reflection_advances_the_phase_and_displaces_a_beam_forward():
    # exp(iω(t − px) + iφ(p)) adds up where x = dφ/d(ωp): the energy must come out ahead of where it went in.
    reflection = Bottom(2000.0, 0.0).reflection(SLOWNESS, WATER_SPEED)
    phase = np.unwrap(np.angle(reflection[(SLOWNESS > 1.0 / 2000.0) & (SLOWNESS < 1.0 / WATER_SPEED)]))
    assert np.all(np.diff(phase) > 0)
    assert 0 < phase[0] < 0.3 and 2.8 < phase[-1] < np.pi


def test_grazing_waves_are_cancelled():
    assert Bottom().reflection(1.0 / WATER_SPEED, WATER_SPEED) == pytest.approx(-1.0, abs=1e-6)


def test_missing_rays_stay_missing():
    assert np.isnan(Bottom().reflection(np.nan, WATER_SPEED))

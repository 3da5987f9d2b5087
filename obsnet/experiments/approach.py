"""The simulated approach of the track-before-detect paper: a target that nears a line array in heavy-tailed
sea noise.

Source: Bossér et al., Broadband passive sonar track-before-detect using raw acoustic data, section V-C and
algorithm 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from obsnet.arrays.beamforming import Beamformer, HydrophoneArray
from obsnet.arrays.sea_noise import NoiseSector, SeaNoise
from obsnet.arrays.whitening import NoiseModel
from obsnet.errors import ConfigError


def archipelago() -> SeaNoise:
    """Wind noise from everywhere, traffic from two sectors, the machinery of two ships; total power 1."""
    return SeaNoise(
        self_noise=0.01,
        diffuse=0.19,
        sectors=(
            NoiseSector(-20.0, 8.0, 0.35, slope_db_octave=-9.0),
            NoiseSector(35.0, 10.0, 0.35, slope_db_octave=-9.0),
            NoiseSector(-5.0, 2.0, 0.05, slope_db_octave=0.0, line_hz=880.0, line_width_hz=3.0),
            NoiseSector(20.0, 2.0, 0.05, slope_db_octave=0.0, line_hz=800.0, line_width_hz=3.0),
        ),
    )


@dataclass(frozen=True)
class Truth:
    """What happens, at the middle of each batch; azimuth, range and SNR are NaN while there is no target."""

    time_s: np.ndarray
    azimuth_deg: np.ndarray
    range_m: np.ndarray
    snr_db: np.ndarray

    @property
    def present(self) -> np.ndarray:
        """Whether there is a target, bool, dims (batch,)."""
        return np.isfinite(self.azimuth_deg)


@dataclass(frozen=True)
class Approach:
    """Array, noise and course.

    The target goes straight from (`start_range_m`, `start_azimuth_deg`) to (`end_range_m`,
    `end_azimuth_deg`) at `speed_mps`: 829 s. Before it, `target_free_s` of noise alone. Its SNR is 18
    log10(`reference_range_m` / r), eq. 40: spreading between cylindrical and spherical.
    """

    hydrophones: int = 8
    spacing_m: float = 0.93
    sound_speed_mps: float = 1500.0
    carrier_hz: float = 750.0
    sampling_rate: float = 375.0
    nperseg: int = 64
    degrees_of_freedom: float = 12.0
    order: int = 14
    start_range_m: float = 2000.0
    start_azimuth_deg: float = -50.0
    end_range_m: float = 300.0
    end_azimuth_deg: float = 50.0
    speed_mps: float = 2.5
    reference_range_m: float = 200.0
    spreading_db: float = 18.0
    target_free_s: float = 60.0
    sea: SeaNoise = field(default_factory=archipelago)

    def __post_init__(self) -> None:
        if not (
            self.speed_mps > 0 and self.start_range_m > 0 and self.end_range_m > 0 and self.target_free_s >= 0
        ):
            raise ConfigError(
                "an approach needs a positive speed, positive ranges and a target-free time of 0 or more"
            )

    @property
    def interval_s(self) -> float:
        """Time between batches."""
        return self.nperseg / self.sampling_rate

    @property
    def array(self) -> HydrophoneArray:
        """Line array, broadside to the north."""
        return HydrophoneArray.line(self.hydrophones, self.spacing_m, sound_speed_mps=self.sound_speed_mps)

    def beamformer(self, whitening: NoiseModel | None = None) -> Beamformer:
        """Beams 1° apart, all ahead of the array."""
        grid = np.arange(-90.0, 91.0)
        return Beamformer(self.array, self.sampling_rate, self.nperseg, grid, self.carrier_hz, whitening)

    def noise(self) -> NoiseModel:
        """The true ambient noise: a stable VAR with the sea's autocovariances."""
        return self.sea.noise_model(self.array, self.sampling_rate, self.carrier_hz, self.order)

    def truth(self) -> Truth:
        """The course, batch by batch."""
        angle = np.deg2rad([self.start_azimuth_deg, self.end_azimuth_deg])
        ends = np.array([self.start_range_m, self.end_range_m])[:, None] * np.stack(
            [np.sin(angle), np.cos(angle)], 1
        )
        length = float(np.linalg.norm(ends[1] - ends[0]))
        free, moving = (int(span / self.interval_s) for span in (self.target_free_s, length / self.speed_mps))
        time = (np.arange(free + moving) + 0.5) * self.interval_s
        run = self.speed_mps * (time - free * self.interval_s)
        east, north = (ends[0] + (ends[1] - ends[0]) / length * run[:, None]).T
        distance, azimuth = np.hypot(east, north), np.rad2deg(np.arctan2(east, north))
        distance[:free] = azimuth[:free] = np.nan
        snr = self.spreading_db * np.log10(self.reference_range_m / distance)
        return Truth(time, azimuth, distance, snr)

    def target_free(self, duration_s: float) -> Truth:
        """Noise alone for `duration_s`."""
        time = (np.arange(int(duration_s / self.interval_s)) + 0.5) * self.interval_s
        nothing = np.full(len(time), np.nan)
        return Truth(time, nothing, nothing, nothing)

    def whitened_snr_db(self, truth: Truth, noise: NoiseModel) -> np.ndarray:
        """SNR after the noise is white: 10 log10 of η |E e eᵀ|^{1/M} times the mean of ‖g(ψ, f)‖²/M over f.

        g = Σ^−½ A(f) h(ψ, f) is what whitening leaves of the wave's phases: more where the sea is quiet.
        """
        beams = self.beamformer()
        transfer = noise.transfer((beams.frequency_hz - beams.carrier_hz) / beams.sampling_rate)
        there = truth.present
        white = np.einsum("fij,bjf->bif", transfer, beams.phases(truth.azimuth_deg[there]))
        gain = self._level(noise) * (np.abs(white) ** 2).sum(axis=1).mean(axis=1) / self.hydrophones
        snr = truth.snr_db.copy()
        snr[there] += 10.0 * np.log10(gain)
        return snr

    def simulate(self, truth: Truth, noise: NoiseModel, rng: np.random.Generator) -> np.ndarray:
        """Simulated samples, dims (batch, N, hydrophone): the paper's algorithm 1.

        Coloured noise e_k; a white source of power 10^(SNR/10) |E e eᵀ|^{1/M} on top, delayed over the
        array; both times √(ν/χ²_ν), one draw per batch.
        """
        batches = len(truth.time_s)
        samples = noise.simulate(batches * self.nperseg, rng).reshape(batches, self.nperseg, -1)
        there = truth.present
        amplitude = np.sqrt(self._level(noise) * 10.0 ** (truth.snr_db[there] / 10.0))
        source = amplitude[:, None] * rng.standard_normal((there.sum(), self.nperseg))
        samples[there] += self.beamformer().delay(source, truth.azimuth_deg[there])
        nu = self.degrees_of_freedom
        return samples * np.sqrt(nu / rng.chisquare(nu, batches))[:, None, None]

    def _level(self, noise: NoiseModel) -> float:
        return float(np.exp(np.linalg.slogdet(noise.autocovariance())[1] / self.hydrophones))

"""Beam power of whitened batches in; log-likelihood ratio of a source at an azimuth and SNR out.

The model of a whitened batch z of N samples at M hydrophones is z ~ t(ν, 0, (ν−2)/ν (η H(ψ)Hᵀ(ψ) + I))
with a source, and the same with η = 0 without. Since HᵀH = M I, the determinant is (1 + Mη)^N and the inverse
I − η/(1 + Mη) H Hᵀ, so that

    ln L = −(N/2) ln(1 + Mη) − ((ν + NM)/2) ln(1 − c B(ψ, z)),   c = η / ((1 + Mη)(ν − 2 + ‖z‖²))
    ln L = −(N/2) ln(1 + Mη) + ½ η B(ψ, z) / (1 + Mη)            as ν → ∞, the Gaussian one.

Source: Bossér et al., Broadband passive sonar track-before-detect using raw acoustic data, eqs 17–28
(28 with the ν − 2 of its scale matrix).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from obsnet.errors import ConfigError

GAUSSIAN = np.inf


def beam_llr(
    power: np.ndarray,
    energy: np.ndarray,
    snr_db: np.ndarray | float,
    nperseg: int,
    hydrophones: int,
    degrees_of_freedom: float = GAUSSIAN,
) -> np.ndarray:
    """Log-likelihood ratio, natural log, of whitened batches.

    Parameters
    ----------
    power : array
        B(ψ, z), unit noise power.
    energy : array, broadcasts with `power`
        ‖z‖² of the batch.
    snr_db : array or float, broadcasts with `power`
        10 log10 η: power of the source at one hydrophone over that of the noise, after whitening.
    nperseg, hydrophones : int
        N and M.
    degrees_of_freedom : float
        ν > 2; infinite for Gaussian noise.

    Raises
    ------
    ConfigError
        ν is 2 or less: the noise has no variance.

    >>> round(float(beam_llr(16.0, 16.0, 0.0, 2, 2)), 6)
    1.568054
    """
    if not degrees_of_freedom > 2:
        raise ConfigError(f"the noise needs more than 2 degrees of freedom, found {degrees_of_freedom}")
    snr = 10.0 ** (np.asarray(snr_db, float) / 10.0)
    gain = 1.0 + hydrophones * snr
    evidence = -0.5 * nperseg * np.log(gain)
    if np.isinf(degrees_of_freedom):
        return evidence + 0.5 * snr / gain * power
    share = snr * power / (gain * (degrees_of_freedom - 2.0 + energy))
    return evidence - 0.5 * (degrees_of_freedom + nperseg * hydrophones) * np.log1p(-share)


class BeamLikelihood:
    """`beam_llr` of one batch at any azimuth and SNR, the power interpolated linearly between beams.

    Outside the beams' azimuths a source is impossible: minus infinity.

    Parameters
    ----------
    first_deg, step_deg : float
        Azimuth of the first beam and spacing of the beams.
    nperseg, hydrophones : int
    degrees_of_freedom : float
        ν; infinite for Gaussian noise.
    """

    def __init__(
        self,
        first_deg: float,
        step_deg: float,
        nperseg: int,
        hydrophones: int,
        degrees_of_freedom: float = GAUSSIAN,
    ) -> None:
        if not (degrees_of_freedom > 2 and step_deg > 0):
            raise ConfigError(
                "degrees of freedom must exceed 2 and the beams step upwards, "
                f"found {degrees_of_freedom} and {step_deg} deg"
            )
        self._grid = (float(first_deg), float(step_deg))
        self._size = (int(nperseg), int(hydrophones))
        self._nu = float(degrees_of_freedom)

    def __call__(
        self, power: np.ndarray, energy: float, azimuth_deg: np.ndarray, snr_db: np.ndarray
    ) -> np.ndarray:
        """Log-likelihood ratios of one batch, dims (hypothesis,).

        Parameters
        ----------
        power : array, dims (beam,)
        energy : float
        azimuth_deg, snr_db : arrays, dims (hypothesis,)
        """
        return _interpolated(power, energy, azimuth_deg, snr_db, *self._grid, *self._size, self._nu)


@njit(cache=True, nogil=True, error_model="numpy")
def _interpolated(power, energy, azimuth_deg, snr_db, first, step, nperseg, hydrophones, nu):
    count = azimuth_deg.shape[0]
    out = np.empty(count)
    last = power.shape[0] - 1
    for i in range(count):
        position = (azimuth_deg[i] - first) / step
        if not 0.0 <= position <= last:
            out[i] = -np.inf
            continue
        cell = min(int(position), last - 1)
        right = position - cell
        beam = (1.0 - right) * power[cell] + right * power[cell + 1]
        snr = np.exp(0.23025850929940458 * snr_db[i])
        gain = 1.0 + hydrophones * snr
        evidence = -0.5 * nperseg * np.log(gain)
        if np.isinf(nu):
            out[i] = evidence + 0.5 * snr / gain * beam
        else:
            share = snr * beam / (gain * (nu - 2.0 + energy))
            out[i] = evidence - 0.5 * (nu + nperseg * hydrophones) * np.log(1.0 - share)
    return out

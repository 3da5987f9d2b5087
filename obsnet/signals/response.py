"""Complex response of one channel, counts per pascal or per metre a second, from its StationXML stages.

Evaluated here rather than by obspy's evalresp, whose import alone costs more than a station-day of spectra;
the tests hold the two together. Only response lists, which carry no formula, are still handed to evalresp.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from obsnet.errors import StationError

_MOTION = {"M": 0, "M/S": 1, "M/S/S": 2, "M/S**2": 2, "M/S^2": 2, "M/(S**2)": 2, "M/SEC": 1, "M/SEC**2": 2}
_METRE_PREFIX = {"": 1.0, "C": 1e-2, "M": 1e-3, "U": 1e-6, "N": 1e-9}
_PASCAL = {
    "PA": 1.0, "PASCAL": 1.0, "PASCALS": 1.0, "HPA": 1e2, "KPA": 1e3, "UPA": 1e-6, "MICROPASCAL": 1e-6,
    "MICROPASCALS": 1e-6, "BAR": 1e5, "MBAR": 1e2,
}  # fmt: skip


def frequency_response(response: Any, frequency: np.ndarray, kind: str, name: str = "") -> np.ndarray:
    """Counts per Pa (pressure) or per m/s (motion) at each frequency.

    Parameters
    ----------
    response : obspy Response or None
        None, or a response without stages and sensitivity, is taken as 1 at every frequency.
    frequency : ndarray (n,)
        Hz.
    kind : {"pressure", "motion"}
        What the channel measures.
    name : str
        SEED id, for messages.

    Returns
    -------
    ndarray (n,) complex128
        Fields exp(+iωt). Zero at 0 Hz wherever the sensor is.

    Raises
    ------
    StationError
        Units that are no pressure or motion, a stage that has no linear response, or a gain of 0.
    """
    frequency = np.asarray(frequency, float)
    if not described(response):
        return np.ones(frequency.size, complex)
    unit = _input_unit(response)
    if any(type(stage).__name__ == "ResponseListResponseStage" for stage in response.response_stages):
        total = _evalresp(response, frequency, name)
    else:
        total = np.full(frequency.size, _sensitivity(response))
        for stage in response.response_stages:
            total = total * _stage(stage, frequency, name)
    total = total * _unit_factor(unit, kind, frequency, name)
    if (frequency > 0).any() and not (np.isfinite(total) & (total != 0))[frequency > 0].any():
        raise StationError(
            f"the response of {name} is 0 at every frequency; correct its gains in the StationXML"
        )
    return total


def described(response: Any) -> bool:
    """Whether a response says anything: it has stages or an overall sensitivity."""
    if response is None:
        return False
    sensitivity = response.instrument_sensitivity
    return bool(response.response_stages) or (sensitivity is not None and bool(sensitivity.value))


def _sensitivity(response: Any) -> complex:
    """Overall sensitivity where there are no stages, else 1: the stages carry their own gains."""
    return complex(1.0 if response.response_stages else response.instrument_sensitivity.value)


def _input_unit(response: Any) -> str:
    first = response.response_stages[0].input_units if response.response_stages else None
    return str(first or getattr(response.instrument_sensitivity, "input_units", "") or "")


def _unit_factor(unit: str, kind: str, frequency: np.ndarray, name: str) -> np.ndarray | float:
    """Input units per Pa, or per m/s: a displacement of velocity v is v/(iω), an acceleration iωv."""
    upper = unit.upper().replace(" ", "")
    if kind == "pressure":
        if upper not in _PASCAL:
            raise StationError(
                f"the response of {name} takes '{unit}', not a pressure; correct its StationXML units"
            )
        return 1.0 / _PASCAL[upper]
    for prefix, metres in _METRE_PREFIX.items():
        order = _MOTION.get(upper.removeprefix(prefix)) if upper.startswith(prefix) else None
        if order is not None:
            omega = 2j * np.pi * frequency
            with np.errstate(divide="ignore", invalid="ignore"):
                factor = np.where(omega == 0, 0 if order != 1 else 1, omega ** (order - 1))
            return factor / metres
    raise StationError(f"the response of {name} takes '{unit}', not a motion; correct its StationXML units")


def _stage(stage: Any, frequency: np.ndarray, name: str) -> np.ndarray | complex:
    gain = 1.0 if stage.stage_gain is None else float(stage.stage_gain)
    kind = type(stage).__name__
    if kind == "PolesZerosResponseStage":
        return gain * _poles_zeros(stage, frequency, name) * _moved_normalisation(stage, name)
    if kind == "FIRResponseStage":
        return gain * _fir(stage, frequency, name)
    if kind == "CoefficientsTypeResponseStage":
        return gain * _coefficients(stage, frequency, name)
    if kind in ("ResponseStage",):
        return complex(gain)
    raise StationError(
        f"the response of {name} has a {kind}, which is not linear; use a channel with poles and zeros"
    )


def _poles_zeros(stage: Any, frequency: np.ndarray, name: str) -> np.ndarray:
    form = str(stage.pz_transfer_function_type).upper()
    if "RADIANS" in form:
        variable = 2j * np.pi * frequency
    elif "HERTZ" in form:
        variable = 1j * frequency
    else:
        variable = np.exp(2j * np.pi * frequency / _input_rate(stage, name))
    top = np.prod([variable - complex(zero) for zero in stage.zeros] or [np.ones_like(variable)], axis=0)
    bottom = np.prod([variable - complex(pole) for pole in stage.poles] or [np.ones_like(variable)], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(bottom == 0, 0, top / bottom)
    return float(stage.normalization_factor or 1.0) * ratio


def _moved_normalisation(stage: Any, name: str) -> float:
    """Factor that makes the gain hold at its frequency where A0 was stated at another, as evalresp does."""
    at, gain_at = stage.normalization_frequency, stage.stage_gain_frequency
    if not gain_at or at is None or float(at) == float(gain_at):
        return 1.0
    there = abs(_poles_zeros(stage, np.array([float(gain_at)]), name)[0])
    return 1.0 / there if there > 0 else 1.0


def _fir(stage: Any, frequency: np.ndarray, name: str) -> np.ndarray:
    half = np.array([float(c) for c in stage.coefficients])
    symmetry = str(stage.symmetry).upper()
    mirrored = {"ODD": half[-2::-1], "EVEN": half[::-1]}.get(symmetry, half[:0])
    return _finite_impulse(np.concatenate([half, mirrored]), stage, frequency, name)


def _finite_impulse(coefficients: np.ndarray, stage: Any, frequency: np.ndarray, name: str) -> np.ndarray:
    """FIR normalised at 0 Hz: of zero phase where symmetric, else advanced by the applied correction."""
    if coefficients.size == 0:
        return np.ones(frequency.size, complex)
    rate = _input_rate(stage, name)
    symmetric = np.allclose(coefficients, coefficients[::-1], rtol=1e-4, atol=0)
    delay = (coefficients.size - 1) / 2 / rate if symmetric else float(stage.decimation_correction or 0)
    shape = _transform(coefficients / (coefficients.sum() or 1.0), frequency, rate)
    return shape * np.exp(2j * np.pi * frequency * delay)


def _coefficients(stage: Any, frequency: np.ndarray, name: str) -> np.ndarray:
    top = np.array([float(c) for c in stage.numerator])
    bottom = np.array([float(c) for c in stage.denominator])
    if top.size == 0 and bottom.size == 0:
        return np.ones(frequency.size, complex)
    if "DIGITAL" not in str(stage.cf_transfer_function_type).upper():
        raise StationError(
            f"the response of {name} has an analog coefficient stage; give it as poles and zeros"
        )
    if bottom.size == 0:
        return _finite_impulse(top, stage, frequency, name)
    rate = _input_rate(stage, name)
    ratio = _transform(top, frequency, rate) / _transform(bottom, frequency, rate)
    return ratio * np.exp(2j * np.pi * frequency * float(stage.decimation_correction or 0))


def _transform(coefficients: np.ndarray, frequency: np.ndarray, rate: float) -> np.ndarray:
    """Σ c_k exp(−iωk/rate)."""
    return np.polynomial.polynomial.polyval(np.exp(-2j * np.pi * frequency / rate), coefficients)


def _input_rate(stage: Any, name: str) -> float:
    if not stage.decimation_input_sample_rate:
        raise StationError(f"the response of {name} has a digital stage without an input sample rate")
    return float(stage.decimation_input_sample_rate)


def _evalresp(response: Any, frequency: np.ndarray, name: str) -> np.ndarray:
    try:
        return response.get_evalresp_response_for_frequencies(frequency, output="DEF")
    except Exception as error:  # evalresp's wrapper raises whatever its C code reports
        raise StationError(
            f"cannot evaluate the response of {name}: {' '.join(str(error).split())}"
        ) from None

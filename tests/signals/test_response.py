"""Responses: closed forms, obspy's evalresp as an oracle, units and signs."""

import warnings
from pathlib import Path

import numpy as np
import obspy
import pytest
from obspy.core.inventory import Response
from obspy.core.inventory.response import (
    FIRResponseStage,
    InstrumentSensitivity,
    PolesZerosResponseStage,
    PolynomialResponseStage,
    ResponseListElement,
    ResponseListResponseStage,
)

from obsnet.errors import StationError
from obsnet.signals.response import described, frequency_response

from .conftest import flat

FREQUENCY = np.arange(1, 513) / 20.48


def geophone(gain=200.0, corner=4.5, damping=0.7, units="M/S"):
    w = 2 * np.pi * corner
    poles = np.roots([1, 2 * damping * w, w**2])
    return PolesZerosResponseStage(
        1, gain, 20.0, units, "V", "LAPLACE (RADIANS/SECOND)", 20.0, [0, 0], poles,
        normalization_factor=1 / abs((2j * np.pi * 20) ** 2 / np.prod(2j * np.pi * 20 - poles)),
    )  # fmt: skip


def respond(*stages):
    return Response(response_stages=list(stages))


def test_a_geophone_is_its_second_order_equation():
    got = frequency_response(respond(geophone()), FREQUENCY, "motion")
    s, w = 2j * np.pi * FREQUENCY, 2 * np.pi * 4.5
    shape = s**2 / (s**2 + 2 * 0.7 * w * s + w**2)
    s20 = 2j * np.pi * 20.0
    at20 = abs(s20**2 / (s20**2 + 2 * 0.7 * w * s20 + w**2))
    np.testing.assert_allclose(got, 200.0 * shape / at20, rtol=1e-9)


@pytest.mark.parametrize("gain", [0.0, np.nan])
def test_a_gain_of_nothing_is_refused(gain):
    with pytest.raises(StationError, match=r"response of YV\.X\.\.BHZ is 0 at every frequency"):
        frequency_response(respond(geophone(gain)), FREQUENCY, "motion", "YV.X..BHZ")


@pytest.mark.parametrize(
    ("units", "kind", "factor"),
    [
        ("M/S", "motion", lambda f: 1.0),
        ("NM/S", "motion", lambda f: 1e9),
        ("M", "motion", lambda f: 1 / (2j * np.pi * f)),
        ("MM", "motion", lambda f: 1e3 / (2j * np.pi * f)),
        ("M/S**2", "motion", lambda f: 2j * np.pi * f),
        ("CM/S**2", "motion", lambda f: 200j * np.pi * f),
        ("PA", "pressure", lambda f: 1.0),
        ("Pascals", "pressure", lambda f: 1.0),
        ("KPA", "pressure", lambda f: 1e-3),
        ("uPa", "pressure", lambda f: 1e6),
    ],
)
def test_units_become_pascal_and_metre_a_second(units, kind, factor):
    got = frequency_response(flat(7.0, units), FREQUENCY, kind)
    np.testing.assert_allclose(got, 7.0 * factor(FREQUENCY) * np.ones(FREQUENCY.size), rtol=1e-12)


def test_signs_and_bare_sensitivities_are_kept():
    np.testing.assert_allclose(frequency_response(flat(-5.0, "PA"), FREQUENCY, "pressure"), -5.0)
    bare = Response(instrument_sensitivity=InstrumentSensitivity(-3.0, 1.0, "PA", "COUNTS"))
    np.testing.assert_allclose(frequency_response(bare, FREQUENCY, "pressure"), -3.0)
    assert not described(None)
    assert not described(Response())
    np.testing.assert_array_equal(frequency_response(None, FREQUENCY, "motion"), 1.0)


def test_a_symmetric_fir_has_no_phase_however_it_is_declared():
    taps = np.array([0.1, 0.25, 0.3, 0.25, 0.1])
    expected = 0.3 + 0.5 * np.cos(2 * np.pi * FREQUENCY / 100) + 0.2 * np.cos(4 * np.pi * FREQUENCY / 100)
    for symmetry, given in (("NONE", taps), ("ODD", taps[:3])):
        stage = FIRResponseStage(
            1, 1.0, 0.0, "PA", "COUNTS", symmetry, coefficients=list(given), decimation_factor=2,
            decimation_input_sample_rate=100.0, decimation_offset=0, decimation_delay=0.02,
            decimation_correction=0.02,
        )  # fmt: skip
        np.testing.assert_allclose(
            frequency_response(respond(stage), FREQUENCY, "pressure"), expected, rtol=1e-12, atol=1e-14
        )


def test_a_causal_fir_keeps_the_delay_that_was_not_corrected():
    stage = FIRResponseStage(
        1, 2.0, 0.0, "PA", "COUNTS", "NONE", coefficients=[0.0, 0.0, 1.0], decimation_input_sample_rate=100.0,
        decimation_factor=1, decimation_offset=0, decimation_delay=0.02, decimation_correction=0.005,
    )  # fmt: skip
    expected = 2.0 * np.exp(-2j * np.pi * FREQUENCY * 0.015)
    np.testing.assert_allclose(
        frequency_response(respond(stage), FREQUENCY, "pressure"), expected, rtol=1e-12
    )


def test_a_response_list_is_read_off():
    elements = [ResponseListElement(float(f), 3.0, 0.0) for f in (0.001, 1.0, 10.0, 30.0, 100.0)]
    stage = ResponseListResponseStage(1, 1.0, 1.0, "PA", "COUNTS", response_list_elements=elements)
    full = Response(
        instrument_sensitivity=InstrumentSensitivity(3.0, 1.0, "PA", "COUNTS"), response_stages=[stage]
    )
    np.testing.assert_allclose(np.abs(frequency_response(full, FREQUENCY, "pressure")), 3.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("response", "kind", "message"),
    [
        (flat(1.0, "V"), "motion", "takes 'V', not a motion"),
        (flat(1.0, "M/S"), "pressure", "takes 'M/S', not a pressure"),
        (
            respond(PolynomialResponseStage(1, 1.0, 1.0, "M/S", "V", 0, 1, 0, 1, 0, [0, 1])),
            "motion",
            "PolynomialResponseStage, which is not linear",
        ),
    ],
)
def test_what_is_no_linear_response_is_refused(response, kind, message):
    with pytest.raises(StationError, match=message):
        frequency_response(response, FREQUENCY, kind, "YV.RR03.00.BH1")


def real_responses():
    lcheapo = pytest.importorskip("lcheapo")
    for path in sorted((Path(lcheapo.__file__).parent / "data").glob("*.station.xml")):
        for network in obspy.read_inventory(str(path)):
            for station in network:
                yield from station


def test_real_ocean_bottom_instruments_agree_with_evalresp():
    compared = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for item in real_responses():
            kind = "pressure" if item.code[1] == "D" else "motion"
            got = frequency_response(item.response, FREQUENCY, kind, item.code)
            oracle = item.response.get_evalresp_response_for_frequencies(
                FREQUENCY, output="DEF" if kind == "pressure" else "VEL"
            )
            np.testing.assert_allclose(got, oracle, rtol=0, atol=1e-6 * np.abs(oracle).max())
            compared += 1
    assert compared > 40

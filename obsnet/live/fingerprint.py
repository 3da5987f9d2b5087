"""Station, configuration and what belongs to them in; out, one digest of all that a station's memory depends on."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy as np
import xarray as xr

import obsnet
from obsnet.config import to_dict
from obsnet.errors import StationError
from obsnet.live.config import WatchConfig
from obsnet.ocean.amplitudes import Amplitudes
from obsnet.signals.response import frequency_response
from obsnet.signals.station import Channel, Station


def fingerprint(
    station: Station,
    config: WatchConfig,
    models: dict[str, str],
    table: xr.Dataset,
    amplitudes: Amplitudes | None,
) -> str:
    """SHA-256 that changes with the version and whatever a calibration, a model or a propagation table may change.

    Parameters
    ----------
    models : digest of each learned model. table : propagation table in use. amplitudes : as for `Pipeline`.
    """
    frequency = config.spectra.frequency
    said = [
        obsnet.__version__,
        (station.code, station.latitude, station.longitude, station.depth_m),
        [_channel(channel, frequency) for channel in station.epochs],
        {key: value for key, value in to_dict(config).items() if key != "live"},
        models,
        {str(name): _digest(values.values) for name, values in table.variables.items()},
        None if amplitudes is None else amplitudes.to_dict(),
    ]
    return hashlib.sha256(json.dumps(said, sort_keys=True, default=str).encode()).hexdigest()


def _channel(channel: Channel, frequency: np.ndarray) -> dict[str, Any]:
    """An epoch in plain values, its response as the spectra undo it."""
    try:
        response = _digest(frequency_response(channel.response, frequency, channel.kind, channel.seed_id))
    except StationError as error:  # a channel that cannot serve may stand beside those that do
        response = str(error)
    plain = {name: value for name, value in vars(channel).items() if name != "response"}
    return plain | {"response": response}


def _digest(values: np.ndarray) -> str:
    return hashlib.sha256(str(values.dtype).encode() + np.ascontiguousarray(values).tobytes()).hexdigest()

"""The stages of package `obsea` as its authors' scripts run them, on any record: the baseline of the benchmarks.

Run as a script it prints seconds per stage as JSON, and writes detections and tracks in obsnet's CSV columns, so that
`obsnet evaluate` can score both. The propagation table is exact (the one that made the simulated record), the polarity and
orientation are given. Its segmentation is called with what its scripts call `delimit`; segments without a CPA, on which its
tracker cannot run, are given the middle of the segment.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np


def run(folder: Path, out: Path, tracking: bool = True) -> dict[str, float]:
    """Azimuth, clutter filter, range and track on `folder`/waveforms.mseed; seconds per stage."""
    import obsea
    import pandas as pd
    import xarray as xr
    from obsea import tracking as obsea_tracking
    from obspy import read, read_inventory

    from obsnet import Station
    from obsnet.detectors.analytic import RangeDetectorConfig, cepstral_model
    from obsnet.ocean.amplitudes import Amplitudes
    from obsnet.ocean.rays import propagation, tdoa
    from obsnet.ocean.sound_speed import OceanConfig
    from obsnet.signals.cepstrogram import noise_std

    seconds: dict[str, float] = {}
    clock = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[name] = seconds.get(name, 0.0) + now - clock
        clock = now

    station = Station.from_stationxml(folder / "station.xml")
    inventory = read_inventory(str(folder / "station.xml"))
    ocean = OceanConfig()
    table = propagation(ocean.sound_speed(), station.depth_m, ocean.bottom, ocean.ranges())
    # It reads r + v·δt without looking at the grid's end: its model must reach further than its grid, as its scripts' does.
    config = RangeDetectorConfig(max_range_m=60_000.0, pairs=("1-3", "3-5", "5-7"))
    quefrency = np.arange(513) * 0.02
    pulses = cepstral_model(quefrency, table, Amplitudes.table_ii().scaled_to(station.depth_m), config)
    delays = np.stack([tdoa(table, pair).interp(range=config.range_m).values for pair in config.pairs])
    model = obsea.build_model(
        xr.DataArray(pulses),
        xr.DataArray(noise_std(quefrency, 1024)),
        xr.DataArray(delays),
        config.pulse_width_s,
        50.0,
    )
    days = _days(folder)
    pressure, phasors = [], []
    lap("model")
    for start, end in days:
        stream = read(str(folder / "waveforms.mseed"), starttime=start, endtime=end)
        for trace in stream:
            trace.data = trace.data.astype(np.float64)
            trace.stats.channel = {"H": "BDH", "1": "BH1", "2": "BH2", "Z": "BHZ"}[_part(trace.stats.channel)]
        for channel in (c for c in inventory[0][0] if not c.code.startswith("B")):
            channel.code = {"H": "BDH", "1": "BH1", "2": "BH2", "Z": "BHZ"}[_part(channel.code)]
        stream.merge(1, fill_value=0)
        lap("read")
        spectra = obsea.time_frequency(stream, 1024, 512, water_level=40.0, inventory=inventory)
        posix = (spectra["time"].values - np.datetime64(0, "s")) / np.timedelta64(1, "s")
        spectra = spectra.assign_coords(time=posix)
        # Response removed, pressure is positive for compression: turn it so that the intensity points to the ship.
        spectra["p"] = -spectra["p"]
        phasors.append(obsea.intensity(spectra).sel(frequency=slice(11.0, 24.0)))
        lap("azimuth")
        cepstra = obsea.cepstrogram(spectra["p"])
        pressure.append(obsea.batch_svd_filter(cepstra, 3 * 3600, remove_mean=False))
        lap("clutter")
    u = xr.concat(phasors, "time")
    ceps = xr.concat(pressure, "time")
    first = np.ceil(float(u["time"][0]) / 60) * 60 + 120
    minutes = np.arange(first, float(u["time"][-1]) - 120, 60.0)
    ell_a = obsea.tonal_detection(u, 361, station.orientation_deg, 0.99, 180.0, endpoint=True, t=minutes)
    lap("azimuth")
    grid = {"dt": 180.0, "dr": 70.0, "rmax": 50_000.0, "dv": 0.5, "vmax": 13.0}
    ell_r = obsea.cepstral_detection(ceps, model, grid, 2, t=minutes)
    lap("range")
    out.mkdir(parents=True, exist_ok=True)
    _write_detections(out / "detections.csv", minutes, ell_a, ell_r, pd)
    tracks = []
    if tracking:
        ell_a, ell_r = (
            ell.assign_coords(time=np.rint(1e9 * ell["time"].values).astype("datetime64[ns]"))
            for ell in (ell_a, ell_r)
        )
        tracks = _track(obsea_tracking, ell_a, ell_r, xr)
        lap("track")
    pd.DataFrame(tracks, columns=_COLUMNS).to_csv(out / "tracks.csv", index=False)
    (out / "seconds.json").write_text(json.dumps(seconds))
    return seconds


_COLUMNS = [
    "track", "start", "end", "cpa_time", "cpa_distance_m", "cpa_azimuth_deg", "course_deg", "speed_mps", "cpa_time_std_s",
    "cpa_distance_std_m", "course_std_deg", "speed_std_mps", "log_bayes_factor",
]  # fmt: skip


def _part(code: str) -> str:
    return "H" if code[1] == "D" or code[2] == "H" else {"N": "1", "E": "2", "3": "Z"}.get(code[2], code[2])


def _days(folder: Path) -> list[tuple]:
    from obspy import read

    header = read(str(folder / "waveforms.mseed"), headonly=True)
    start, end = min(t.stats.starttime for t in header), max(t.stats.endtime for t in header)
    edges = [start]
    while end - edges[-1] > 86400:
        edges.append(edges[-1] + 86400)
    return list(zip(edges, [*edges[1:], end], strict=True))


def _write_detections(path: Path, minutes, ell_a, ell_r, pd) -> None:
    seen_a = np.log(ell_a.mean("azimuth").values)
    seen_r = np.log(ell_r.mean(["distance", "speed"]).values)
    azimuth = ell_a["azimuth"].values[ell_a.argmax("azimuth").values] % 360
    best = ell_r.argmax(["distance", "speed"])
    distance, rate = (
        ell_r["distance"].values[best["distance"].values],
        ell_r["speed"].values[best["speed"].values],
    )
    table = {
        "time": pd.to_datetime(minutes, unit="s").strftime("%Y-%m-%dT%H:%M:%SZ"),
        "coverage": 1.0,
        "azimuth_deg": np.where(seen_a > 0, azimuth, np.nan),
        "azimuth_llr": seen_a,
        "range_m": np.where(seen_r > 0, distance, np.nan),
        "range_rate_mps": np.where(seen_r > 0, rate, np.nan),
        "range_llr": seen_r,
    }
    pd.DataFrame(table).to_csv(path, index=False)


def _track(obsea, ell_a, ell_r, xr) -> list[list]:
    data = {
        "a": ell_a, "r": ell_r.mean("speed"),
        "rm": ell_r.sel(speed=slice(None, 0)).mean("speed"), "rp": ell_r.sel(speed=slice(0, None)).mean("speed"),
    }  # fmt: skip
    probability, width = {"r": 0.6, "a": 0.9}, {"r": 60, "a": 120}
    ell = {k: obsea.detection_probability(obsea.marginal(v), probability[k[0]]) for k, v in data.items()}
    ell["all"] = ell["r"] * ell["a"]
    p = {k: obsea.ell2proba(obsea.segment(v, width[k[0]])) for k, v in ell.items()}
    heard = p["all"] > 0.5
    closing, opening = (
        heard & (p["r"] > 0.5) & (p["rm"] > p["rp"]),
        heard & (p["r"] > 0.5) & (p["rm"] < p["rp"]),
    )
    try:
        segments = obsea.delimit({"vm": closing, "vp": opening, "all": heard})
    except IndexError as error:
        print(f"obsea.delimit failed: {error}", file=sys.stderr)
        segments = []
    rows = []
    for start, cpa, end in segments:
        cpa = start + (end - start) / 2 if cpa is None else cpa
        found = _search(obsea, ell_a, ell_r, start, cpa, end, xr)
        if found is None:
            continue
        t, r, a, v = found
        course = float(np.rad2deg(a) % 360)
        stamp = [str(np.datetime_as_string(x.astype("datetime64[s]"))) + "Z" for x in (start, end)]
        when = str(np.datetime_as_string(np.datetime64(int(t), "s"))) + "Z"
        rows.append(
            [
                len(rows) + 1,
                *stamp,
                when,
                abs(r),
                (course + (-90 if r >= 0 else 90)) % 360,
                course,
                v,
                *[np.nan] * 5,
            ]
        )
    return rows


def _search(obsea, ell_a, ell_r, start, cpa, end, xr):
    posix = [float((x - np.datetime64(0, "s")) / np.timedelta64(1, "s")) for x in (start, cpa, end)]
    part = xr.Dataset({"a": ell_a.sel(time=slice(start, end)), "r": ell_r.sel(time=slice(start, end))})
    part = part.assign_coords(time=(part["time"].values - np.datetime64(0, "s")) / np.timedelta64(1, "s"))
    part = obsea.detection_probability(part, xr.Dataset({"a": 0.9, "r": 0.6}))
    loglik = np.log(obsea.smooth(part, 14, 10, 1))
    search = obsea.make_brute_force(loglik)
    ten, one = np.deg2rad(10), np.deg2rad(1)
    t, r, a, v = posix[1], 0.0, 0.0, 9.5
    levels = [
        (
            np.arange(-1800, 1801, 180),
            np.arange(-50_000, 51_000, 1000),
            np.arange(0, 2 * np.pi, ten),
            np.arange(-3.5, 3.6, 0.5),
        ),
        (
            np.arange(-180, 181, 10),
            np.arange(-1000, 1001, 100),
            np.arange(-ten, ten + one, one),
            np.arange(-0.5, 0.51, 0.1),
        ),
        (
            np.arange(-10, 11, 1),
            np.arange(-100, 101, 10),
            np.arange(-one, 1.1 * one, one / 10),
            np.arange(-0.1, 0.11, 0.01),
        ),
    ]
    for dt, dr, da, dv in levels:
        index, _ = search(t + dt, r + dr.astype(float), (a + da) % (2 * np.pi), v + dv)
        if index[0] < 0:
            return None
        t, r, a, v = t + dt[index[0]], r + dr[index[1]], a + da[index[2]], v + dv[index[3]]
    return t, float(r), float(a), float(v)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of `obsnet simulate`")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--no-tracking", action="store_true")
    arguments = parser.parse_args()
    print(json.dumps(run(arguments.folder, arguments.out, not arguments.no_tracking)))

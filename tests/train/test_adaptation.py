"""Adaptation on the second generator: one station through all days, ships of their own each day, and an archive that can be prepared."""

import adaptation
import numpy as np
import pandas as pd

from obsnet.learn.prepare import archive_record


def test_the_station_stays_and_everything_else_changes():
    made = list(adaptation.days(3, 0, 12, quiet_every=4))
    assert len({(record.recorder, record.sea) for record in made}) == 1
    assert [record.kind == "no_ship" for record in made] == [day % 4 == 0 for day in range(12)]
    assert np.all(np.diff([record.start for record in made]) == 86400.0)
    every_other = {record.kind for record in adaptation.days(3, 0, 12, quiet_every=2)}
    assert every_other == {"no_ship", *adaptation.WITH_SHIPS}
    ships = [vessel for record in made for vessel in record.vessels]
    assert len({ship.mmsi for ship in ships}) == len(ships)
    for record in made:
        for ship in record.vessels:
            assert record.start < ship.course.cpa_s < record.start + 3600.0 * record.hours


def test_an_archive_is_prepared_day_by_day(tmp_path, monkeypatch):
    monkeypatch.setattr(adaptation, "HOURS", 0.6)
    span = adaptation.archive(tmp_path, adaptation.days(3, 6, 1))
    assert len(pd.read_csv(next((tmp_path / "ais").glob("*.csv"))))
    data = adaptation.of_archive(tmp_path, span, absence_known=True)
    record = archive_record("day", "test", (span[0], span[0] + 0.6 * 3600.0), data)
    assert record.absence_known and len(record.cell_index) and record.cepstra.size
    assert np.isfinite(record.azimuth_deg).any()

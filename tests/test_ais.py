import bz2
import gzip
import importlib.util
import io
import lzma
import zipfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from pyproj import Geod

from obsnet import ais
from obsnet.ais.quality import drop_jumps
from obsnet.errors import AISError, ConfigError, OutputError
from obsnet.kinematics import StraightCourse, wrap180
from obsnet.layout import to_posix

STATION = (-21.3732, 54.1294)
KNOT = 1852 / 3600
START = pd.Timestamp("2013-05-21T10:00:00")
T0 = START.timestamp()

PLAIN = """mmsi,time,lon,lat,sog,cog
209187000,2013-05-21T10:00:00Z,54.10,-21.40,13.4,247.3
209187000,2013-05-21T10:10:00Z,54.06,-21.42,13.3,360.0
"""


def write(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


@pytest.fixture
def plain(tmp_path):
    return write(tmp_path / "anything.dat", PLAIN)


def frame(time, lon, lat, mmsi=209187000, **more):
    stamps = pd.to_datetime(np.rint(np.asarray(time, float) * 1e9).astype("int64"))
    return pd.DataFrame({"mmsi": mmsi, "time": stamps, "lon": lon, "lat": lat, **more})


def straight_ship(course: StraightCourse, times, mmsi=209187000, **more):
    """AIS positions of a ship on a straight course in the station's azimuthal plane, by geodesics."""
    east, north = course.position(np.asarray(times, float))
    count = np.ones(len(east))
    azimuth, distance = np.rad2deg(np.arctan2(east, north)), np.hypot(east, north)
    lon, lat, _ = Geod(ellps="WGS84").fwd(STATION[1] * count, STATION[0] * count, azimuth, distance)
    return frame(times, lon, lat, mmsi, **more)


class TestDialects:
    def check(self, table, sog_knots=13.4):
        first = table.iloc[0]
        assert first["mmsi"] == 209187000 and table["mmsi"].dtype == "int64"
        assert first["time"] == START and table["time"].dtype == "datetime64[ns]"
        assert (first["lon"], first["lat"]) == pytest.approx((54.10, -21.40), abs=1e-6)
        assert first["sog_mps"] == pytest.approx(sog_knots * KNOT)
        assert first["cog_deg"] == pytest.approx(247.3, abs=0.31)

    def test_plain_and_its_missing_course(self, plain):
        table = ais.read(plain)
        self.check(table)
        assert np.isnan(table["cog_deg"][1])
        assert table.attrs["report"].dialects == ("plain",)

    def test_plain_without_speed(self, tmp_path):
        table = ais.read(write(tmp_path / "a", "mmsi,time,lon,lat\n1,2013-05-21T10:00:00.500Z,54,-21\n"))
        assert table["mmsi"][0] == 1 and np.isnan(table["sog_mps"][0])
        assert table["time"][0] == START + pd.Timedelta("0.5s")

    def test_marine_cadastre_to_2023(self, tmp_path):
        text = (
            "MMSI,BaseDateTime,LAT,LON,SOG,COG,Heading,VesselName,IMO,CallSign,VesselType,Status,"
            "Length,Width,Draft,Cargo,TransceiverClass\n"
            '209187000,2013-05-21T10:00:00,-21.40000,54.1,13.4,247.3,511.0,"LADY, SEA",,,70,0,288,45,,,A\n'
            "209187000,2013-05-21T10:10:00,-21.42000,54.06000,102.3,360.0,245.0,LADY,,X,70,0,,,,,A\n"
        )
        table = ais.read(write(tmp_path / "AIS_2013.csv", text))
        self.check(table)
        assert np.isnan(table["heading_deg"][0]) and table["heading_deg"][1] == 245
        assert np.isnan(table["sog_mps"][1]) and np.isnan(table["cog_deg"][1])
        assert (
            table["name"][0] == "LADY, SEA" and table["ship_type"][0] == "70" and table["length_m"][0] == 288
        )

    @pytest.mark.parametrize("compressed", [True, False])
    def test_marine_cadastre_from_2024(self, tmp_path, compressed):
        text = (
            "mmsi,base_date_time,longitude,latitude,sog,cog,heading,vessel_name,imo,call_sign,"
            "vessel_type,status,length,width,draft,cargo,transceiver\n"
            "209187000,2013-05-21 10:00:00,54.10,-21.40,13.4,247.3,511,MANGAS,,,70,0,288,45,,,A\n"
        )
        if compressed:
            text = pytest.importorskip("zstandard").ZstdCompressor().compress(text.encode())
        table = ais.read(write(tmp_path / "x.csv", text))
        self.check(table)
        assert table.attrs["report"].dialects == ("MarineCadastre 2024+",)
        assert table["width_m"][0] == 45

    def test_danish(self, tmp_path):
        head = (
            "# Timestamp,Type of mobile,MMSI,Latitude,Longitude,Navigational status,ROT,SOG,COG,Heading,IMO,"
            "Callsign,Name,Ship type,Cargo type,Width,Length,Type of position fixing device,Draught,"
            "Destination,ETA,Data source type,A,B,C,D\n"
        )
        rest = "Under way using engine,0.0,13.4,247.3,,1,X,MANGAS,Cargo,,45,288,GPS,11,Y,,AIS,250,38,20,25\n"
        text = (
            head
            + f"21/05/2013 10:00:00,Class A,209187000,-21.40,54.10,{rest}"
            + f"21/05/2013 10:00:05,Base Station,002190045,57.0,10.0,{rest}"
            + f"21/05/2013 10:00:06,AtoN,209187009,57.0,10.0,{rest}"
            + f"21/05/2013 10:01:00,Class A,209187000,91.0,0.0,{rest}"
            + f"21/13/2013 10:02:00,Class A,209187000,-21.40,54.10,{rest}"
        )
        table = ais.read(write(tmp_path / "aisdk", text))
        self.check(table)
        assert table.attrs["report"].dropped == {"not a ship": 2, "no readable time": 1, "no position": 1}
        assert table["ship_type"][0] == "Cargo" and table["to_stern_m"][0] == 38

    def test_marine_traffic_speed_is_in_tenths_of_knots(self, tmp_path):
        text = (
            "MMSI,STATUS,SPEED,COURSE,HEADING,LAT,LON,TIMESTAMP UTC,STATION\n"
            "209187000,0,134,247,511,-21.40,54.10,2013-05-21 10:00,TER\n"
        )
        self.check(ais.read(write(tmp_path / "mt", text)))

    def test_cls_semicolons_days_first(self, tmp_path):
        text = (
            "mmsi;source;locDate;locTime;lon;lat;sog;cog;trueHeading;shipName;aisShipType;shipLength;shipWidth\n"
            "209187000;ASS;21/05/2013;10:00:00;54.10;-21.40;13.4;247.3;-1;MANGAS;70;288;0\n"
        )
        table = ais.read(write(tmp_path / "cls", text))
        self.check(table)
        assert np.isnan(table["heading_deg"][0]) and table["length_m"][0] == 288 and "width_m" not in table

    @pytest.mark.parametrize("stamp", ["tag", "tag in ms", "iso", "epoch", "after"])
    def test_nmea_receive_times(self, tmp_path, stamp):
        pyais = pytest.importorskip("pyais")
        report = {
            "type": 1,
            "mmsi": 209187000,
            "lat": -21.40,
            "lon": 54.10,
            "speed": 13.4,
            "course": 247.3,
            "heading": 511,
        }
        static = {
            "type": 5, "mmsi": 209187000, "shipname": "MANGAS", "ship_type": 70,
            "to_bow": 250, "to_stern": 38, "to_port": 20, "to_starboard": 25,
        }  # fmt: skip
        base = {"type": 4, "mmsi": 2190045, "lat": -21.0, "lon": 54.0}
        lines = []
        for message in (static, report, base):
            for sentence in pyais.encode_dict(message, talker_id="AI", sentence_type="VDM", seq_id=3):
                lines.append(
                    {
                        "tag": f"\\s:station,c:{T0:.0f}*5F\\{sentence}",
                        "tag in ms": f"\\c:{T0 * 1e3:.0f}*00\\{sentence}",
                        "iso": f"2013-05-21 10:00:00,{sentence}",
                        "epoch": f"{T0:.1f} {sentence}",
                        "after": f"{sentence},r003669945,{T0:.0f}",
                    }[stamp]
                )
        lines[1:1] = ["$GPGGA,what*00", lines[-1].split("*")[0]]
        table = ais.read(write(tmp_path / "log", "\r\n".join(lines)))
        self.check(table)
        assert len(table) == 1 and np.isnan(table["heading_deg"][0])
        assert (table["name"][0], table["ship_type"][0], table["length_m"][0]) == ("MANGAS", "70", 288)
        assert table["to_stern_m"][0] == 38
        assert table.attrs["report"].dropped["not a ship"] == 1

    def test_nmea_damaged_sentence_is_counted(self, tmp_path):
        pyais = pytest.importorskip("pyais")
        good = pyais.encode_dict(
            {"type": 1, "mmsi": 209187000, "lat": -21.4, "lon": 54.1}, talker_id="AI", sentence_type="VDM"
        )[0]
        bad = good.replace(good[20], "w" if good[20] != "w" else "0", 1)
        table = ais.read(write(tmp_path / "log", f"{T0} {good}\n{T0} {bad}\n"))
        assert table.attrs["report"].dropped == {"undecodable sentence": 1}

    def test_nmea_without_times_says_so(self, tmp_path):
        pyais = pytest.importorskip("pyais")
        sentence = pyais.encode_dict(
            {"type": 1, "mmsi": 209187000, "lat": -21.4, "lon": 54.1}, talker_id="AI", sentence_type="VDM"
        )[0]
        with pytest.raises(AISError, match=r"no usable ship position.*NMEA.*1 no readable time"):
            ais.read(write(tmp_path / "log", sentence))

    @pytest.mark.parametrize("module", ["pyais", "zstandard"])
    def test_missing_extra_is_named(self, tmp_path, monkeypatch, module):
        content = (
            b"!AIVDM,1,1,,A,15MgK45P3@G?fl0E`JbR0OwT0@MS,0*4E"
            if module == "pyais"
            else b"\x28\xb5\x2f\xfd1234"
        )
        monkeypatch.setitem(__import__("sys").modules, module, None)
        with pytest.raises(AISError, match=r"pip install obsnet\[ais\]"):
            ais.read(write(tmp_path / "x", content))


class TestFiles:
    @pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])
    def test_compression_is_seen_not_believed(self, tmp_path, pack, plain):
        packed = write(tmp_path / "named.csv", pack(PLAIN.encode()))
        pd.testing.assert_frame_equal(ais.read(packed), ais.read(plain))

    def test_zip_holds_several_days(self, tmp_path):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr("day1.csv", PLAIN)
            archive.writestr("day2.csv", PLAIN.replace("05-21", "05-22"))
        assert len(ais.read(write(tmp_path / "days", buffer.getvalue()))) == 4

    def test_several_files_of_several_dialects(self, tmp_path, plain):
        other = "MMSI,BaseDateTime,LAT,LON\n209187000,2013-05-20T10:00:00,-21.40,54.10\n"
        table = ais.read([plain, write(tmp_path / "b", other)])
        assert list(table["time"].dt.day) == [20, 21, 21]
        assert table.attrs["report"].dialects == ("plain", "MarineCadastre")

    def test_near_keeps_what_is_near(self, tmp_path, plain):
        far = write(tmp_path / "far", PLAIN.replace("-21.40", "51.40"))
        report = ais.read(far, near=STATION, within_m=50e3).attrs["report"]
        assert (report.kept, report.dropped) == (1, {"too far away": 1})

    def test_bad_rows_are_counted_not_fatal(self, tmp_path):
        rows = PLAIN + (
            "209187000,2013-05-21T10:05:00Z,181,91,0,0\n"
            "209187000,2013-05-21T10:06:00Z,here,there,0,0\n"
            "209187000,2013-05-21T10:07:00Z,0,0,0,0\n"
            "209187000,yesterday,54.1,-21.4,0,0\n"
            "209187000,1970-01-01T00:00:00Z,54.1,-21.4,0,0\n"
            "ship,2013-05-21T10:08:00Z,54.1,-21.4,0,0\n"
            "209187000,2013-05-21T10:10:00Z,54.06,-21.42,13.3,0\n"
            "209187000,2013-05-21T10:11:00Z\n"
            "209187000,2013-05-21T10:20:00Z,54.02,-21.44,13.3,0,more,and,more\n"
            "\n"
            "\x00\x00garbage\xff\n"
        )
        report = ais.read(write(tmp_path / "x", rows.encode("latin-1"))).attrs["report"]
        assert report.kept == 3
        assert report.dropped == {"no MMSI": 2, "no readable time": 2, "no position": 4, "repeated": 1}
        assert report.rows == report.kept + sum(report.dropped.values())

    def test_unclosed_quotation_mark_swallows_nothing(self, tmp_path):
        rows = "mmsi,time,lon,lat,name\n" + "".join(
            f"{i},2013-05-21T10:00:00Z,54.1,-21.4,SKY{i}\n" for i in range(1, 20)
        )
        rows = rows.replace("SKY5", '"SEA')
        assert len(ais.read(write(tmp_path / "x", rows))) == 19

    def test_byte_order_marks(self, tmp_path, plain):
        for encoding in ("utf-8-sig", "utf-16"):
            marked = write(tmp_path / encoding, PLAIN.encode(encoding))
            pd.testing.assert_frame_equal(ais.read(marked), ais.read(plain))

    def test_impossible_jump_drops_the_wrong_end_only(self):
        minutes = np.arange(60)
        table = frame(T0 + 60 * minutes, 54 + 0.003 * minutes, np.full(60, -21.0))
        for i in (0, 20, 21, 40):
            table.loc[i, "lat"] = 10.0
        assert np.flatnonzero(~drop_jumps(table)).tolist() == [0, 20, 21, 40]

    def test_two_ships_under_one_mmsi_leave_the_longer(self):
        table = pd.concat(
            [
                frame(T0 + 60.0 * np.arange(50), 54 + 0.003 * np.arange(50), -21.0),
                frame(T0 + 7.0 + 120.0 * np.arange(20), 10 + 0.003 * np.arange(20), 56.0),
            ]
        ).sort_values("time", ignore_index=True)
        assert (table["lat"][drop_jumps(table)] == -21.0).all() and drop_jumps(table).sum() == 50

    def test_jumps_leave_satellite_gaps_alone(self):
        table = frame(T0 + np.array([0, 7, 12, 5 * 3600]), 54 + np.array([0, 5e-4, 9e-4, 1.2]), -21.0)
        assert drop_jumps(table).all()

    def test_plain_round_trip(self, tmp_path):
        table = straight_ship(
            StraightCourse(T0, 5e3, 60.0, 7.0), T0 + 60.0 * np.arange(9), name="A, B", length_m=190.0
        )
        table["sog_mps"], table["cog_deg"] = 7.0, 60.0
        ais.write_plain(table, tmp_path / "out.csv")
        assert (tmp_path / "out.csv").read_text().startswith("mmsi,time,lon,lat,sog,cog,length_m,name\n")
        back = ais.read(tmp_path / "out.csv")
        for column in table:
            if column in ("name", "time"):
                assert (back[column] == table[column]).all()
            else:
                np.testing.assert_allclose(back[column], table[column], rtol=3e-4, atol=1e-7)
        assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]
        with pytest.raises(OutputError, match="cannot write"):
            ais.write_plain(table, tmp_path / "no" / "out.csv")

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"", "is empty"),
            (b"\n\n# note\n", "is empty"),
            (b"time,sog\n2013,4\n", "no known AIS dialect: found columns time, sog; a plain file has mmsi"),
            (bytes(range(256)) * 40, "no known AIS dialect"),
            (b"mmsi,time,lon,lat\n", "no usable ship position in .*header and no rows"),
            (b"mmsi,time,lon,lat\n1,2013-05-21T10:00:00Z,,\n", "no usable ship position.*1 no position"),
            (b"\x1f\x8b\x08\x00broken", "is damaged"),
            (b"PK\x03\x04broken", "is damaged"),
            (gzip.compress(PLAIN.encode() * 900)[:-40], "is damaged"),
        ],
    )  # fmt: skip
    def test_failures_are_one_line(self, tmp_path, content, message):
        with pytest.raises(AISError, match=message) as caught:
            ais.read(write(tmp_path / "ais.csv", content))
        assert "\n" not in str(caught.value)

    def test_zstandard_frames_damage_and_truncation(self, tmp_path):
        pack = pytest.importorskip("zstandard").ZstdCompressor().compress
        rng = np.random.default_rng(0)
        head, *rows = [f"{i},2013-05-21T10:00:00Z,{54 + rng.random():.6f},-21" for i in range(20_000)]
        text = "\n".join(["mmsi,time,lon,lat", head, *rows]).encode()
        packed = pack(text[:200_000]) + pack(text[200_000:])
        assert len(ais.read(write(tmp_path / "two frames", packed))) == 20_000
        for broken in (packed[:-1000], packed[:5000], packed + b"garbage after the end"):
            with pytest.raises(AISError, match="is damaged"):
                ais.read(write(tmp_path / "broken", broken))

    def test_missing_file_and_folder(self, tmp_path):
        with pytest.raises(AISError, match=r"none\.csv: No such file"):
            ais.read(tmp_path / "none.csv")
        with pytest.raises(AISError, match="cannot read"):
            ais.read(tmp_path)
        with pytest.raises(AISError, match="no AIS file"):
            ais.read([])


class TestTracks:
    course = StraightCourse(T0, -8e3, 60.0, 7.0)

    def track(self, step=600.0, hours=6.0, **options):
        times = T0 + np.arange(-hours * 3600, hours * 3600 + 1, step)
        (track,) = ais.reference_tracks(straight_ship(self.course, times), STATION, **options)
        return track

    def test_geodesics_are_the_truth(self):
        table = frame(T0 + np.arange(5) * 1800.0, np.linspace(53.6, 54.6, 5), np.linspace(-21.7, -21.1, 5))
        (track,) = ais.reference_tracks(table, STATION, max_range_m=90e3)
        azimuth, distance, _ = track.observables(track.time)
        count = np.ones(5)
        expected, _, length = Geod(ellps="WGS84").inv(
            STATION[1] * count, STATION[0] * count, table["lon"], table["lat"]
        )
        np.testing.assert_allclose(distance, length, atol=0.01)
        np.testing.assert_allclose(wrap180(azimuth - expected), 0, atol=1e-6)

    def test_straight_course_comes_back(self):
        track = self.track()
        line, cpa = track.line(), track.cpa()
        assert line.cpa_time == pytest.approx(T0, abs=0.1)
        assert line.cpa_range_m == pytest.approx(-8e3, abs=0.5)
        assert line.course_deg == pytest.approx(60.0, abs=1e-3) and line.speed_mps == pytest.approx(
            7.0, abs=1e-4
        )
        assert (cpa.range_m, cpa.azimuth_deg) == pytest.approx((8e3, 330.0), abs=0.1)
        times = T0 + np.array([-9000.0, -17.0, 0.0, 5000.0])
        for found, true in zip(track.observables(times), self.course.observables(times), strict=True):
            np.testing.assert_allclose(found, true, rtol=1e-4, atol=1e-3)

    def test_entry_and_exit_of_the_disc(self):
        track = self.track(max_range_m=50e3)
        half = np.sqrt(50e3**2 - 8e3**2) / 7.0
        assert (track.starttime - T0, track.endtime - T0) == pytest.approx((-half, half), abs=0.1)
        assert track.time[0] <= track.starttime < track.time[1]
        assert track.time[-2] < track.endtime <= track.time[-1]

    def test_a_disc_crossed_between_two_reports(self):
        (track,) = ais.reference_tracks(straight_ship(self.course, T0 + np.array([-4e4, 4e4])), STATION)
        assert len(track.time) == 2 and track.cpa().range_m == pytest.approx(8e3, abs=1)
        assert track.line().speed_mps == pytest.approx(7.0, abs=1e-3)

    def test_split_at_gaps_and_re_entries(self):
        out_and_back = np.r_[np.arange(-5e4, 5e4, 1000), np.arange(1.2e5, 2.2e5, 1000)]
        table = straight_ship(self.course, T0 + out_and_back)
        table.loc[table.index >= 100, ["lon", "lat"]] = table.loc[
            table.index < 100, ["lon", "lat"]
        ].to_numpy()[::-1]
        assert len(ais.reference_tracks(table, STATION)) == 2
        gap = table.drop(index=range(40, 60))
        assert len(ais.reference_tracks(gap, STATION, max_gap_s=3600, max_cpa_m=None)) == 3
        assert len(ais.reference_tracks(gap, STATION, max_gap_s=1e5, max_cpa_m=None)) == 2

    def test_cpa_limit_order_and_time_window(self):
        table = pd.concat(
            [
                straight_ship(
                    StraightCourse(T0 + 7200, 3e3, 10.0, 6.0), T0 + np.arange(-9e3, 2e4, 600), mmsi=1
                ),
                straight_ship(StraightCourse(T0, 30e3, 10.0, 6.0), T0 + np.arange(-9e3, 2e4, 600), mmsi=2),
                straight_ship(
                    StraightCourse(T0 - 600, 20e3, 10.0, 6.0), T0 + np.arange(-9e3, 2e4, 600), mmsi=3
                ),
            ]
        )
        assert [track.mmsi for track in ais.reference_tracks(table, STATION)] == [3, 1]
        assert [track.mmsi for track in ais.reference_tracks(table, STATION, max_cpa_m=None)] == [3, 2, 1]
        assert [track.mmsi for track in ais.reference_tracks(table, STATION, starttime=T0)] == [1]

    def test_interpolated_flag_and_the_ends(self):
        track = self.track(step=2 * 3600.0, max_interpolation_s=1800.0)
        east, _, interpolated = track.at(T0 + np.array([0.0, 1799.0, 1801.0, 5399.0, 5401.0, 7200.0, 1e6]))
        assert interpolated.tolist() == [False, False, True, True, False, False, True]
        assert np.isnan(east).tolist() == [False] * 6 + [True]

    def test_heard_solves_the_travel_time(self):
        track = self.track(step=60.0)
        delay = lambda distance: np.hypot(distance, 4340.0) / 1500.0  # noqa: E731
        emitted = T0 + np.linspace(-9000, 9000, 41)
        azimuth, distance, _ = self.course.observables(emitted)
        received = emitted + delay(distance)
        before, after = (self.course.observables(emitted + step)[1] for step in (-1.0, 1.0))
        heard_rate = (after - before) / (2.0 + delay(after) - delay(before))
        found = track.heard(received, delay)
        np.testing.assert_allclose(wrap180(found[0] - azimuth), 0, atol=1e-3)
        np.testing.assert_allclose(found[1], distance, atol=0.2)
        np.testing.assert_allclose(found[2], heard_rate, atol=1e-3)
        assert abs(track.observables(received)[1] - distance).max() > 200
        np.testing.assert_array_equal(track.heard(received, None), track.observables(received))

    def test_range_rate_survives_jitter_of_close_reports(self):
        rng = np.random.default_rng(3)
        times = T0 + np.sort(rng.uniform(-8000, 8000, 2000))
        table = straight_ship(self.course, times)
        table["lat"] += rng.normal(0, 10 / 111e3, len(table))
        (track,) = ais.reference_tracks(table, STATION)
        inner = T0 + np.linspace(-7000, 7000, 200)
        assert np.std(track.observables(inner)[2] - self.course.observables(inner)[2]) < 0.1

    def test_noise_comes_from_the_stern(self):
        table = straight_ship(self.course, T0 + 600.0 * np.arange(-40, 41), length_m=300.0)
        (track,) = ais.reference_tracks(table, STATION, source_astern=0.5)
        assert track.line().cpa_time - T0 == pytest.approx(150.0 / 7.0, abs=0.5)
        assert track.line().cpa_range_m == pytest.approx(-8e3, abs=1.0)

    def test_attributes_and_merchant_ships(self):
        times = T0 + 600.0 * np.arange(-9, 9)
        table = pd.concat(
            [
                straight_ship(self.course, times, mmsi=1, name="A", ship_type="70", length_m=190.0),
                straight_ship(self.course, times, mmsi=2, name="B", ship_type="30", length_m=np.nan),
                straight_ship(self.course, times, mmsi=3, name=None, ship_type="Tanker", length_m=190.0),
            ]
        )
        tracks = ais.reference_tracks(table, STATION)
        assert sorted(track.name for track in tracks) == ["3", "A", "B"]
        assert sorted(track.mmsi for track in ais.reference_tracks(table, STATION, merchant_only=True)) == [
            1,
            3,
        ]
        assert next(t for t in tracks if t.mmsi == 1).attributes == {"ship_type": "70", "length_m": 190.0}

    def test_station_objects_and_the_date_line(self):
        class Place:
            latitude, longitude = 0.0, 180.0

        table = frame(T0 + np.arange(5) * 3600.0, [179.8, 179.9, 180.0, -179.9, -179.8], 0.05)
        (track,) = ais.reference_tracks(table, Place())
        assert track.cpa().range_m == pytest.approx(5529, abs=2) and track.line().course_deg == pytest.approx(
            90, abs=0.1
        )

    def test_failures(self):
        with pytest.raises(AISError, match="lacks lon; it holds mmsi, time, lat"):
            ais.reference_tracks(straight_ship(self.course, [T0, T0 + 9]).drop(columns="lon"), STATION)
        with pytest.raises(ConfigError, match="max_range_m=-1"):
            ais.reference_tracks(straight_ship(self.course, [T0, T0 + 9]), STATION, max_range_m=-1)
        assert ais.reference_tracks(straight_ship(self.course, [T0]), STATION) == []


spec = importlib.util.find_spec("obsea")
OBSEA = Path(spec.origin).parent / "data" if spec and spec.origin else None


@pytest.mark.skipif(OBSEA is None, reason="package obsea, which carries real AIS, is not installed")
class TestRealFiles:
    def test_satellite_and_terrestrial_files_are_read_whole(self):
        kept = {
            name: ais.read(OBSEA / f"{name}.csv").attrs["report"]
            for name in ("ais_cls", "ais_marine_traffic")
        }
        assert (kept["ais_cls"].dialects, kept["ais_cls"].kept) == (("CLS",), 10442)
        report = kept["ais_marine_traffic"]
        assert report.dialects == ("MarineTraffic",) and report.rows == 11161 and report.kept > 11100

    def test_speeds_agree_with_the_positions(self):
        for name in ("ais_week_cls", "ais_marine_traffic"):
            table = ais.read(OBSEA / f"{name}.csv")
            ships = ais.reference_tracks(table, STATION, max_cpa_m=None)
            fast = [track for track in ships if track.line().speed_mps > 5 and len(track.time) > 20]
            ratio = [
                track.line().speed_mps / table[table["mmsi"] == track.mmsi]["sog_mps"].median()
                for track in fast
            ]
            assert len(fast) > 5 and np.median(ratio) == pytest.approx(1.0, abs=0.05)

    def test_eleven_ships_of_the_papers_week(self):
        table = ais.read(OBSEA / "ais_week_cls.csv")
        start = float(to_posix(np.datetime64("2013-05-21")))
        tracks = ais.reference_tracks(table, STATION, merchant_only=True, starttime=start)
        assert len(tracks) == 11
        assert [track.name for track in tracks[:2]] == ["SEA QUEEN II", "PARISIANA"]
        assert all(
            track.cpa().range_m < 25e3 and 100 < track.attributes["length_m"] < 300 for track in tracks
        )

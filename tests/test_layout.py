"""Times as ISO 8601 writes them, in its extended and its basic form."""

import pytest

from obsnet.layout import parse_utc

TEN = parse_utc("2013-05-21T10:00:00Z")


@pytest.mark.parametrize(
    "text",
    [
        "20130521T100000Z",
        "20130521T1000",
        "20130521T10",
        "2013-05-21 10:00",
        "2013-141T10:00:00Z",
        "2013141T100000Z",
        "20130521T120000+0200",
        "2013-05-21T08:00:00.000-02:00",
    ],
)
def test_one_time_in_many_words(text):
    assert parse_utc(text) == TEN


def test_a_day_ends_where_the_next_begins():
    assert parse_utc("2013-05-21T24:00:00") == parse_utc("20130521T24Z") == parse_utc("2013-142")
    assert parse_utc("2012-366") == parse_utc("2012-12-31") == parse_utc("2013-001") - 86400 * 10**9


@pytest.mark.parametrize(
    "text",
    [
        "201305", "2013-0521", "2013-05-21T24:00:01", "2013-05-21T25:00", "2013-366", "2013-000", "2013-13-01",
        "2013-02-29", "2013T10:00", "2013-05T10:00", "2013-05-21T10:60", "2013-05-21+02:00", "2013-05-21T",
    ],
)  # fmt: skip
def test_what_is_no_time(text):
    with pytest.raises(ValueError):
        parse_utc(text)

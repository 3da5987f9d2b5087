"""Many station-days of an SDS archive in, partitioned Parquet and Zarr out: ``obsnet archive``.

A station-day is detected on its own, after a run-in in which the causal filters learn; tracks are found afterwards over
the joined days of a station, so that midnight is a minute like any other.
"""

from obsnet.archive.campaign import Report, archive

__all__ = ["Report", "archive"]

"""A station's waveforms and metadata out of an FDSN data centre, into a folder that a run can read.

The folder is an SDS archive (``YEAR/NET/STA/CHAN.D/NET.STA.LOC.CHAN.D.YEAR.DAY``) with the StationXML and a
manifest beside it. Waveforms come day by day and channel by channel; what the manifest records as complete is
not asked for again.
"""

from obsnet.fdsn.data_centre import Retry
from obsnet.fdsn.fetch import FetchReport, fetch

__all__ = ["FetchReport", "Retry", "fetch"]

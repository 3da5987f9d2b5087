"""AIS files in, reference tracks of ships around a station out.

`read` recognises the seven dialects of AIS files from their content, `reference_tracks` projects their
positions around a station and cuts them into passages, and `write_plain` writes the simplest dialect back.
"""

from obsnet.ais.files import ReadReport, read, write_plain
from obsnet.ais.tracks import ClosestApproach, ReferenceTrack, reference_tracks

__all__ = ["ClosestApproach", "ReadReport", "ReferenceTrack", "read", "reference_tracks", "write_plain"]

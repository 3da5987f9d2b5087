"""Where the bundled sample passage lies: in an installed package, or in a checkout."""

from __future__ import annotations

from pathlib import Path

from obsnet.errors import ObsnetError


def sample_folder() -> Path:
    """Folder of the sample passage: waveforms.mseed, station.xml, ais.csv (simulated waveforms)."""
    here = Path(__file__).resolve().parent
    for folder in (here / "_sample", here.parent / "data"):
        if (folder / "waveforms.mseed").is_file():
            return folder
    raise ObsnetError("the sample passage is missing from this installation; reinstall obsnet")

"""The service unit in the documentation is one that systemd takes."""

import shutil
import subprocess
from pathlib import Path

import pytest

DOCUMENT = Path(__file__).parents[2] / "docs" / "station.md"


def unit() -> str:
    return DOCUMENT.read_text().split("```ini\n")[1].split("```")[0]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_takes_the_unit(tmp_path):
    path = tmp_path / "obsnet.service"
    path.write_text(unit().replace("/opt/obsnet/bin/obsnet", shutil.which("true")))
    made = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(path)], capture_output=True, text=True, check=False
    )
    assert made.returncode == 0 and str(path.name) not in made.stderr, made.stderr

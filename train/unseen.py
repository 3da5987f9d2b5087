"""Write one simulated record of the second generator, which training never uses: python train/unseen.py --kind faint --seed 3 --out DIR."""

from __future__ import annotations

import argparse

from elsewhere.kinds import KINDS, compose, write


def main() -> None:
    """Read the command line, write the record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind", choices=KINDS, default="ordinary")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hours", type=float, default=6.0)
    parser.add_argument(
        "--out", required=True, help="folder for waveforms.mseed, station.xml, ais.csv, truth.csv, truth.json"
    )
    given = parser.parse_args()
    write(compose(given.kind, given.seed, given.hours), given.out)


if __name__ == "__main__":
    main()

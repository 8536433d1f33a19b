"""Match four WFC3/UVIS star lists, measured by hst1pass, to the master frame made from them.

Usage: python match.py FOLDER    (writes stars.ecsv beside this script)

FOLDER holds the *.uvwXYMpq lists and MATCHUP_XYMEEE_final.  Raw pixels (X, Y) become x, y;
positions in the master frame become u, v.  The lists carry no errors: config.toml asks for them by
magnitude.
"""

import sys
from pathlib import Path

from astropy.table import Table

import bayesdist as bd
from bayesdist.formats import read_matchup


def main(folder: Path) -> None:
    lists = bd.read_matches(folder / "*.uvwXYMpq", sigma="by_magnitude")
    master = read_matchup(folder / "MATCHUP_XYMEEE_final")
    stars = bd.match_table(lists, master)

    table = Table()
    for name in ("x", "y", "u", "v"):
        table[name] = getattr(stars, name)
        table[name].unit = "pix"
    table["mag"] = stars.mag
    table["epoch"] = stars.epoch
    table["exposure"] = [stars.exposure_names[k] for k in stars.exposure]
    output = Path(__file__).with_name("stars.ecsv")
    table.write(output, overwrite=True)
    print(f"{len(stars)} matches of {stars.n_rows} detections: {output}")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))

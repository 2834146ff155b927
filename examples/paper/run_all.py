"""Recompute everything of the paper: print the tables, draw the pictures, and put the tables on `docs/paper_tables.md`.

With a folder the pictures go there instead and the page stays as it is.
Usage: python examples/paper/run_all.py [FOLDER]
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from examples.paper import (
    bode,
    collision,
    discretisation,
    oscillation,
    payload_bounds,
    port_passivity,
    smallest_damping,
    table_one,
)
from examples.paper.page import PAGE, PICTURES, Study, Table, put_on_page, show

STUDIES: dict[str, Study[Any]] = {
    "bode": bode.STUDY,
    "smallest_damping": smallest_damping.STUDY,
    "payload_bounds": payload_bounds.STUDY,
    "oscillation": oscillation.STUDY,
    "port_passivity": port_passivity.STUDY,
    "discretisation": discretisation.STUDY,
    "collision": collision.STUDY,
    "table_one": table_one.STUDY,
}


def main(arguments: Sequence[str]) -> int:
    folder = Path(arguments[0]) if arguments else PICTURES
    tables: list[Table] = []
    for name, study in STUDIES.items():
        began = time.perf_counter()
        tables += show(study, folder)
        print(f"{name}: {time.perf_counter() - began:.1f} s", file=sys.stderr)
    if not arguments:
        PAGE.write_text(put_on_page(PAGE.read_text(encoding="utf-8"), tables), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

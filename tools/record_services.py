"""Record what an image answers to the programs of `hil.deploy.service_programs`, for machines without the image.

    python tools/record_services.py --elf cf2.elf            (with the exported app: tests/vectors/services/app.json)
    python tools/record_services.py --elf cf2.elf --stock    (the stock firmware: tests/vectors/services/stock.json)

The image boots once; each program is played in a copy of that process, so that it begins at the same instant. Paths are in
millimetres and milliradians.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from hil.board.image_firmware import ChipImage  # noqa: E402
from hil.deploy.service_programs import PROGRAMS, STOCK  # noqa: E402 - from this tree
from hil.deploy.services import ServiceBench, play_in_copies  # noqa: E402

FOLDER = ROOT / "tests" / "vectors" / "services"


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--elf", type=Path, required=True)
    parser.add_argument("--stock", action="store_true")
    parser.add_argument(
        "--only", default="", help="programs whose name contains this; the others stay as recorded"
    )
    options = parser.parse_args(arguments)
    file = FOLDER / ("stock.json" if options.stock else "app.json")
    recorded = json.loads(file.read_text()) if file.exists() else {}
    bench = ServiceBench(ChipImage.load(options.elf, None))
    FOLDER.mkdir(parents=True, exist_ok=True)
    names = [
        name
        for name, program in PROGRAMS.items()
        if (name in STOCK or not options.stock)
        and options.only in name
        # One of this run or an earlier one stays: remove the file for another image.
        and (options.only or recorded.get(name, {}).get("program") != program)
    ]
    for name, answers in zip(names, play_in_copies(bench, map(PROGRAMS.__getitem__, names)), strict=True):
        path = [[round(1000 * part) for part in place] for place in answers.path]
        recorded[name] = {"program": PROGRAMS[name], "answers": answers.lines, "path": path}
        print(name, flush=True)
        rows = (f"{json.dumps(one)}: {json.dumps(recorded[one])}" for one in PROGRAMS if one in recorded)
        file.write_text("{\n" + ",\n".join(rows) + "\n}\n")


if __name__ == "__main__":
    main(sys.argv[1:])

"""Check a graphics card: are its numbers right, do they repeat, how fast is it.

    python scripts/check_gpu.py --out results/gpu
    python scripts/check_gpu.py --out results/gpu --device llvmpipe --quick

Writes card.json and card.md, to attach to a report. In a checkout the sample is trained too. Exits with 1 if the card's
numbers are wrong or do not repeat.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import _checkout  # noqa: F401  puts the checkout on the path

from _terminal import arguments_of, program, run, terminal_progress
from fruitlangs.benchmarks.training.card_check import COUNTS, SIZES, check_card, page
from fruitlangs.engine.errors import GpuError
from fruitlangs.engine.splatting.gpu.adapters import choose_adapter, find_adapters

SAMPLE = Path(__file__).resolve().parents[1] / "examples" / "orchard_tree"


def main(given: Sequence[str] | None = None) -> None:
    """Write the files and print the page.

    Raises:
        FruitLangsError: there is no such card, or it fails, is wrong or does not repeat.
    """
    parser = argparse.ArgumentParser(
        prog=program(__file__), description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of card.json and card.md")
    parser.add_argument("--device", default="gpu", help="part of a card's name; software too (default: a real card)")
    parser.add_argument("--quick", action="store_true", help="the smallest steps only, and not the sample")
    arguments = parser.parse_args(arguments_of(__file__) if given is None else given)
    for each in find_adapters():
        print(f"{each.identity}{', software' if each.software else ''}{': ' + each.missing[0] if each.missing else ''}")
    adapter = choose_adapter(arguments.device)
    if adapter is None:
        raise GpuError(f"--device {arguments.device} names no card. Give gpu, or a part of a name above")
    counts, sizes = (COUNTS[:1], SIZES[:1]) if arguments.quick else (COUNTS, SIZES)
    sample, progress = SAMPLE.is_dir() and not arguments.quick, terminal_progress()
    report = check_card(adapter, SAMPLE, counts=counts, sizes=sizes, sample=sample, progress=progress)
    progress(1.0, "Done")
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "card.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    (arguments.out / "card.md").write_text(page(report), encoding="utf-8")
    print(page(report))
    print("written:", arguments.out / "card.json", arguments.out / "card.md", sep="\n  ")
    repeats = report["repeats"]
    if repeats["device"] != adapter.identity:
        raise GpuError(f"The training did not end on the card: {repeats['device']}")
    if not (report["right"] and repeats["again"] and repeats["resumed"]):
        raise GpuError(f"{adapter.name} computes wrong numbers, or other ones each time. Train with --train.device cpu")


if __name__ == "__main__":
    run(main)

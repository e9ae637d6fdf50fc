"""Turn the truth of a published data set into the truth.json that evaluate.py reads.

    python scripts/import_truth.py LAYOUT FOLDER --out truth.json

LAYOUT is fruitnerf (a nerfstudio folder with fruit masks and a mesh of the fruit), pfuji-size or fuji-sfm. The data
sets are not part of FruitLangs; docs/datasets.md says where they are and how each is read.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np

from _terminal import arguments_of, run
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.evaluation.datasets import fruitnerf, fuji, pfuji
from fruitlangs.engine.evaluation.datasets.cloud import ColoredCloud, write_cloud
from fruitlangs.engine.evaluation.datasets.imported import ImportedTruth, read_similarity, transform, write_truth
from fruitlangs.engine.evaluation.trees import tally

LAYOUTS = (fruitnerf.LAYOUT, pfuji.LAYOUT, fuji.LAYOUT)


def main(given: Sequence[str] | None = None) -> None:
    """Write the files and summarise them.

    Raises:
        FruitLangsError: the data set cannot be read or the files cannot be written.
    """
    arguments = _make_parser().parse_args(arguments_of(__file__) if given is None else given)
    _refuse_other_flags(arguments)
    imported, cloud = _read(arguments)
    if arguments.transform is not None:
        imported = transform(imported, read_similarity(arguments.transform))
    if cloud is not None:
        write_cloud(arguments.cloud, cloud)
    write_truth(arguments.out, imported)
    print("\n".join(_summarise(imported)))


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("layout", choices=LAYOUTS, metavar="LAYOUT", help=", ".join(LAYOUTS))
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="the unpacked data set, or one tree of it")
    parser.add_argument("--out", type=Path, required=True, help="where truth.json goes")
    parser.add_argument("--cloud", type=Path, help="also write the coloured points, as this .ply (both Fuji layouts)")
    parser.add_argument("--part", help="pfuji-size: trees and day, such as 2018_01")
    parser.add_argument("--label", help="fruitnerf: what the fruit are (default: what transforms.json says)")
    parser.add_argument("--fruits", type=Path, help="fruitnerf: the mesh of the true fruit (default: the only .obj)")
    parser.add_argument("--transform", type=Path, help="4x4 similarity, as text, into the frame that was counted in")
    return parser


def _refuse_other_flags(arguments: argparse.Namespace) -> None:
    """Raise ConfigError for a flag that the layout would silently ignore."""
    flags = {
        "part": (pfuji.LAYOUT,),
        "label": (fruitnerf.LAYOUT,),
        "fruits": (fruitnerf.LAYOUT,),
        "cloud": (pfuji.LAYOUT, fuji.LAYOUT),
    }
    for flag, layouts in flags.items():
        if getattr(arguments, flag) is not None and arguments.layout not in layouts:
            raise ConfigError(f"--{flag} is for {' and '.join(layouts)}, not for {arguments.layout}. Leave it out")
    if arguments.cloud is not None and arguments.transform is not None:
        raise ConfigError("--cloud is written in the data set's own frame. Leave out --transform, or import twice")


def _read(arguments: argparse.Namespace) -> tuple[ImportedTruth, ColoredCloud | None]:
    """The truth of the folder, and its cloud if requested."""
    if arguments.layout == fruitnerf.LAYOUT:
        truth = fruitnerf.read_fruitnerf_truth(arguments.folder, label=arguments.label, fruits=arguments.fruits)
        return truth, None
    if arguments.layout == pfuji.LAYOUT:
        apples = pfuji.read_pfuji(arguments.folder, arguments.part)
        return apples.truth, apples.cloud if arguments.cloud is not None else None
    cloud = fuji.read_fuji_cloud(arguments.folder) if arguments.cloud is not None else None
    return fuji.read_fuji_truth(arguments.folder), cloud


def _summarise(imported: ImportedTruth) -> list[str]:
    diameters = imported.truth.diameters
    lines = [f"{len(diameters)} {imported.label}, mean diameter {np.mean(diameters):.4g} scene units"]
    if imported.truth.trees is not None:
        counts = tally(imported.truth.trees, imported.truth.trees)
        pairs = zip(counts.trees, counts.counts, strict=True)
        lines.append("by tree: " + ", ".join(f"{tree}: {count}" for tree, count in pairs))
    return lines + [f"note: {remark}" for remark in imported.remarks]


if __name__ == "__main__":
    run(main)

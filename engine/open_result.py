"""Opens an earlier result to view it and to query it again: what `count_scene` keeps in memory, from its folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from .config import Config
from .errors import EncoderError, FormatError
from .language.features.embedder import Embedder
from .language.prompts.selection import select
from .publishing import Result
from .reconstruction import Reconstruction, reopen
from .report.results import FRUITS_JSON, find_near_members, parse_count
from .report.selection import SELECTION, Selection, read_selection
from .result_folder import ResultFolder
from .training import RunLog


def open_result(folder: Path) -> Result:
    """Open the result in `folder`, with its photos if they are still available; nothing is written or computed.

    Fruit have no sampled points.

    Parameters
    ----------
    folder : Path
        What `count_scene` wrote.

    Returns
    -------
    Result
        As `count_scene` returned it.

    Raises
    ------
    OutputError
        There is no result, or its files are not of one run.
    FormatError
        It is damaged, or of another version.

    Examples
    --------
    >>> fruitlangs.open_result(Path("results/tree7")).fruit_count.diameters.mean()
    0.0731
    """
    results, log = ResultFolder(folder), RunLog()
    document = results.read()
    stored = Config.from_document(document["config"])
    made = reopen(results, document, stored, log, cache=results.cache)
    try:
        selection = _selection(folder, document, made, stored, log)
        counted = parse_count(document, selection.fruit_ids)
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{folder / FRUITS_JSON} is damaged ({error}). Count again into this folder") from error
    return Result(
        scene=made.scene,
        gaussians=made.gaussians,
        features=made.features,
        probability=selection.probability,
        fruit_count=counted,
        origin={**document["provenance"], "source": made.origin["source"]},
        config=stored,
        seconds={},
        reused=log.reused,
        notices=list(dict.fromkeys([*document.get("notices", ()), *log.notices])),
        out=folder,
        set_id=document["set_id"],
    )


def _selection(
    folder: Path, document: Mapping[str, Any], made: Reconstruction, stored: Config, log: RunLog
) -> Selection:
    """The probability and the fruit of every Gaussian.

    The probability of results without `selection.safetensors` is computed again; if their encoder is not available, it
    is 0, and a notice says so.
    """
    if SELECTION in document["files"]:
        return read_selection(folder / SELECTION)
    prompts, negatives = document["provenance"]["prompts"], document["provenance"].get("negatives", [])
    means = made.gaussians.means
    try:
        encoder = Embedder.open(stored.embed).encoder
        probability = select(made.features, encoder, prompts, negatives, stored.count, means)
    except EncoderError as error:
        log.notices.append(f"the match of the prompt is not shown: {error}")
        probability = torch.zeros(len(means))
    return Selection(probability, find_near_members(document, means.double().numpy()))

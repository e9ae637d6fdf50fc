"""What all scripts share on the command line: arguments, progress, exit codes."""

from __future__ import annotations

import argparse
import dataclasses
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from fruitlangs.engine.config import PRESETS, STAGES, Preset
from fruitlangs.engine.errors import Cancelled, FruitLangsError
from fruitlangs.engine.progress import Progress, silent

_COMMAND: list[str] = []


def run_as(command: str) -> None:
    """From now on the script calls itself by this command, such as `fruitlangs count`."""
    _COMMAND[:] = [command]


def program(script: str) -> str:
    """What the user typed to run a script: its file name, or the installed command."""
    return _COMMAND[0] if _COMMAND else Path(script).name


def call_of(script: str) -> str:
    """The beginning of a command line that runs a script."""
    return _COMMAND[0] if _COMMAND else f"python scripts/{Path(script).name}"


def import_tyro() -> ModuleType:
    """tyro, or exit 1 with the command that installs it."""
    try:
        import tqdm  # noqa: F401
        import tyro
    except ImportError as error:
        sys.exit(
            f'the package {error.name} is missing in this Python; run: "{sys.executable}" -m pip install tqdm tyro'
        )
    return tyro


def arguments_of(script: str) -> list[str]:
    """The script's own arguments, under plain Python and under `blender -b -P script -- …`."""
    if Path(sys.argv[0]).resolve() == Path(script).resolve():
        return sys.argv[1:]
    return sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []


def spell_out(given: Sequence[str], stage: str, config_class: type) -> list[str]:
    """Return the arguments with the stage added to flags of a stage that may be given without it: --encoder clip is
    --embed.encoder clip."""
    names = {field.name.replace("_", "-") for field in dataclasses.fields(config_class) if field.name != "seed"}
    spelled = []
    for argument in given:
        flag, equals, value = argument.partition("=")
        name = flag.removeprefix("--").replace("_", "-")
        if flag.startswith("--") and {name, name.removeprefix("no-")} & names:
            flag = f"--{stage}.{name}"
        spelled.append(flag + equals + value)
    return spelled


def list_given_settings(given: Sequence[str]) -> set[str]:
    """List the settings ("train.steps") among the arguments, whatever their value; --preset gives those of training."""
    names = {argument.partition("=")[0].removeprefix("--").replace("-", "_") for argument in given}
    settings = {f"{stage}.{field.name}" for stage, kind in STAGES.items() for field in dataclasses.fields(kind)}
    of_training = {name for name in settings if "preset" in names and name.startswith("train.")}
    return settings & {name.replace(".no_", ".") for name in names} | of_training


def preset_of(given: Sequence[str]) -> Preset:
    """The --preset among the arguments, read first because training flags change it. tyro reports what is wrong."""
    first = argparse.ArgumentParser(add_help=False, exit_on_error=False)
    first.add_argument("--preset", choices=list(PRESETS), default="standard")
    try:
        preset: Preset = first.parse_known_args(given)[0].preset
    except argparse.ArgumentError:
        return "standard"
    return preset


def run(main: Callable[[], None]) -> None:
    """Call `main` and exit: 0 done, 1 with one line on a `FruitLangsError`, 130 on Ctrl-C or a cancel."""
    # Blender installs its own handlers; Ctrl-C and a cluster's SIGTERM both mean: stop cleanly.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda *_: signal.default_int_handler(signal.SIGINT, None))
    try:
        main()
    except FruitLangsError as error:
        _leave(f"error: {' '.join(str(error).split())}", 1)
    except (Cancelled, KeyboardInterrupt):
        _leave("cancelled; earlier results are as they were", 130)
    except BrokenPipeError:  # what reads the output has ended, such as head; Python would report it again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


def _leave(line: str, code: int) -> NoReturn:
    """Exit with one line on stderr, in place of a progress bar."""
    clear = "\r\x1b[K" if sys.stderr.isatty() else ""
    print(f"{clear}{line}", file=sys.stderr, flush=True)
    sys.exit(code)


def format_table(rows: list[tuple[str, ...]]) -> str:
    """Write rows of cells in aligned columns."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    first, *others = widths
    return "\n".join(
        "  ".join([row[0].ljust(first), *(cell.rjust(width) for cell, width in zip(row[1:], others, strict=True))])
        for row in rows
    )


def say(text: str) -> None:
    """Print a result at once, for runs that take minutes."""
    print(text, flush=True)


def report(message: str) -> None:
    """Report progress: one line per step, on stderr."""
    print(message, file=sys.stderr, flush=True)


def terminal_progress() -> Progress:
    """A bar on a terminal, nothing in a log."""
    if not sys.stderr.isatty():
        return silent
    from tqdm import tqdm

    layout = "{percentage:3.0f}% |{bar}| {elapsed}<{remaining} {desc}"
    bar = tqdm(total=1.0, bar_format=layout, file=sys.stderr, miniters=0)

    def show(fraction: float, message: str) -> None:
        bar.set_description_str(message, refresh=False)
        bar.update(max(fraction - bar.n, 0.0))
        if fraction >= 1.0:
            bar.close()

    return show

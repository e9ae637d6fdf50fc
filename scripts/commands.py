"""The command `fruitlangs` of an installed package, which runs the scripts of this folder.

fruitlangs count PHOTOS --prompt apple --out DIR      # scripts/count_fruit.py
fruitlangs --help                                     # all commands
"""

from __future__ import annotations

import ast
import runpy
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

COMMANDS = {
    "check": "check_photos.py",
    "count": "count_fruit.py",
    "orchard": "count_orchard.py",
    "teach": "teach_word.py",
    "compare": "compare_trees.py",
    "check-gpu": "check_gpu.py",
}
"""{command: its script}."""


def main() -> None:
    """Run the command that the command line names; exit 2 if there is none."""
    import _checkout  # noqa: F401  lets every console print the texts

    from _terminal import run_as
    from fruitlangs import __version__

    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name in COMMANDS:
        script = str(HERE / COMMANDS[name])
        sys.argv = [script, *sys.argv[2:]]
        run_as(f"fruitlangs {name}")
        runpy.run_path(script, run_name="__main__")
    elif name == "--version":
        print(f"fruitlangs {__version__}")
    elif name in ("-h", "--help"):
        print(overview())
    else:
        print(f"error: {name!r} is not a command\n\n{overview()}" if name else overview(), file=sys.stderr)
        sys.exit(2)


def overview() -> str:
    """One line for each command: the first sentence of its script."""
    lines = ["usage: fruitlangs COMMAND …", "", "Commands; fruitlangs COMMAND --help explains each:"]
    for name, script in COMMANDS.items():
        text = ast.get_docstring(ast.parse((HERE / script).read_text(encoding="utf-8"))) or ""
        lines.append(f"  {name:<10} {text.splitlines()[0]}")
    return "\n".join([*lines, "", "fruitlangs --version prints the version."])


if __name__ == "__main__":
    main()

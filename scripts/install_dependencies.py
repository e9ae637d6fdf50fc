"""Install the Python packages that Blender's Python lacks into the extension's own folder, headless.

    blender -b --online-mode --python-exit-code 1 -P scripts/install_dependencies.py -- --yes
    blender -b --python-exit-code 1 -P scripts/install_dependencies.py -- --yes --wheels FOLDER
    blender -b --online-mode --python-exit-code 1 -P scripts/install_dependencies.py -- --yes --cuda

Without --yes it says what it would install. Where the extension is enabled it is its own install that is completed;
else the packages go where this checkout finds them when Blender runs its scripts. Exit code 0: all is there; 1: it
failed and nothing was changed, with one line that says why; 2: usage, or --yes was not given and something is missing.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from types import ModuleType

sys.path.insert(0, str(Path(__file__).resolve().parent))


def main() -> int:
    parser = argparse.ArgumentParser(prog="install_dependencies.py", description="Install missing Python packages.")
    parser.add_argument("--yes", action="store_true", help="install, not only say what is missing")
    parser.add_argument("--wheels", type=Path, help="a folder of wheel files to install from, without going online")
    parser.add_argument(
        "--cuda", action="store_true", help="install PyTorch for NVIDIA cards (about 3 GB), for CLIP and SAM"
    )
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    arguments = parser.parse_args(given)
    dependencies = find_dependencies()
    if arguments.cuda:
        missing = [] if dependencies.has_cuda_torch() else ["PyTorch for NVIDIA cards"]
    else:
        missing = dependencies.find_missing_packages()
    if not missing:
        print("All Python packages are installed")
        return 0
    print(f"Missing: {', '.join(missing)}; they go into {dependencies.packages_folder()}")
    if not arguments.yes:
        print("Say --yes to install them", file=sys.stderr)
        return 2
    try:
        dependencies.install_missing(arguments.wheels, dependencies.print_steps(), cuda=arguments.cuda)
    except dependencies.InstallError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print("Installed")
    return 0


def find_dependencies() -> ModuleType:
    """Return `operators.packages.dependencies` of the enabled extension, else of this checkout."""
    for name, module in list(sys.modules.items()):
        if name.startswith("bl_ext.") and name.endswith(".fruitlangs.operators.packages.dependencies"):
            return module
    import _checkout  # noqa: F401

    from fruitlangs.operators.packages import dependencies

    return dependencies


if __name__ == "__main__":
    sys.exit(main())

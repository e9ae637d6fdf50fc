"""Build the Blender extension's zip into dist/.

    python scripts/build_extension.py [--blender PATH] [--out dist]

With a Blender its own `extension build` packs and checks the zip; without one the standard library packs the same
files by the excludes of `blender_manifest.toml`. The zip holds this project's own code and weights only: no Python
wheels. The panel names what Blender's Python lacks and the command that installs it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FIXED_TIME = (2020, 1, 1, 0, 0, 0)
"""Every file's time in the zip, so that the same files give the same bytes."""


def main() -> int:
    parser = argparse.ArgumentParser(description="Build the Blender extension's zip.")
    parser.add_argument("--blender", type=Path, help="a Blender program (4.2 or newer) that builds and validates it")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder for the zip (default: dist)")
    arguments = parser.parse_args()
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    path = arguments.out.resolve() / f"{manifest['id']}-{manifest['version']}.zip"
    path.parent.mkdir(parents=True, exist_ok=True)
    if arguments.blender:
        build = [str(arguments.blender), "--command", "extension", "build"]
        code = subprocess.run([*build, "--source-dir", str(ROOT), "--output-filepath", str(path)]).returncode
        if code:
            return code
    else:
        pack(path, included_files(ROOT, manifest["build"]["paths_exclude_pattern"]))
    print(f"{path} ({path.stat().st_size / 1e6:.2f} MB)")
    return 0


def pack(path: Path, files: list[Path]) -> None:
    """Write the zip, its bytes a function of the files alone."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for file in files:
            entry = zipfile.ZipInfo(file.relative_to(ROOT).as_posix(), FIXED_TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, file.read_bytes())


def included_files(root: Path, patterns: list[str]) -> list[Path]:
    """Files below `root` that no pattern excludes, sorted. Excluded folders are not entered."""
    files = []
    for path in sorted(root.iterdir()):
        files += _included(path, root, patterns)
    return files


def _included(path: Path, root: Path, patterns: list[str]) -> list[Path]:
    relative = path.relative_to(root).as_posix()
    if any(excludes(pattern, relative, path.is_dir()) for pattern in patterns):
        return []
    if path.is_dir():
        return [file for child in sorted(path.iterdir()) for file in _included(child, root, patterns)]
    return [path]


def excludes(pattern: str, relative: str, is_folder: bool) -> bool:
    """Whether a pattern, in the manifest's gitignore-like notation, names this path.

    A leading slash ties it to the root, a trailing one to folders; otherwise it fits a name at any depth. `*` stays
    within a name.
    """
    if pattern.endswith("/") and not is_folder:
        return False
    bare = pattern.strip("/")
    tied = pattern.startswith("/") or "/" in bare
    name = Path(relative)
    return name.match(bare) and (not tied or len(name.parts) == len(Path(bare).parts))


if __name__ == "__main__":
    sys.exit(main())

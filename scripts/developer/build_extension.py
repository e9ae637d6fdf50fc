"""Build the Blender extension's zips into dist/.

    python scripts/developer/build_extension.py              # the small zip, for every Blender
    python scripts/developer/build_extension.py --wheels --blender 4.2 --platform linux-x64

The small zip holds this project's own code and weights; the panel installs the Python packages that are missing. A zip
with wheels holds those packages too, for one platform and one series of Blender; they are downloaded by pip, in the
versions of `operators/packages/package_versions.py`, into dist/wheels. Blender's own NumPy is never among them.

The same files give the same bytes. `--validate PROGRAM` has a Blender program check every zip.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401

from fruitlangs.operators.packages.package_versions import CPU_INDEX, NEVER, SERIES, BlenderSeries, versions_for

ROOT = Path(__file__).resolve().parents[2]
MANIFEST = "blender_manifest.toml"
FIXED_TIME = (2020, 1, 1, 0, 0, 0)
"""Every file's time in the zip, so that the same files give the same bytes."""


@dataclass(frozen=True)
class Platform:
    """A platform under Blender's name: Python's name for it, and the tags of compatible wheels, best first."""

    name: str
    python: str
    tags: tuple[str, ...]


_MANYLINUX = ("_2_28", "_2_27", "_2_26", "_2_24", "_2_17", "2014", "_2_12", "2010", "_2_5", "1")
PLATFORMS = {
    platform.name: platform
    for platform in (
        Platform("linux-x64", "linux", tuple(f"manylinux{version}_x86_64" for version in _MANYLINUX)),
        Platform("windows-x64", "win32", ("win_amd64",)),
        Platform("macos-arm64", "darwin", ("macosx_14_0_arm64",)),
    )
}
"""{Blender's name: platform}. Linux as old as Blender supports; macOS as old as PyCOLMAP and PyTorch support."""


class BuildError(Exception):
    """A zip cannot be built; the message gives the reason."""


def main() -> int:
    parser = argparse.ArgumentParser(description="Build the Blender extension's zips.")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder for the zips (default: dist)")
    parser.add_argument(
        "--wheels", action="store_true", help="also build zips with all Python packages; downloads them"
    )
    parser.add_argument(
        "--platform", nargs="+", choices=PLATFORMS, default=list(PLATFORMS), help="… for these platforms (default: all)"
    )
    series = {one.name: one for one in SERIES}
    parser.add_argument(
        "--blender", nargs="+", choices=series, default=list(series), help="… from these Blenders on (default: all)"
    )
    parser.add_argument("--validate", type=Path, metavar="PROGRAM", help="a Blender program that checks the zips")
    arguments = parser.parse_args()
    out = arguments.out.resolve()
    try:
        built = [build(out)]
        if arguments.wheels:
            for name in arguments.blender:
                for platform in arguments.platform:
                    print(f"wheels for Blender {name} on {platform}", flush=True)
                    built.append(build_with_wheels(out, series[name], PLATFORMS[platform]))
    except BuildError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for path in built:
        print(contents_table(path))
    checks = [[str(arguments.validate), "--command", "extension", "validate", str(path)] for path in built]
    return max([subprocess.run(check).returncode for check in checks] if arguments.validate else [0])


def build(out: Path) -> Path:
    """The small zip: for every platform and every Blender from the manifest's on, without wheels."""
    manifest = read_manifest()
    path = out / f"{manifest['id']}-{manifest['version']}.zip"
    pack(path, list_own_files(manifest))
    return path


def build_with_wheels(out: Path, series: BlenderSeries, platform: Platform) -> Path:
    """The zip with all Python packages for one series of Blender on one platform.

    Raises:
        BuildError: a wheel cannot be had.
    """
    manifest = read_manifest()
    wheels = find_wheel_files(out / "wheels" / f"{platform.name}-python{series.python}", series, platform)
    files: dict[str, Path | bytes] = {f"wheels/{wheel.name}": wheel for wheel in wheels}
    text = (ROOT / MANIFEST).read_text(encoding="utf-8")
    files[MANIFEST] = manifest_with_wheels(text, [*files], series, platform.name).encode()
    path = out / f"{manifest['id']}-{manifest['version']}-blender{series.name}-{platform.name}.zip"
    pack(path, list_own_files(manifest) | files)
    return path


def read_manifest() -> dict:
    return tomllib.loads((ROOT / MANIFEST).read_text(encoding="utf-8"))


def list_own_files(manifest: Mapping) -> dict[str, Path | bytes]:
    """List {name in the zip: file} of this project's own."""
    found = list_included_files(ROOT, manifest["build"]["paths_exclude_pattern"])
    return {file.relative_to(ROOT).as_posix(): file for file in [*found, ROOT / MANIFEST]}


def manifest_with_wheels(text: str, wheels: Sequence[str], series: BlenderSeries, platform: str) -> str:
    """The manifest of a zip with these wheels, paths in the zip, for one series of Blender on one platform.

    Blender reads `blender_version_max` as the first version that does not fit.
    """
    head, table, tail = text.partition("\n[")
    head = re.sub(r"(?m)^blender_version_min = .*$", f'blender_version_min = "{series.first}"', head)
    lines = [f'blender_version_max = "{series.before}"'] if series.before else []
    lines += [f'platforms = ["{platform}"]', "wheels = [", *(f'  "./{wheel}",' for wheel in sorted(wheels)), "]"]
    return head.rstrip("\n") + "\n" + "\n".join(lines) + "\n" + table + tail


def find_wheel_files(folder: Path, series: BlenderSeries, platform: Platform) -> list[Path]:
    """Find one wheel per package and version, sorted; missing ones are downloaded to `folder` by pip.

    Raises:
        BuildError: pip cannot get one, or one does not fit this Blender or the others.
    """
    versions = versions_for(series.numpy, platform.python)
    absent = [name for name, version in versions.items() if _find_wheel(folder, name, version) is None]
    pins = {name: f"{name}=={versions[name]}" for name in absent}
    torch = [pins.pop("torch")] if "torch" in pins else []
    done = not pins or _download(folder, list(pins.values()), series, platform)
    # PyTorch's own index is used only if pip's usual sources have no CPU build.
    done &= not torch or any(_download(folder, torch, series, platform, *more) for more in ((), _CPU_SOURCE))
    if not done:
        raise BuildError(f"pip cannot get all wheels for Blender {series.name} on {platform.name}. It says why above")
    wheels = [_find_wheel(folder, name, version) for name, version in versions.items()]
    assert not [wheel for wheel in wheels if wheel is None or _parse_package(wheel) in NEVER]
    from _wheel_check import find_misfits  # needs a package, which the small zip does not

    chosen = sorted(wheel for wheel in wheels if wheel is not None)
    wrong = find_misfits(
        chosen, python=series.python, numpy=series.numpy, system=platform.python, platforms=platform.tags
    )
    if wrong:
        raise BuildError(f"The wheels for Blender {series.name} on {platform.name} do not fit: {'; '.join(wrong)}")
    return chosen


_CPU_SOURCE = ("--index-url", CPU_INDEX)


def _download(folder: Path, pins: list[str], series: BlenderSeries, platform: Platform, *source: str) -> bool:
    """Download these wheels with pip; returns whether it succeeded."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:", *source]
    command += ["--dest", str(folder), "--implementation", "cp", "--python-version", series.python]
    command += [part for tag in platform.tags for part in ("--platform", tag)]
    return subprocess.run([*command, *pins]).returncode == 0


def _find_wheel(folder: Path, name: str, version: str) -> Path | None:
    """Find the wheel of a package and version in a folder."""
    found = [
        path for path in folder.glob("*.whl") if (_parse_package(path), path.name.split("-")[1]) == (name, version)
    ]
    return found[0] if found else None


def _parse_package(wheel: Path) -> str:
    """Return the pip package that a wheel's file name begins with."""
    return re.sub(r"[-_.]+", "-", wheel.name.split("-")[0]).lower()


def pack(path: Path, files: Mapping[str, Path | bytes]) -> None:
    """Write the zip; its bytes depend only on names and contents of the files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arriving = path.with_suffix(".part")
    with zipfile.ZipFile(arriving, "w") as archive:
        for name, content in sorted(files.items()):
            entry = zipfile.ZipInfo(name, FIXED_TIME)
            entry.compress_type = zipfile.ZIP_STORED if name.endswith(".whl") else zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            data = content if isinstance(content, bytes) else content.read_bytes()
            archive.writestr(entry, data, compresslevel=9)
    arriving.replace(path)


def contents_table(path: Path) -> str:
    """The content of a zip: one line per top folder, per wheel and for all other files, with packed sizes."""
    sizes: dict[str, int] = {}
    for entry in zipfile.ZipFile(path).infolist():
        top, _, rest = entry.filename.partition("/")
        if top == "wheels":
            name, version = rest.split("-")[:2]
            row = f"{name} {version}"
        else:
            row = f"{top}/" if rest else "other files"
        sizes[row] = sizes.get(row, 0) + entry.compress_size
    rows = sorted(sizes.items(), key=lambda row: -row[1])
    lines = [f"{path} ({path.stat().st_size / 1e6:.1f} MB)"]
    return "\n".join(lines + [f"  {size / 1e6:8.2f} MB  {row}" for row, size in rows])


def list_included_files(root: Path, patterns: list[str]) -> list[Path]:
    """List the files below `root` that the patterns do not exclude, sorted. Excluded folders are not entered, links are
    not followed: Blender does the same."""
    files = []
    for path in sorted(root.iterdir()):
        files += _list_included(path, root, patterns)
    return files


def _list_included(path: Path, root: Path, patterns: list[str]) -> list[Path]:
    if path.is_symlink() or is_excluded(path.relative_to(root).as_posix(), path.is_dir(), patterns):
        return []
    if path.is_dir():
        return [file for child in sorted(path.iterdir()) for file in _list_included(child, root, patterns)]
    return [path]


def is_excluded(relative: str, is_folder: bool, patterns: Sequence[str]) -> bool:
    """Whether a path is left out: a pattern matches it, and none that begins with ! does, wherever it stands."""
    kept = any(matches(pattern[1:], relative, is_folder) for pattern in patterns if pattern.startswith("!"))
    return not kept and any(matches(pattern, relative, is_folder) for pattern in patterns if pattern[:1] != "!")


def matches(pattern: str, relative: str, is_folder: bool) -> bool:
    """Whether a pattern, in the manifest's gitignore-like notation, matches this path.

    A leading slash anchors it to the root, a trailing one matches folders; otherwise it matches a name at any depth.
    `*` stays within a name.
    """
    if pattern.endswith("/") and not is_folder:
        return False
    bare = pattern.strip("/")
    tied = pattern.startswith("/") or "/" in bare
    name = Path(relative)
    return name.match(bare) and (not tied or len(name.parts) == len(Path(bare).parts))


if __name__ == "__main__":
    sys.exit(main())

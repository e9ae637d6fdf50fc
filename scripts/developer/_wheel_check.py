"""Whether wheels fit a Blender and one another, from their file names and metadata."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from email.parser import HeaderParser
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.tags import Tag, compatible_tags, cpython_tags, mac_platforms
from packaging.utils import NormalizedName, canonicalize_name, parse_wheel_filename
from packaging.version import Version

MARKERS = {
    "linux": ("Linux", "x86_64", "posix"),
    "win32": ("Windows", "AMD64", "nt"),
    "darwin": ("Darwin", "arm64", "posix"),
}
"""{sys.platform: platform_system, platform_machine and os_name, as requirements ask for them}."""


def find_misfits(
    wheels: Sequence[Path], *, python: str, numpy: str, system: str, platforms: Sequence[str]
) -> list[str]:
    """Return a line for each wheel that is for another Python or platform, and for each requirement that nothing meets.

    python: Blender's, '3.11'; numpy: the version that Blender has; system: as in `sys.platform`; platforms: tags of
    wheels that the platform takes.
    """
    named = {path: parse_wheel_filename(path.name) for path in wheels}
    versions = {name: version for name, version, _, _ in named.values()}
    versions[canonicalize_name("numpy")] = Version(numpy)
    supported = _list_supported(python, system, platforms)
    lines = [
        f"{path.name} is for another Python or platform" for path, (*_, tags) in named.items() if not tags & supported
    ]
    for path in wheels:
        lines += [f"{path.name} needs {need}" for need in _find_unmet(path, versions, python, system)]
    return lines


def _list_supported(python: str, system: str, platforms: Sequence[str]) -> set[Tag]:
    major, minor = map(int, python.split("."))
    known = list(platforms)
    if system == "darwin":
        _, release, of, arch = platforms[0].split("_")
        known = list(mac_platforms((int(release), int(of)), arch))
    own = f"cp{major}{minor}"
    return {*cpython_tags((major, minor), [own], known), *compatible_tags((major, minor), own, known)}


def _find_unmet(path: Path, versions: Mapping[NormalizedName, Version], python: str, system: str) -> Iterator[str]:
    """Find what a wheel needs and neither Blender nor another wheel has."""
    with zipfile.ZipFile(path) as archive:
        name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = HeaderParser().parsestr(archive.read(name).decode())
    if python not in SpecifierSet(metadata.get("Requires-Python", "")):
        yield f"Python {metadata['Requires-Python']}"
    systems = dict(zip(("platform_system", "platform_machine", "os_name"), MARKERS[system], strict=True))
    environment = {"python_version": python, "python_full_version": f"{python}.0", "sys_platform": system, "extra": ""}
    for text in metadata.get_all("Requires-Dist", []):
        need = Requirement(text)
        if need.marker is not None and not need.marker.evaluate({**environment, **systems}):
            continue
        found = versions.get(canonicalize_name(need.name))
        if found is None or not need.specifier.contains(found, prereleases=True):
            yield f"{need.name}{need.specifier} ({'missing' if found is None else f'there is {found}'})"

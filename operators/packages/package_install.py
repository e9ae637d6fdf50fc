"""Installs Python packages into a folder of the extension, with pip in a separate process.

Blender's NumPy and its other packages are neither replaced nor shadowed: pip is constrained to Blender's NumPy,
resolves what is missing, and installs exactly that. An install becomes visible, by one rename, after every package has
been imported once; until then, and if it fails or is killed, nothing has changed.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...engine.errors import FruitLangsError
from ...engine.progress import Progress, silent
from ..package_folder import UNFINISHED, list_installs, name_new_install
from .package_versions import (
    CPU_INDEX,
    CUDA_GIGABYTES,
    CUDA_INDEX,
    CUDA_TORCH,
    NEVER,
    REQUIRED,
    estimate_unpacked_megabytes,
    versions_for,
)

TORCH = "torch"
POLL_SECONDS = 0.25
FORGOTTEN_SECONDS = 24 * 3600.0
"""An unfinished install that was not changed for this long was killed."""


class InstallError(FruitLangsError):
    """Packages cannot be installed; nothing was changed."""


def install_packages(
    packages: Sequence[str],
    folder: Path,
    *,
    wheels: Path | None = None,
    cuda: bool = False,
    progress: Progress = silent,
) -> Path:
    """Install pip packages with their dependencies as a new install in `folder`; returns its folder.

    wheels: a folder of wheel files; without it pip uses its own settings. cuda: PyTorch for NVIDIA cards, which
    replaces the PyTorch that is there when Blender starts again.

    Raises:
        InstallError: pip cannot find, get or unpack one, one cannot be imported, the disk is too small, or the folder
            cannot be written.
        Cancelled: by `progress`.
    """
    if wheels is not None and not wheels.is_dir():
        raise InstallError(f"{wheels} is not a folder. Choose the folder with the wheel files")
    final = name_new_install(folder, cuda=cuda)
    stage = final.with_name(f"{final.name}-{os.getpid()}{UNFINISHED}")
    install = _Install(packages=packages, folder=folder, stage=stage, wheels=wheels, cuda=cuda, progress=progress)
    try:
        _remove_forgotten(folder)
        (stage / "temporary").mkdir(parents=True)
        install.unpack(install.resolve())
        install.try_imports()
        os.replace(install.target, final)
    except OSError as error:
        raise InstallError(f"{folder} cannot be written ({error.strerror or error}). Nothing was changed") from error
    finally:
        shutil.rmtree(stage, ignore_errors=True)
    progress(1.0, "installed")
    return final


@dataclass(frozen=True, kw_only=True)
class _Install:
    """One install: what `install_packages` was asked for, and the stage, a folder in which it is made."""

    packages: Sequence[str]
    folder: Path
    stage: Path
    wheels: Path | None
    cuda: bool
    progress: Progress

    @property
    def target(self) -> Path:
        """The folder of the unpacked packages."""
        return self.stage / "packages"

    def resolve(self) -> dict[str, str]:
        """{package: version} of what has to be installed, resolved by pip without installing anything."""
        carried, own = _list_carried(), {TORCH} if self.cuda else set()
        fixed = {"numpy": np.__version__, **_choose_cffi(carried)}
        if self.wheels is None:
            tested = versions_for(np.__version__, sys.platform)
            fixed = {name: version for name, version in tested.items() if name not in carried | own} | fixed
        constraints, report = self.stage / "constraints.txt", self.stage / "report.json"
        constraints.write_text("".join(f"{name}=={version}\n" for name, version in fixed.items()), encoding="utf-8")
        command = ["--dry-run", "--report", str(report), "--constraint", str(constraints)]
        wanted = [CUDA_TORCH[sys.platform]] if self.cuda else self.packages

        def on_output(_: str) -> None:
            self.progress(0.02, "finding out what is needed")

        failure = self._run_pip([*command, *wanted], self.packages, on_output)
        if failure:
            raise InstallError(f"pip cannot find the packages ({failure}); {self._advice}")
        document = json.loads(report.read_text(encoding="utf-8"))
        found = {entry["metadata"]["name"]: entry["metadata"]["version"] for entry in document["install"]}
        # A newer copy would only be shadowed by Blender's; the imports show whether an old one works.
        kept = {*NEVER, *carried} - own
        return {name: version for name, version in found.items() if _normalise(name) not in kept}

    def unpack(self, found: Mapping[str, str]) -> None:
        """Download and unpack exactly these packages into `target`."""
        self.target.mkdir()
        if not found:
            return
        exact = {name: f"{name}=={version}" for name, version in found.items()}
        if self.cuda and TORCH in exact:
            exact[TORCH] = CUDA_TORCH[sys.platform]
        command = ["--no-deps", "--no-compile", "--progress-bar", "off", "--target", str(self.target)]
        expected = (
            1e9 * CUDA_GIGABYTES[sys.platform][1]
            if self.cuda
            else 1e6 * estimate_unpacked_megabytes(map(_normalise, found))
        )
        free = shutil.disk_usage(self.stage).free
        if free < expected:
            raise InstallError(
                f"{self.folder} has {free / 1e9:.1f} GB of free disk space; this needs about {expected / 1e9:.1f} GB. "
                "Make room"
            )
        furthest = 0.0

        def on_output(output: str) -> None:
            nonlocal furthest
            size = _measure_size(self.stage)
            furthest = max(furthest, min(size / expected, 1.0))  # pip deletes what it has unpacked
            self.progress(0.05 + 0.8 * furthest, f"{_describe_task(output)}, {size / 1e6:.0f} MB so far")

        failure = self._run_pip([*command, *exact.values()], found, on_output)
        if failure:
            raise InstallError(f"pip cannot install the packages ({failure}); {self._advice}")
        for path in self.target.iterdir():
            if re.split(r"[-.]", path.name)[0].lower() in NEVER:
                raise InstallError(f"pip installed {path.name}, which Blender already has. Nothing was changed")

    def try_imports(self) -> None:
        """Import the requested packages in a separate process, as Blender will."""
        modules = [module for module, package in REQUIRED.items() if package in self.packages]
        checks = ["torch.version.cuda or exit('this is the CPU build of PyTorch')"] if self.cuda else []
        checks += ["numba.njit(lambda: 0)()"] if "numba" in modules else []  # it imports some packages to compile only
        code = "; ".join([f"import {module}" for module in ("numpy", *modules)] + checks + ["print(numpy.__version__)"])

        def on_output(_: str) -> None:
            self.progress(0.9, "trying what was installed")

        command = [sys.executable, "-s", "-c", code]
        environment = self._make_environment(self.target, first=self.cuda)
        lines = _watch(command, environment, self.stage / "imports.log", on_output)
        if lines.code:
            raise InstallError(
                f"The packages were downloaded but do not work here ({lines.last}). Nothing was installed"
            )
        if lines.last != np.__version__:
            raise InstallError(f"The packages came with another NumPy ({lines.last}). Nothing was installed")

    def _run_pip(self, arguments: Sequence[str], packages: Iterable[str], on_output: Callable[[str], None]) -> str:
        """Run `pip install` of Blender's Python with one source after the other; returns why it failed, '' if it did
        not. packages: the names of what is asked for."""
        environment = self._make_environment()
        if importlib.util.find_spec("pip") is None:
            environment["PYTHONPATH"] = os.pathsep.join([environment["PYTHONPATH"], _find_bundled_pip()])
        options = ["--only-binary=:all:", "--no-input", "--disable-pip-version-check", "--no-warn-conflicts"]
        failure = ""
        for source in _list_sources(packages, self.wheels, self.cuda):
            command = [sys.executable, "-s", "-m", "pip", "install", *options, *source, *arguments]
            done = _watch(command, environment, self.stage / "pip.log", on_output)
            failure = done.last if done.code else ""
            if not failure:
                break
        return failure

    def _make_environment(self, *more: Path, first: bool = False) -> dict[str, str]:
        """Make the environment of a Python process that uses the same packages as Blender, and none of the user's.

        more: further folders of packages, searched last, or `first`.
        """
        own = [str(path) for path in list_installs(self.folder)]
        seen = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages") or path in own]
        kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONHOME", "PIP_TARGET")}
        temporary = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(self.stage / "temporary"))
        settings = {"PIP_USER": "0", "PIP_REQUIRE_VIRTUALENV": "0", "PYTHONUTF8": "1"}
        folders = [*map(str, more), *seen] if first else [*seen, *map(str, more)]
        return {**kept, **temporary, **settings, "PYTHONPATH": os.pathsep.join(folders)}

    @property
    def _advice(self) -> str:
        if self.wheels is not None:
            return f"put the wheels that are missing into {self.wheels}"
        return "check the network, or install from a folder of wheels"


class _Lines:
    """The exit of a process and its last line."""

    def __init__(self, code: int, text: str) -> None:
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        errors = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR: ")]
        # Without the index of CPU builds pip says that versions are in conflict.
        unanswered = re.findall(r"(?m)^WARNING: Retrying .*: (/\S+)$", text)
        if unanswered:
            errors.insert(0, f"no server replies to {unanswered[-1]}")
        self.code = code
        self.last = (errors or lines or [f"it ended with code {code}"])[0 if errors else -1]


def _watch(
    command: Sequence[str], environment: Mapping[str, str], log: Path, on_output: Callable[[str], None]
) -> _Lines:
    """Run a process to its end and report its output from time to time; an exception from `on_output` ends it."""
    with log.open("wb") as output:
        try:
            child = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, env=environment
            )
        except OSError as error:
            raise InstallError(f"Blender's Python, {command[0]}, cannot be started ({error.strerror})") from error
    try:
        while child.poll() is None:
            on_output(_read_text(log))
            try:
                child.wait(POLL_SECONDS)
            except subprocess.TimeoutExpired:
                continue
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()
    return _Lines(child.returncode, _read_text(log))


def _read_text(log: Path) -> str:
    return log.read_text(encoding="utf-8", errors="replace")


def _find_bundled_pip() -> str:
    """Find the wheel of pip that is part of Python, for a Python without pip."""
    spec = importlib.util.find_spec("ensurepip")
    places = [Path(place) for place in (spec.submodule_search_locations or [])] if spec else []
    found = [wheel for place in places for wheel in sorted(place.glob("_bundled/pip-*.whl"))]
    if not found:
        raise InstallError(f"Blender's Python ({sys.executable}) has no pip. Use the zip that holds all packages")
    return str(found[-1])


def _list_sources(packages: Iterable[str], wheels: Path | None, cuda: bool) -> list[list[str]]:
    """List the options for pip's sources, tried in order: its own settings first, so that a mirror in them is used."""
    if wheels is not None:
        return [["--no-index", "--find-links", str(wheels)]]
    if cuda:
        return [[] if sys.platform == "linux" else ["--extra-index-url", CUDA_INDEX]]
    needs_index = sys.platform == "linux" and TORCH in map(_normalise, packages)
    return [[], ["--extra-index-url", CPU_INDEX]] if needs_index else [[]]


def _list_carried() -> set[str]:
    """List the packages of this Blender's Python, earlier installs included."""
    names = (distribution.metadata["Name"] for distribution in importlib.metadata.distributions())
    return {_normalise(name) for name in names if name}


def _choose_cffi(carried: Container[str]) -> dict[str, str]:
    """Choose the version of cffi that fits the binary half of it that some Linux distributions install without the
    rest."""
    if "cffi" in carried or importlib.util.find_spec("_cffi_backend") is None:
        return {}
    return {"cffi": importlib.import_module("_cffi_backend").__version__}


def _normalise(name: str) -> str:
    """Return a package's name as pip compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _describe_task(output: str) -> str:
    """Describe the current task of pip, from its output."""
    if "\nInstalling collected" in output:
        return "unpacking"
    begun = re.findall(r"(?m)^(?:Collecting|Processing) (?:.*/)?([A-Za-z0-9_.-]+?)(?:==|-\d|$)", output)
    return f"downloading {begun[-1]}" if begun else "downloading"


def _measure_size(folder: Path) -> int:
    """Measure the bytes of all files in a folder that other processes write to."""
    total = 0
    for path, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.stat(os.path.join(path, name)).st_size
            except OSError:
                continue
    return total


def _remove_forgotten(folder: Path) -> None:
    """Remove the remains of killed installs."""
    for path in folder.glob(f"*{UNFINISHED}"):
        if time.time() - path.stat().st_mtime > FORGOTTEN_SECONDS:
            shutil.rmtree(path, ignore_errors=True)

"""The Python packages that are missing in this Blender, and the operators that install them."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import importlib.metadata
import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...engine.progress import Progress, silent
from ..blender_data import areas_of
from ..jobs.jobs import JobOperator, Work, is_busy, start
from ..package_folder import packages_folder, use_packages
from ..settings.settings import is_online
from .package_install import TORCH, InstallError, install_packages
from .package_versions import CPU_INDEX, CUDA_GIGABYTES, CUDA_INDEX, REQUIRED, UNPACKED, estimate_download_megabytes

OFFLINE = (
    "Online access is disabled. Enable Allow Online Access in Preferences > System > Network (or start Blender with "
    "--online-mode), or install from a folder of wheels"
)


def find_missing_packages() -> list[str]:
    """Find the pip names of missing packages; searched, not imported, so that a panel can call it at every redraw."""
    return [package for module, package in REQUIRED.items() if importlib.util.find_spec(module) is None]


def make_install_command(packages: list[str]) -> str:
    """Make a terminal command that installs them; it never replaces Blender's own NumPy."""
    if bpy.app.binary_path:
        code = "import bpy; bpy.ops.fruitlangs.install_dependencies()"
        return f'"{bpy.app.binary_path}" -b --online-mode --python-exit-code 1 --python-expr "{code}"'
    return f'"{sys.executable}" -m pip install {" ".join(packages)} numpy=={np.__version__}'


def install_missing(wheels: Path | None = None, progress: Progress = silent, *, cuda: bool = False) -> list[str]:
    """Install missing packages into the extension's own folder, usable at once; returns the packages.

    wheels: a folder of wheel files to install from instead of going online. cuda: install PyTorch for NVIDIA cards
    instead, which is used after Blender was started again.

    Raises:
        InstallError: online access is disabled and no folder is given, this system has no such PyTorch, or it failed;
            nothing was changed.
        Cancelled: by `progress`.
    """
    return prepare_install(wheels, cuda=cuda)(progress)


def prepare_install(wheels: Path | None = None, *, cuda: bool = False) -> Callable[[Progress], list[str]]:
    """Return the function that does the work of `install_missing`; it may run in any thread.

    Raises:
        InstallError: online access is disabled and no folder is given, or this system has no such PyTorch.
    """
    packages, folder = [TORCH] if cuda else find_missing_packages(), packages_folder()
    if cuda and sys.platform not in CUDA_GIGABYTES:
        raise InstallError("PyTorch supports NVIDIA cards only on Linux and Windows")
    if packages and wheels is None and not is_online():
        raise InstallError(OFFLINE)

    def install(progress: Progress) -> list[str]:
        if packages:
            install_packages(packages, folder, wheels=wheels, cuda=cuda, progress=progress)
            use_packages(folder)
        return packages

    return install


def has_cuda_torch() -> bool:
    """Whether the installed PyTorch supports NVIDIA cards; it is not imported for it."""
    try:
        version = importlib.metadata.version(TORCH)
    except importlib.metadata.PackageNotFoundError:
        return False
    return "+cu" in version or (sys.platform == "linux" and "+" not in version)


def offers_cuda(card: str) -> bool:
    """Whether PyTorch for NVIDIA cards would help this card, and is not installed."""
    return sys.platform in CUDA_GIGABYTES and "NVIDIA" in card and not has_cuda_torch()


def source_text(packages: list[str], wheels: str, *, cuda: bool = False) -> str:
    """The source of these packages, for the dialog that asks for consent."""
    if wheels:
        return bpy.path.abspath(wheels)
    if cuda and sys.platform != "linux":
        return CUDA_INDEX
    extra = f"; PyTorch for the CPU from {CPU_INDEX}" if sys.platform == "linux" and TORCH in packages else ""
    return f"pypi.org, or as pip is set up{'' if cuda else extra}"


class Install:
    """Mix-in of operators that install packages: where from, and which."""

    wheels: bpy.props.StringProperty(
        name="From Folder",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
        description="Folder of wheel files to install from while offline; empty to download",
    )

    cuda: bpy.props.BoolProperty(
        name="For NVIDIA Cards",
        options={"SKIP_SAVE"},
        description="Install PyTorch for NVIDIA cards, which CLIP and SAM use, instead of missing packages",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not is_busy(cls)


class FRUITLANGS_OT_install_dependencies(Install, JobOperator, bpy.types.Operator):
    bl_idname = "fruitlangs.install_dependencies"
    bl_label = "Install Missing Packages"
    bl_description = "Install the missing Python packages into the extension's own folder"
    bl_options = {"INTERNAL"}

    title = "Install"

    def prepare(self, context: bpy.types.Context) -> Work:
        install = prepare_install(Path(bpy.path.abspath(self.wheels)) if self.wheels else None, cuda=self.cuda)
        return (lambda progress: install(print_steps(progress))) if bpy.app.background else install

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        text = f"Installed {', '.join(result)}" if result else "All Python packages are installed already"
        self.report({"INFO"}, "PyTorch for NVIDIA cards is installed. Restart Blender" if self.cuda else text)

    def update_display(self, context: bpy.types.Context) -> None:
        redraw_preferences(context)

    def clear_display(self, context: bpy.types.Context) -> None:
        redraw_preferences(context)


class FRUITLANGS_OT_confirm_install(Install, bpy.types.Operator):
    bl_idname = "fruitlangs.confirm_install"
    bl_label = "Install Missing Packages"
    bl_description = "Show what is missing, its size and its origin, and install it after you confirm"
    bl_options = {"INTERNAL"}

    @classmethod
    def description(cls, context: bpy.types.Context, properties: Any) -> str:
        if properties.cuda:
            return "Show the size and origin of PyTorch for NVIDIA cards, and install it after you confirm"
        return cls.bl_description

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        title = "Install PyTorch for NVIDIA Cards" if self.cuda else self.bl_label
        return context.window_manager.invoke_props_dialog(self, width=520, title=title, confirm_text="Install")

    def draw(self, context: bpy.types.Context) -> None:
        layout, packages = self.layout, find_missing_packages()
        for line in self._describe_cuda_size() if self.cuda else self._describe_sizes(packages):
            layout.label(text=line)
        layout.label(text=f"From: {source_text(packages, self.wheels, cuda=self.cuda)}")
        layout.label(text=f"Into: {packages_folder()}")
        layout.label(text="Blender's own packages are not changed.")
        layout.prop(self, "wheels")
        if not self.wheels and not is_online():
            box = layout.box()
            box.alert = True
            box.label(text="Online access is disabled. Allow it in Preferences > System > Network,", icon="ERROR")
            box.label(text="or choose a folder with the wheel files.")

    def _describe_sizes(self, packages: list[str]) -> list[str]:
        """Say what is missing, and what it needs."""
        megabytes = estimate_download_megabytes(packages)
        kept = f"about {(UNPACKED - 1) * megabytes:.0f} MB are kept"
        return [
            f"{len(packages)} Python packages are missing:",
            *("    " + ", ".join(packages[first : first + 6]) for first in range(0, len(packages), 6)),
            kept.capitalize() if self.wheels else f"About {megabytes} MB are downloaded, {kept}",
        ]

    def _describe_cuda_size(self) -> list[str]:
        """Say what PyTorch for NVIDIA cards needs."""
        download, disk = CUDA_GIGABYTES[sys.platform]
        return [
            "PyTorch for NVIDIA cards makes CLIP and SAM faster; training uses the card without it.",
            f"About {download:.1f} GB are downloaded, {disk:.0f} GB of disk space are needed to unpack them.",
        ]

    def execute(self, context: bpy.types.Context) -> set[str]:
        return start(self, "install_dependencies", wheels=self.wheels, cuda=self.cuda)


class FRUITLANGS_OT_copy_install_command(bpy.types.Operator):
    bl_idname = "fruitlangs.copy_install_command"
    bl_label = "Copy Install Command"
    bl_description = "Copy the command that installs the missing Python packages from a terminal"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bool(find_missing_packages())

    def execute(self, context: bpy.types.Context) -> set[str]:
        context.window_manager.clipboard = make_install_command(find_missing_packages())
        self.report({"INFO"}, "Command copied. Run it in a terminal, then restart Blender")
        return {"FINISHED"}


def print_steps(progress: Progress = silent) -> Progress:
    """Return a `Progress` that also prints every new step, for background mode."""
    last_step = ""

    def report(fraction: float, message: str) -> None:
        nonlocal last_step
        step = message.partition(",")[0]
        if step != last_step:
            print(f"{fraction:4.0%} {step}", flush=True)
            last_step = step
        progress(fraction, message)

    return report


def redraw_preferences(context: bpy.types.Context) -> None:
    """Redraw the Preferences windows, which show the progress of the install."""
    for _, area in areas_of(context, "PREFERENCES"):
        area.tag_redraw()


CLASSES = (FRUITLANGS_OT_install_dependencies, FRUITLANGS_OT_confirm_install, FRUITLANGS_OT_copy_install_command)

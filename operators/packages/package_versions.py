"""The Python packages that the engine needs, their versions, and the NumPy of each Blender.

Nothing here is imported from Blender, because the script that builds the extension also reads it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass

REQUIRED = {
    "torch": "torch",
    "numba": "numba",
    "pycolmap": "pycolmap",
    "safetensors": "safetensors",
    "plyfile": "plyfile",
    "psutil": "psutil",
    "trimesh": "trimesh",
    "scipy": "scipy",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
    "PIL": "pillow",
    "pillow_heif": "pillow-heif",
    "av": "av",
    "jinja2": "jinja2",
    "wgpu": "wgpu",
}
"""{module: pip package} of what the panel needs; the command line also needs tyro and tqdm, and says so."""

NEVER = ("numpy",)
"""Never packed and never installed: Blender has its own, and another one would break it and its add-ons."""

VERSIONS = {
    "av": "18.1.0",
    "cffi": "2.1.1",
    "cloudpickle": "3.1.2",
    "filelock": "4.2.11",
    "fsspec": "2026.9.0",
    "imageio": "2.38.1",
    "jinja2": "3.1.6",
    "joblib": "1.6.0",
    "lazy-loader": "0.6",
    "llvmlite": "0.50.0",
    "markupsafe": "3.0.4",
    "mpmath": "1.3.0",
    "narwhals": "2.28.0",
    "networkx": "3.6.1",
    "numba": "0.68.1",
    "packaging": "26.3",
    "pillow": "13.0.0",
    "pillow-heif": "1.8.1",
    "plyfile": "1.1.3",
    "psutil": "7.2.2",
    "pycolmap": "4.2.1",
    "pycparser": "3.12",
    "rendercanvas": "2.7.2",
    "safetensors": "0.8.0",
    "scikit-image": "0.26.0",
    "scikit-learn": "1.9.1",
    "scipy": "1.17.1",
    "setuptools": "84.2.1",
    "sympy": "1.14.0",
    "threadpoolctl": "3.8.0",
    "tifffile": "2026.3.3",
    "torch": "2.13.0",
    "trimesh": "5.2.0",
    "typing-extensions": "4.16.0",
    "wgpu": "0.32.0",
}
"""{pip package: version} of all needed packages and their dependencies, except NumPy; the tested versions."""

SCIPY_FOR_NUMPY_1_24 = "1.15.3"
"""The last SciPy that works with the NumPy of Blender 4.2 to 4.4."""

ON_MACOS = {"rubicon-objc": "0.5.7"}
"""Needed on macOS only, by wgpu."""

UNPACKED = 4.4
"""Approximate size of unpacked wheels, in sizes of wheels."""

CPU_INDEX = "https://download.pytorch.org/whl/cpu"
"""PyTorch's index of CPU builds. On Linux the build on PyPI includes gigabytes for NVIDIA cards."""

CUDA_INDEX = "https://download.pytorch.org/whl/cu130"
"""PyTorch's index of builds for NVIDIA cards, for Windows."""

CUDA_TORCH = {"linux": f"torch==={VERSIONS['torch']}", "win32": f"torch==={VERSIONS['torch']}+cu130"}
"""{sys.platform: the build for NVIDIA cards, in pip's words}; to pip, === is not satisfied by the CPU build."""

CUDA_GIGABYTES = {"linux": (2.7, 8.0), "win32": (2.0, 6.0)}
"""{sys.platform: (download, disk space while it is unpacked)} of PyTorch for NVIDIA cards with its libraries; Linux
measured."""


@dataclass(frozen=True)
class BlenderSeries:
    """The Blender versions from `first` up to but without `before`, and their Python and NumPy."""

    first: str
    before: str | None
    python: str
    numpy: str

    @property
    def name(self) -> str:
        """'4.2'."""
        return self.first.rpartition(".")[0]


SERIES = (
    BlenderSeries(first="4.2.0", before="4.5.0", python="3.11", numpy="1.24.3"),
    BlenderSeries(first="4.5.0", before="5.1.0", python="3.11", numpy="1.26.4"),
    BlenderSeries(first="5.1.0", before=None, python="3.13", numpy="2.3.4"),
)
"""The official builds (their versions.cmake); a distribution's Blender may use another Python and NumPy."""


def versions_for(numpy: str, platform: str) -> dict[str, str]:
    """`VERSIONS` for a Blender with this NumPy ('1.26.4'), PyTorch as a CPU build.

    platform: as in `sys.platform`.
    """
    fitting = {"torch": VERSIONS["torch"] + ("+cpu" if platform == "linux" else "")}
    if platform == "darwin":
        fitting |= ON_MACOS
    if tuple(map(int, numpy.split(".")[:2])) < (1, 26):
        fitting["scipy"] = SCIPY_FOR_NUMPY_1_24
    return VERSIONS | fitting


_MEGABYTES = {
    "torch": {"linux": 192, "win32": 122, "darwin": 111},
    "llvmlite": {"linux": 60, "win32": 42, "darwin": 41},
    "pycolmap": {"linux": 38, "win32": 24, "darwin": 21},
    "scipy": {"linux": 38, "win32": 37, "darwin": 20},
    "av": {"linux": 36, "win32": 28, "darwin": 18},
    "scikit-image": {"linux": 14, "win32": 12, "darwin": 12},
    "scikit-learn": {"linux": 9, "win32": 9, "darwin": 8},
    "pillow": {"linux": 7, "win32": 7, "darwin": 5},
    "pillow-heif": {"linux": 6, "win32": 7, "darwin": 4},
    "sympy": {"linux": 6, "win32": 6, "darwin": 6},
    "numba": {"linux": 4, "win32": 3, "darwin": 3},
    "wgpu": {"linux": 3, "win32": 3, "darwin": 3},
    "networkx": {"linux": 2, "win32": 2, "darwin": 2},
}
"""{package: {sys.platform: megabytes of its wheel}}, measured; the others have less than one."""

_BRINGS = {"torch": ("sympy", "networkx"), "numba": ("llvmlite",)}
"""Packages installed together with a package, besides small ones."""


def estimate_download_megabytes(packages: Iterable[str], platform: str = sys.platform) -> int:
    """Estimate the download size of these packages and their dependencies."""
    asked = list(packages)
    names = {*asked, *(more for name in asked for more in _BRINGS.get(name, ()))}
    return sum(_MEGABYTES[name].get(platform, 0) if name in _MEGABYTES else 1 for name in names)


def estimate_unpacked_megabytes(packages: Iterable[str]) -> float:
    """Estimate the disk space of the same packages while they are downloaded and unpacked."""
    return UNPACKED * estimate_download_megabytes(packages)

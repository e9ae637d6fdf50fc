"""Missing packages are installed next to Blender's own, with consent, whole or not at all."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from tiny_wheels import make_wheel

from fruitlangs.engine.errors import Cancelled
from fruitlangs.operators import package_folder
from fruitlangs.operators.packages import caches, dependencies, package_install, package_versions

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def home(tmp_path, monkeypatch):
    """An empty folder for installs, and a package `grafting` that Blender's Python lacks."""
    folder = tmp_path / "home" / "packages"
    monkeypatch.setattr(dependencies, "packages_folder", lambda: folder)
    monkeypatch.setattr(package_folder, "packages_folder", lambda: folder)
    monkeypatch.setitem(package_versions.REQUIRED, "grafting", "grafting")
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield folder
    sys.modules.pop("grafting", None)
    importlib.invalidate_caches()


@pytest.fixture
def wheels(tmp_path):
    """A folder of wheels with `grafting`, which needs `rootstock` and a NumPy."""
    folder = tmp_path / "wheels"
    make_wheel(folder, "grafting", code="import rootstock\nYEAR = 1898\n", needs=("rootstock", "numpy"))
    make_wheel(folder, "rootstock")
    make_wheel(folder, "numpy", version="99.0", code="__version__ = '99.0'\n")
    return folder


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def test_an_install_is_importable_at_once_and_after_a_restart(home, wheels):
    assert dependencies.find_missing_packages() == ["grafting"]
    assert dependencies.install_missing(wheels) == ["grafting"]
    assert dependencies.find_missing_packages() == []
    assert importlib.import_module("grafting").YEAR == 1898
    sys.path[:] = [path for path in sys.path if str(home) not in path]
    package_folder.use_packages()
    assert dependencies.find_missing_packages() == []
    package_folder.forget_packages()
    assert not [path for path in sys.path if str(home) in path]


def test_the_thread_that_installs_asks_blender_nothing(home, wheels, monkeypatch):
    install = dependencies.prepare_install(wheels)
    for module in (dependencies, package_folder):
        monkeypatch.setattr(module, "bpy", None)
        monkeypatch.setattr(module, "packages_folder", lambda: pytest.fail("asked"))
    monkeypatch.setattr(dependencies, "is_online", lambda: pytest.fail("asked"))
    assert install(dependencies.silent) == ["grafting"]
    assert dependencies.find_missing_packages() == []


def test_blenders_numpy_is_never_installed_though_a_wheel_of_another_one_is_at_hand(home, wheels):
    dependencies.install_missing(wheels)
    (install,) = home.iterdir()
    assert names(install) == ["grafting-1.0.dist-info", "grafting.py", "rootstock-1.0.dist-info", "rootstock.py"]


def test_a_package_that_wants_another_numpy_is_refused(home, tmp_path):
    folder = tmp_path / "wheels"
    make_wheel(folder, "grafting", needs=("numpy>=99",))
    make_wheel(folder, "numpy", version="99.0")
    with pytest.raises(package_install.InstallError, match="pip cannot find the packages"):
        dependencies.install_missing(folder)
    assert names(home) == []


def test_what_blender_has_is_not_installed_again(home, tmp_path):
    folder = tmp_path / "wheels"
    make_wheel(folder, "grafting", needs=("pytest", "pluggy>=99"))
    make_wheel(folder, "pytest", version="99.0")
    make_wheel(folder, "pluggy", version="99.0")
    dependencies.install_missing(folder)
    (install,) = home.iterdir()
    assert names(install) == ["grafting-1.0.dist-info", "grafting.py"]


def test_a_package_that_cannot_be_imported_is_not_installed(home, tmp_path):
    make_wheel(tmp_path / "wheels", "grafting", code="raise ImportError('no such library: libgraft.so')\n")
    with pytest.raises(package_install.InstallError, match=r"do not work here .*libgraft\.so"):
        dependencies.install_missing(tmp_path / "wheels")
    assert names(home) == []


def test_a_numba_that_cannot_compile_is_not_installed(home, wheels, tmp_path, monkeypatch):
    broken = tmp_path / "broken" / "site-packages"
    broken.mkdir(parents=True)
    (broken / "numba.py").write_text("def njit(function): raise ImportError('this is cffi 2 and its half is 1')\n")
    monkeypatch.setattr(sys, "path", [str(broken), *sys.path])
    with pytest.raises(package_install.InstallError, match=r"do not work here .*its half is 1"):
        package_install.install_packages(["grafting", "numba"], home, wheels=wheels)
    assert names(home) == []


@pytest.mark.parametrize(("carried", "fixed"), [(set(), True), ({"cffi"}, False)])
def test_cffi_fits_the_binary_half_of_it_that_a_distribution_has_alone(carried, fixed, home, wheels, monkeypatch):
    asked = []

    def pip(self, arguments, *_):
        asked.append(Path(arguments[arguments.index("--constraint") + 1]).read_text().splitlines())
        return "enough"

    monkeypatch.setattr(package_install, "_list_carried", lambda: carried)
    monkeypatch.setattr(package_install._Install, "_run_pip", pip)
    for source in (wheels, None):
        with pytest.raises(package_install.InstallError, match="enough"):
            package_install.install_packages(["grafting"], home, wheels=source)
    half = f"cffi=={importlib.import_module('_cffi_backend').__version__}"
    assert [half in lines for lines in asked] == [fixed, fixed]
    assert [sum(line.startswith("cffi==") for line in lines) for lines in asked] == [fixed, fixed]


def test_a_missing_wheel_is_named_and_nothing_is_changed(home, tmp_path):
    make_wheel(tmp_path / "wheels", "grafting", needs=("rootstock",))
    with pytest.raises(package_install.InstallError, match=r"rootstock.*put the wheels that are missing into"):
        dependencies.install_missing(tmp_path / "wheels")
    assert names(home) == []


def test_a_server_that_does_not_answer_is_the_reason_not_what_pip_concludes_from_it():
    retry = "WARNING: Retrying (Retry(total=0, connect=None)) after connection broken by 'NewConnectionError()': "
    text = f"{retry}/whl/cpu/torch/\nERROR: Cannot install torch because these package versions conflict.\n"
    assert package_install._Lines(1, text).last == "no server replies to /whl/cpu/torch/"
    assert package_install._Lines(1, text.splitlines()[1]).last.startswith("Cannot install torch")


def test_a_folder_that_is_not_there_is_named(home, tmp_path):
    with pytest.raises(package_install.InstallError, match="is not a folder"):
        dependencies.install_missing(tmp_path / "nowhere")


def test_cancel_leaves_nothing_behind(home, wheels):
    def cancel(fraction, message):
        if message.startswith("trying"):
            raise Cancelled

    with pytest.raises(Cancelled):
        dependencies.install_missing(wheels, cancel)
    assert names(home) == []


def test_a_half_finished_install_is_ignored_and_does_not_hinder_the_next(home, wheels):
    half = home / f"{sys.implementation.cache_tag}-1-123{package_folder.UNFINISHED}" / "packages"
    half.mkdir(parents=True)
    (half / "grafting.py").write_text("raise SystemError('half a file')\n")
    package_folder.use_packages()
    assert dependencies.find_missing_packages() == ["grafting"]
    dependencies.install_missing(wheels)
    assert importlib.import_module("grafting").YEAR == 1898


def test_an_install_for_another_python_is_not_used(home):
    (home / "cpython-27-1").mkdir(parents=True)
    (home / "cpython-27-1" / "grafting.py").write_text("")
    package_folder.use_packages()
    assert dependencies.find_missing_packages() == ["grafting"]


def test_a_second_install_keeps_the_first(home, wheels, tmp_path, monkeypatch):
    dependencies.install_missing(wheels)
    monkeypatch.setitem(package_versions.REQUIRED, "pruning", "pruning")
    make_wheel(tmp_path / "more", "pruning", needs=("grafting",))
    dependencies.install_missing(tmp_path / "more")
    tag = sys.implementation.cache_tag
    assert names(home) == [f"{tag}-1", f"{tag}-2"]
    assert names(home / f"{tag}-2") == ["pruning-1.0.dist-info", "pruning.py"]
    assert dependencies.find_missing_packages() == []


def test_nothing_is_downloaded_without_consent_to_go_online(extension, home, monkeypatch):
    monkeypatch.setattr(dependencies, "is_online", lambda: False)
    monkeypatch.setattr(dependencies, "install_packages", lambda *_, **__: pytest.fail("installed"))
    with pytest.raises(
        package_install.InstallError, match=r"Online access is disabled.*Allow Online Access.*--online-mode"
    ):
        dependencies.install_missing()
    with pytest.raises(RuntimeError, match="Online access is disabled"):
        bpy.ops.fruitlangs.install_dependencies()
    assert "Online access is disabled" in bpy.context.scene.fruitlangs.error


def test_the_dialog_says_in_words_why_an_install_cannot_start(extension, home, monkeypatch):
    monkeypatch.setattr(dependencies, "is_online", lambda: False)
    with pytest.raises(RuntimeError) as raised:
        bpy.ops.fruitlangs.confirm_install()
    assert str(raised.value).strip() == f"Error: {dependencies.OFFLINE}"


def test_the_operator_installs_from_a_folder_without_going_online(extension, home, wheels, capfd):
    assert bpy.ops.fruitlangs.install_dependencies(wheels=str(wheels)) == {"FINISHED"}
    assert dependencies.find_missing_packages() == []
    assert "trying what was installed" in capfd.readouterr().out
    assert bpy.ops.fruitlangs.install_dependencies() == {"FINISHED"}


def test_pip_is_never_asked_for_the_build_that_brings_gigabytes(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    assert package_versions.versions_for("1.26.4", "linux")["torch"].endswith("+cpu")
    sources = package_install._list_sources(["torch"], None, False)
    assert sources == [[], ["--extra-index-url", package_versions.CPU_INDEX]]
    assert package_install._list_sources(["scipy"], None, False) == [[]]


def test_pytorch_for_nvidia_cards_comes_from_where_it_is_on_each_system(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    assert package_install._list_sources(["torch"], None, True) == [[]]
    monkeypatch.setattr(sys, "platform", "win32")
    assert package_install._list_sources(["torch"], None, True) == [["--extra-index-url", package_versions.CUDA_INDEX]]
    monkeypatch.setattr(sys, "platform", "darwin")
    with pytest.raises(package_install.InstallError, match="only on Linux and Windows"):
        dependencies.prepare_install(cuda=True)


@pytest.fixture
def cuda_wheels(tmp_path, monkeypatch):
    """A folder with wheels of a PyTorch for NVIDIA cards and one of its libraries."""
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setitem(package_versions.CUDA_GIGABYTES, "linux", (0.001, 0.001))
    folder = tmp_path / "cuda"
    code = "import cublas, types\nversion = types.SimpleNamespace(cuda='13.0')\n"
    make_wheel(folder, "torch", version="2.13.0", code=code, needs=("cublas", "numpy", "safetensors"))
    make_wheel(folder, "cublas")
    return folder


def test_pytorch_for_nvidia_cards_goes_before_the_one_that_is_there(home, cuda_wheels):
    before = list(sys.path)
    assert not dependencies.has_cuda_torch()
    dependencies.prepare_install(cuda_wheels, cuda=True)(dependencies.silent)
    install = home / f"{sys.implementation.cache_tag}-cuda-1"
    assert names(install) == [
        "cublas-1.0.dist-info", "cublas.py", "torch-2.13.0.dist-info", "torch.py",
    ]  # fmt: skip
    assert sys.path == [str(install), *before]
    assert dependencies.has_cuda_torch()
    package_folder.forget_packages()
    assert sys.path == before


def test_a_cpu_build_is_not_taken_for_pytorch_for_nvidia_cards(home, cuda_wheels, tmp_path):
    make_wheel(tmp_path / "cpu", "torch", version="2.13.0+cpu", needs=("numpy",))
    with pytest.raises(package_install.InstallError, match="put the wheels that are missing into"):
        dependencies.prepare_install(tmp_path / "cpu", cuda=True)(dependencies.silent)
    code = "class version:\n    cuda = None\n"
    make_wheel(tmp_path / "other", "torch", version="2.13.0", code=code, needs=("numpy",))
    with pytest.raises(package_install.InstallError, match="this is the CPU build of PyTorch"):
        dependencies.prepare_install(tmp_path / "other", cuda=True)(dependencies.silent)
    assert names(home) == []


def test_too_little_disk_space_is_told_before_anything_is_unpacked(home, cuda_wheels, monkeypatch):
    monkeypatch.setitem(package_versions.CUDA_GIGABYTES, "linux", (1e6, 1e6))
    with pytest.raises(package_install.InstallError, match=r"GB of free disk space; this needs about 1000000\.0 GB"):
        dependencies.prepare_install(cuda_wheels, cuda=True)(dependencies.silent)
    assert names(home) == []


def test_the_versions_are_those_that_are_tested():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    tested = dict(line.split("==") for line in lines if "==" in line)
    tested = {package_install._normalise(name): version for name, version in tested.items()}
    assert {name: tested.get(name, version) for name, version in package_versions.VERSIONS.items()} == (
        package_versions.VERSIONS
    )
    assert set(package_versions.REQUIRED.values()) <= set(package_versions.VERSIONS)
    assert not set(package_versions.NEVER) & set(package_versions.VERSIONS)


def test_scipy_fits_the_numpy_of_each_blender():
    versions = {one.name: package_versions.versions_for(one.numpy, "linux")["scipy"] for one in package_versions.SERIES}
    assert versions == {"4.2": "1.15.3", "4.5": "1.17.1", "5.1": "1.17.1"}


def test_the_script_says_what_is_missing_and_installs_only_on_request(tmp_path, wheels):
    program = tmp_path / "program.py"
    program.write_text(
        "import runpy, sys\n"
        f"sys.path.insert(0, {str(ROOT / 'scripts')!r})\n"
        "import _checkout\n"
        "from pathlib import Path\n"
        "from fruitlangs.operators import package_folder\n"
        "from fruitlangs.operators.packages import dependencies, package_versions\n"
        f"folder = Path({str(tmp_path / 'home')!r})\n"
        "dependencies.packages_folder = package_folder.packages_folder = lambda: folder\n"
        "package_versions.REQUIRED['grafting'] = 'grafting'\n"
        f"runpy.run_path({str(ROOT / 'scripts' / 'install_dependencies.py')!r}, run_name='__main__')\n"
    )

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        blender = [bpy.app.binary_path, "-b", "--factory-startup", "--python-exit-code", "3", "-P"]
        command = blender if bpy.app.binary_path else [sys.executable]
        command += [str(program), "--", *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=120)

    told = run("--wheels", str(wheels))
    assert (told.returncode, "Missing: grafting" in told.stdout) == (2, True)
    assert not (tmp_path / "home").exists()
    offline = run("--yes")
    assert (offline.returncode, "error: Online access is disabled" in offline.stderr) == (1, True)
    done = run("--yes", "--wheels", str(wheels))
    assert (done.returncode, "\nInstalled" in done.stdout) == (0, True), done.stdout + done.stderr
    assert (tmp_path / "home" / f"{sys.implementation.cache_tag}-1" / "grafting.py").is_file()


class Layout:
    """A layout that keeps what was drawn into it, with icons that this Blender knows."""

    ICONS = set(bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items.keys())

    def __init__(self):
        self.drawn = []

    def __getattr__(self, kind):
        def draw(*given, **named):
            assert named.get("icon", "NONE") in self.ICONS
            self.drawn.append(named.get("text") or (given[-1] if given else ""))
            return self

        return draw


def drawn_preferences() -> list[str]:
    from fruitlangs.fruitlangs_addon.preferences import FRUITLANGS_AP_preferences

    context = SimpleNamespace(
        region=SimpleNamespace(width=800),
        preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)),
        scene=bpy.context.scene,
    )
    panel = SimpleNamespace(layout=Layout())
    FRUITLANGS_AP_preferences.draw(panel, context)
    return panel.layout.drawn


def test_preferences_name_what_is_missing_and_offer_to_install_it(extension, home):
    drawn = drawn_preferences()
    assert "Python packages are missing" in drawn
    assert "grafting" in drawn
    assert "Install…" in drawn


def test_preferences_say_what_computes_and_whether_blender_may_go_online(extension, monkeypatch):
    from fruitlangs.fruitlangs_addon import preferences

    monkeypatch.setattr(preferences, "is_online", lambda: False)
    drawn = drawn_preferences()
    assert [line for line in drawn if line.startswith("Computes on the CPU with")]
    assert "Offline: online access is disabled in Preferences > System" in drawn
    assert "Clear Caches…" in drawn
    monkeypatch.setattr(preferences, "is_online", lambda: True)
    assert "Online: downloads packages and checkpoints when you ask for them" in drawn_preferences()


def test_preferences_offer_pytorch_for_nvidia_cards_where_there_is_one(extension, monkeypatch):
    from fruitlangs.fruitlangs_addon import preferences

    button = "Install PyTorch for NVIDIA Cards…"
    assert button not in drawn_preferences()
    monkeypatch.setattr(preferences, "describe_device", lambda _: "Trains on NVIDIA GeForce RTX 3060 (Vulkan)")
    assert button in drawn_preferences()
    monkeypatch.setattr(dependencies, "has_cuda_torch", lambda: True)
    assert button not in drawn_preferences()


def test_preferred_checkpoints_stand_where_the_scene_left_the_default(extension, monkeypatch, tmp_path):
    from fruitlangs.operators.settings import preference_values
    from fruitlangs.operators.settings.settings import read_config

    chosen = SimpleNamespace(clip=str(tmp_path), sam="")
    monkeypatch.setattr(preference_values, "preferences", lambda: chosen)
    settings = bpy.context.scene.fruitlangs
    embed = read_config(settings).embed
    assert (embed.clip, embed.sam) == (str(tmp_path), "facebook/sam-vit-huge")
    settings.config.embed.clip = "another/checkpoint"
    assert read_config(settings).embed.clip == "another/checkpoint"


def test_clearing_deletes_what_was_chosen_and_nothing_next_to_it(extension, monkeypatch, tmp_path):
    kernels, checkpoints = tmp_path / "cache", tmp_path / "checkpoints"
    for folder in (kernels / "kernels-0123", kernels / "someone-elses", checkpoints / "openai" / "clip"):
        folder.mkdir(parents=True)
        (folder / "file").write_bytes(bytes(1000))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(kernels))
    monkeypatch.setenv("FRUITLANGS_CHECKPOINTS", str(checkpoints))
    bpy.ops.fruitlangs.clear_caches()
    assert names(kernels) == ["someone-elses"]
    assert names(checkpoints) == ["openai"]
    bpy.ops.fruitlangs.clear_caches(kernels=False, checkpoints=True)
    assert names(checkpoints) == []
    assert names(kernels) == ["someone-elses"]


def test_clearing_the_work_on_a_scene_leaves_its_results_and_what_is_not_a_stage(extension, tmp_path):
    result = tmp_path / "tree_fruit"
    for name in ("train-0123", "embed-4567", "mine"):
        (result / "cache" / name).mkdir(parents=True)
        (result / "cache" / name / "file").write_bytes(bytes(1000))
    (result / "fruits.json").touch()
    assert caches.find_work_folder(bpy.context.scene) is None
    bpy.context.scene.fruitlangs.source = str(tmp_path / "tree")
    assert caches.find_work_folder(bpy.context.scene) == result / "cache"
    bpy.ops.fruitlangs.clear_caches(kernels=False)
    assert names(result / "cache") == ["embed-4567", "mine", "train-0123"]
    bpy.ops.fruitlangs.clear_caches(kernels=False, work=True)
    assert names(result / "cache") == ["mine"]
    assert names(result) == ["cache", "fruits.json"]


def test_nothing_is_cleared_while_a_job_that_began_meanwhile_is_at_work(extension, monkeypatch, tmp_path):
    stage = tmp_path / "tree_fruit" / "cache" / "train-0123"
    stage.mkdir(parents=True)
    bpy.context.scene.fruitlangs.source = str(tmp_path / "tree")
    monkeypatch.setattr(caches, "is_busy", lambda _: True)
    told = []
    chosen = SimpleNamespace(kernels=False, checkpoints=False, work=True, report=lambda kind, text: told.append(text))
    assert caches.FRUITLANGS_OT_clear_caches.execute(chosen, bpy.context) == {"CANCELLED"}
    assert told == ["A job is running. Wait for it or cancel it first"]
    assert stage.is_dir()


def test_the_tested_numpy_is_the_one_that_runs(home, wheels, monkeypatch):
    monkeypatch.setattr(np, "__version__", "1.0")
    monkeypatch.setattr(package_install._Install, "resolve", lambda _: {"grafting": "1.0", "rootstock": "1.0"})
    with pytest.raises(package_install.InstallError, match="another NumPy"):
        dependencies.install_missing(wheels)

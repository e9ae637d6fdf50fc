"""Compiled kernels work wherever the user's cache is, and from several Python threads at once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = f"""
import sys
sys.path.insert(0, {str(ROOT / "scripts")!r})
import _checkout
import threading
import numpy as np
from fruitlangs.engine.compiled import jit as compiled

def add(values):
    for k in compiled.prange(len(values)):
        values[k] += 1.0
"""
CALL = """
run = compiled.kernel(add)
values = np.zeros(1000)
run(values)
print(compiled.CACHE_FOLDER, values.sum())
"""
FROM_THREADS = """
run = compiled.kernel(add)
arrays = [np.zeros(20_000) for _ in range(4)]
def work(values):
    for _ in range(200):
        run(values)
threads = [threading.Thread(target=work, args=(values,)) for values in arrays]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print(all((values == 200).all() for values in arrays))
"""


TRAINING = """
import hashlib
from pathlib import Path
from fruitlangs.engine.config import SceneConfig, TrainConfig
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.splatting.training.train import train
example = Path(compiled.__file__).parents[2] / "examples" / "orchard_tree"
gaussians = train(read_scene(example, SceneConfig(downscale=4)), TrainConfig(steps=25)).gaussians
print(hashlib.sha256(gaussians.means.numpy().tobytes()).hexdigest())
"""
AHEAD = """
from fruitlangs.engine import compile_ahead
compile_ahead.compile_all()
print(compiled.is_all_compiled())
"""
FIRST_COUNT = """
from numba.core import event
from pathlib import Path
from fruitlangs.engine.config import Config, CountConfig, TrainConfig
from fruitlangs.engine.pipeline import count_scene
names = []
class Listener(event.Listener):
    def on_start(self, started): names.append(started.data["dispatcher"].py_func.__qualname__)
    def on_end(self, ended): pass
event.register("numba:compile", Listener())
config = Config(train=TrainConfig(steps=150, max_gaussians=3000), count=CountConfig(threshold=0.3))
assert count_scene(Path({scene!r}), ["apple"], Path({out!r}), config=config).fruit_count.count == 5
print(names)
"""


AS_EXTENSION = f"""
import importlib, importlib.util, sys, types
from pathlib import Path
from tempfile import TemporaryDirectory
name = "bl_ext.user_default.fruitlangs"  # as Blender calls it
for parent in ("bl_ext", "bl_ext.user_default"):
    sys.modules[parent] = types.ModuleType(parent)
root = {str(ROOT)!r}
spec = importlib.util.spec_from_file_location(name, root + "/__init__.py", submodule_search_locations=[root])
sys.modules[name] = importlib.util.module_from_spec(spec)
print(importlib.import_module(name + ".engine.compiled.jit").CACHE_FOLDER)
child = importlib.import_module(name + ".engine.child_process")
with TemporaryDirectory() as folder:
    try:
        child.run_child("progress", [], Path(folder) / "log.txt")  # a module that has no main
    except child.ChildError as error:
        print(error)
"""


def python(folder: Path, program: str, **environment: str) -> str:
    """What a program that declares a kernel prints."""
    (folder / "program.py").write_text(PROGRAM + program)
    kept = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    done = subprocess.run(
        [sys.executable, str(folder / "program.py")],
        env=kept | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_machine_code_goes_to_a_folder_named_after_the_sources(tmp_path: Path) -> None:
    folder, _ = python(tmp_path, CALL, XDG_CACHE_HOME=str(tmp_path), LOCALAPPDATA=str(tmp_path)).rsplit(" ", 1)
    if sys.platform != "darwin":
        assert Path(folder).parent == tmp_path / "fruitlangs"
    assert Path(folder).name.startswith("kernels-")


def test_a_child_has_the_name_of_its_parents_package_and_each_name_has_machine_code_of_its_own(tmp_path: Path) -> None:
    """Numba's cache holds names of modules: code that another name left cannot be loaded."""
    own = python(tmp_path, "print(compiled.CACHE_FOLDER)", NUMBA_CACHE_DIR=str(tmp_path))
    folder, error = python(tmp_path, AS_EXTENSION, NUMBA_CACHE_DIR=str(tmp_path)).splitlines()
    assert folder != own
    assert "module 'bl_ext.user_default.fruitlangs.engine.progress' has no attribute 'main'" in error


def test_a_cache_is_complete_only_when_it_was_marked(tmp_path: Path) -> None:
    ask = "print(compiled.is_all_compiled())"
    assert python(tmp_path, ask + CALL, NUMBA_CACHE_DIR=str(tmp_path)).startswith("False")
    assert python(tmp_path, "compiled.mark_compiled()\n" + ask, NUMBA_CACHE_DIR=str(tmp_path)) == "True"


def test_a_cache_is_not_complete_for_the_same_version_in_another_folder(tmp_path: Path) -> None:
    code = "compiled.mark_compiled()\ncompiled._ENGINE = compiled._ENGINE / 'moved'\nprint(compiled.is_all_compiled())"
    assert python(tmp_path, code, NUMBA_CACHE_DIR=str(tmp_path)) == "False"


def test_what_is_compiled_ahead_is_all_that_a_first_count_needs(tmp_path: Path, balls: Path) -> None:
    assert python(tmp_path, AHEAD, NUMBA_CACHE_DIR=str(tmp_path)).endswith("True")
    program = FIRST_COUNT.format(scene=str(balls), out=str(tmp_path / "out"))
    assert python(tmp_path, program, NUMBA_CACHE_DIR=str(tmp_path)) == "[]"


def test_without_a_writable_cache_kernels_still_run(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert python(tmp_path, CALL, NUMBA_CACHE_DIR=str(tmp_path / "file")) == "None 1000.0"


@pytest.mark.parametrize("layer", ["default", "workqueue"])
def test_kernels_may_be_called_from_several_threads(tmp_path: Path, layer: str) -> None:
    assert python(tmp_path, FROM_THREADS, NUMBA_THREADING_LAYER=layer, NUMBA_NUM_THREADS="2") == "True"


def test_a_function_without_a_file_is_compiled_without_cache(tmp_path: Path) -> None:
    assert python(tmp_path, "f = eval('lambda x: x + 1')\nprint(compiled.njit(f)(1))") == "2"


def test_other_users_of_numba_keep_their_cache_folder(tmp_path: Path) -> None:
    program = "import numba\nbefore = numba.config.CACHE_DIR\ncompiled.njit(lambda x: x)\n"
    assert python(tmp_path, program + "print(numba.config.CACHE_DIR == before)") == "True"


def test_the_run_that_compiles_trains_to_the_same_bytes_as_later_ones(tmp_path: Path) -> None:
    first, later = (python(tmp_path, TRAINING, NUMBA_CACHE_DIR=str(tmp_path / "kernels")) for _ in range(2))
    assert first == later

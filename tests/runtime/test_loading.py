# SPDX-License-Identifier: Apache-2.0
import json
import os
import subprocess
import sys
from itertools import pairwise

from ggwarp.runtime import loading

_COLD_AND_WARM = """
from ggwarp.kernels.optim import compact
from ggwarp.runtime import loading
loading.init_quietly()
modules = loading.imported_kernel_modules("cpu")
print(*(m.name for m in modules))
print(len(loading.uncompiled(modules, "cpu")))
loading.load(modules, "cpu")
print(len(loading.uncompiled(modules, "cpu")))
"""


def _run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **environment},
    )


def test_an_empty_cache_is_noticed_and_filled(tmp_path):
    names, before, after = _run(_COLD_AND_WARM, WARP_CACHE_PATH=str(tmp_path)).stdout.splitlines()
    assert "ggwarp.kernels.optim.compact" in names.split()
    assert "ggwarp.kernels.registration.gicp" not in names.split()  # nothing has imported it
    assert (int(before), int(after)) == (len(names.split()), 0)
    assert _run(_COLD_AND_WARM, WARP_CACHE_PATH=str(tmp_path)).stdout.splitlines()[1] == "0"


_INTERRUPTED = """
import os, signal, time
from ggwarp.runtime import loading
begun = []
def slow(module, device):
    begun.append(module)
    if len(begun) == 2:
        os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.5)
loading._load_one = slow
loading.uncompiled = lambda modules, device: []
os.cpu_count = lambda: 2
try:
    loading.load(list(range(50)), "cpu")
except KeyboardInterrupt:
    print(len(begun))
"""


_IN_ORDER = """
import json, time
from types import SimpleNamespace
from ggwarp.runtime import loading
from threading import current_thread
taken = {}
def note(module, device):
    taken.setdefault(current_thread().ident, []).append(module.options["optimization_level"])
    time.sleep(0.05)
loading._load_one = note
loading.uncompiled = lambda modules, device: modules
loading._remove_damaged = lambda modules, block_dim: None
loading.os.cpu_count = lambda: 2
levels = [3, None] * 6
loading.load([SimpleNamespace(options={"optimization_level": k}) for k in levels], "cpu")
print(json.dumps(list(taken.values())))
"""


def test_threads_keep_to_modules_of_the_same_options():
    first, second = json.loads(_run(_IN_ORDER).stdout.splitlines()[-1])
    assert len(first) + len(second) == 12
    changes = [sum(a != b for a, b in pairwise(of)) for of in (first, second)]
    assert first[0] != second[0] and max(changes) <= 1


def test_an_interrupted_loading_begins_no_more_modules():
    assert json.loads(_run(_INTERRUPTED).stdout) == 2


def test_warp_starts_without_a_word():
    done = _run("from ggwarp.runtime import loading; loading.init_quietly()")
    assert done.stdout == "" and done.stderr == ""


def test_what_warp_says_otherwise_is_passed_on(monkeypatch, capfd):
    def complain():
        os.write(2, b"Could not find or load the NVIDIA CUDA driver.\nsomething else\n")

    loading.init_quietly()
    monkeypatch.setattr(loading.wp, "init", complain)
    loading.init_quietly()
    assert capfd.readouterr().err == "something else\n"


def test_every_device_loads_its_own_form():
    every = {m.name for m in loading.all_kernel_modules()}
    on_cpu = {m.name for m in loading.imported_kernel_modules("cpu")}
    assert every - on_cpu == {
        f"ggwarp.kernels.{name}" for name, device in loading.ONE_DEVICE.items() if device == "cuda"
    }
    assert {f"ggwarp.kernels.{name}" for name in loading.ONE_DEVICE} <= every


def test_nothing_to_load(device):
    loading.load([], device)
    assert loading.uncompiled([], device) == []

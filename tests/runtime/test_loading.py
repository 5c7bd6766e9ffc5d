# SPDX-License-Identifier: Apache-2.0
import json
import os
import subprocess
import sys

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
    print(begun)
"""


def test_an_interrupted_loading_begins_no_more_modules():
    assert len(json.loads(_run(_INTERRUPTED).stdout)) == 2


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

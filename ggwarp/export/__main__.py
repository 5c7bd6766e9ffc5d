# SPDX-License-Identifier: Apache-2.0
"""Write a run's map, or some of its objects, as a file that other programs open.

ggwarp export runs/latest --to ply
ggwarp export runs/latest --to glb --objects stool vase
ggwarp export runs/latest --to spz,usd,mesh --out exported
"""

from __future__ import annotations

import argparse
import difflib
import sys
from pathlib import Path
from typing import NoReturn

from ggwarp.export.formats import FORMATS
from ggwarp.export.options import ExportOptions
from ggwarp.export.scene import prepare
from ggwarp.geometry.upright import CONVENTIONS
from ggwarp.io.printable import printable
from ggwarp.results.saved_run import RunError, load_run
from ggwarp.results.scene_view import joined_up, parse_up

FAILED, USER_ERROR = 1, 2


class _Parser(argparse.ArgumentParser):
    """Raises where argparse would print its usage and exit."""

    def error(self, message: str) -> NoReturn:
        raise RunError(f"{message} (--help says more)")


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code: 1 where a file cannot be written, 2 for a user's mistake."""
    try:
        given = sys.argv[1:] if arguments is None else arguments
        return _export(_parser().parse_args(joined_up(given)))
    except (RunError, ValueError) as error:
        print(f"ggwarp: {printable(str(error))}", file=sys.stderr)
        return USER_ERROR
    except OSError as error:
        print(f"ggwarp: {printable(f'{error.filename}: {error.strerror}')}", file=sys.stderr)
        return FAILED


def _parser() -> argparse.ArgumentParser:
    rows = "\n".join(f"  {name:15}{form.about}" for name, form in FORMATS.items())
    parser = _Parser(
        prog="ggwarp export",
        description=__doc__,
        epilog=f"formats:\n{rows}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("run", type=Path, help="a run folder, such as runs/latest")
    parser.add_argument(
        "--to", required=True, metavar="FORMAT", help="one, or several joined by commas; see below"
    )
    parser.add_argument(
        "--objects",
        nargs="+",
        default=[],
        metavar="ID",
        help="these alone, by id, label or class (default: all)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="the file or folder to write; of several formats, the folder (default: RUN/export)",
    )
    parser.add_argument(
        "--up",
        default="auto",
        metavar="AXIS",
        help="what is up in the run's world: z, -y, ..., or three numbers (default: auto, by view.json)",
    )
    parser.add_argument(
        "--axes",
        choices=["auto", "world", *CONVENTIONS],
        default="auto",
        help="axes of the file (default: those that its format is opened with; world: the run's own)",
    )
    parser.add_argument("--device", help="cpu or cuda:N, to render on (default: CUDA if there is one)")
    parser.add_argument(
        "--sh-degree", type=int, choices=range(4), default=0, help="pad ply with zeros up to it"
    )
    parser.add_argument(
        "--voxel", type=float, metavar="M", help="of meshes, metres (default: by the map's size)"
    )
    parser.add_argument(
        "--every", type=int, default=1, metavar="N", help="of folders of frames and meshes: every Nth"
    )
    parser.add_argument("--rendered", action="store_true", help="folders of frames hold the map's pictures")
    return parser


def _export(args: argparse.Namespace) -> int:
    names = list(dict.fromkeys(args.to.split(",")))
    for name in names:
        if name not in FORMATS:
            close = difflib.get_close_matches(name, FORMATS, n=1)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(FORMATS)}"
            raise RunError(f"--to {name}: no such format; {hint}")
        FORMATS[name].check()
    if args.every < 1:
        raise RunError(f"--every {args.every}: give 1 or more")
    run = load_run(args.run)
    up = parse_up(args.up)
    targets = {name: _target(args, name, len(names)) for name in names}
    for path in targets.values():
        if path.exists():
            raise RunError(f"{path}: exists already, and nothing is overwritten; choose another --out")
    options = ExportOptions(args.device, args.sh_degree, args.voxel, args.every, args.rendered)
    for name, path in targets.items():
        convention = FORMATS[name].convention if args.axes == "auto" else args.axes
        scene = prepare(run, names=args.objects, convention=convention, up=up)
        path.parent.mkdir(parents=True, exist_ok=True)
        FORMATS[name].write(scene, path, options)
        print(printable(f"{path}  ({_size(path)}, {convention})"), flush=True)
    return 0


def _target(args: argparse.Namespace, name: str, count: int) -> Path:
    """Return the path to write."""
    if args.out is not None and count == 1 and not (args.out.is_dir() and FORMATS[name].ending):
        return args.out
    folder = args.out or args.run / "export"
    stem = "-".join(args.objects).replace("/", "_").replace(" ", "_") or "map"
    ending = FORMATS[name].ending
    return folder / (stem + ending if ending else name)


def _size(path: Path) -> str:
    if path.is_dir():
        return f"{sum(1 for p in path.rglob('*') if p.is_file())} files"
    return f"{path.stat().st_size / 1e6:.2f} MB"


if __name__ == "__main__":
    sys.exit(main())

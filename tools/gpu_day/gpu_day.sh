#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# A GPU day of ggwarp: what to run on an H100 or H200 that is had for a quarter of an hour, most valuable first.
#
# Each step is a process of its own with a time limit of its own: a crash, a hang or a poisoned CUDA context in
# one does not lose the rest. All output goes to $OUT/log.txt (and what a step writes as JSON beside it); a line a
# step is printed, the table last. Run it in the repository's root.
#
#   gpu_day.sh prepare          on a machine with a network, without a GPU, 8 minutes (2 after the first time); run it again
#                               after any change of a kernel. Makes git-ignored folders of what must travel, for the places where no
#                               more than 64 MiB travel at once in two goes (it says how large they are, the tree included):
#                                 .gpu/first/   the first 40 MiB of Warp without its CPU compiler (pack_warp.sh)
#                                 .gpu/second/  the rest of it, 19 MiB
#                                 .gpu/extras/  extras.tar.xz, 2.7 MiB: cubins for sm_90 (ours and gswarp's: no kernel is compiled
#                                               there), tyro typeguard docstring_parser simplejpeg, gswarp, gsplat's trimmed
#                                               sources, results of the CPU to compare with
#                                 .gpu/gtsam/   gtsam.tar.xz, 10 MiB: for loops and one camera's map
#                                 .gpu/clang/   clang.tar.xz, 17 MiB: Warp's CPU compiler
#                               Recordings in .gpu/data/, each a folder that --seq reads, are run by bench where they travel, too.
#   gpu_day.sh first            on the GPU machine, with .gpu/first: keeps it
#   gpu_day.sh checks           on the GPU machine: are the results right?   1-3 minutes, side by side on its cores
#   gpu_day.sh profile          on the GPU machine: where does it go?        2 minutes; what checks needs .gpu/clang for, too
#   gpu_day.sh bench            on the GPU machine: how fast?                2-3 minutes
#   gpu_day.sh deep             on the GPU machine: compute-sanitizer, ncu   2-3 minutes
#
# A later call on the same machine finds everything unpacked. Limits that fit 15 minutes with the start:
# checks 330 s, bench 300 s, deep 200 s. If checks shows wrong results, mend first, do not bench.
#
# CPU kernels run there only with .gpu/clang (tests that render their input on the CPU, doctor --gpu); the rest does
# without: the office is rendered on the GPU into files first, and references were made beforehand.
set -uo pipefail
what=${1:?prepare, first, checks, profile, bench or deep}
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)

if [ "$what" = prepare ]; then
    set -e
    root=${2:-$PWD}
    python=${PYTHON:-python3}                   # a Python with ggwarp's needs and Warp
    cd "$root"
    mkdir -p .gpu/warp .gpu/extras
    [ -s .gpu/warp/warp.tar.xz ] || bash "$here/pack_warp.sh" .gpu/warp
    work=$(mktemp -d); trap 'rm -rf "$work"' EXIT
    # Binaries: only what loading looks at.
    WARP_CACHE_PATH=$work/all PYTHONPATH=$root "$python" -m ggwarp.commands.precompile --arch 90 --out "$work/all"
    mkdir -p "$work/x/site" "$work/w" "$work/g"
    "$python" -m pip download -q --no-deps -d "$work/w" tyro typeguard docstring-parser gswarp==1.1.0 gsplat==1.5.3
    there=(--no-deps --only-binary=:all: --python-version 3.12 --implementation cp --platform manylinux_2_28_x86_64)
    "$python" -m pip download -q "${there[@]}" -d "$work/w" simplejpeg
    if [ ! -s .gpu/gtsam/gtsam.tar.xz ]; then
        mkdir -p .gpu/gtsam
        "$python" -m pip download -q "${there[@]}" -d "$work/g" gtsam
        "$python" -m zipfile -e "$work"/g/gtsam-*.whl "$work/g/site"
        rm -rf "$work"/g/site/gtsam_unstable "$work"/g/site/gtsam/{tests,examples,notebooks,Data}
        tar -C "$work/g/site" -cf - . | xz -9e -T1 > .gpu/gtsam/gtsam.tar.xz
    fi
    if [ ! -s .gpu/clang/clang.tar.xz ]; then
        mkdir -p .gpu/clang
        bin=$("$python" -c 'import warp, pathlib; print(pathlib.Path(warp.__file__).parent / "bin")')
        tar -C "$bin" -cf - warp-clang.so | xz --x86 --lzma2=preset=9e,dict=128MiB -T1 > .gpu/clang/clang.tar.xz
    fi
    for wheel in "$work"/w/*.whl; do "$python" -m zipfile -e "$wheel" "$work/x/site"; done
    # gsplat: three channel counts instead of nineteen (20 channels are padded to 32), or it compiles for minutes.
    for f in "$work"/x/site/gsplat/cuda/csrc/*.cu "$work"/x/site/gsplat/cuda/csrc/*.cpp; do
        sed -i -E '/^[[:space:]]*(__INS__|__LAUNCH_KERNEL__)\(([0-9]+)\)[[:space:]]*$/{/\((3|4|32)\)/!d}' "$f"
    done
    rm -rf "$work"/x/site/gsplat/cuda/csrc/third_party/glm/{doc,test,util,.github}
    PYTHONPATH="$work/x/site:$root" WARP_CACHE_PATH=$work/all "$python" - <<'PY'
import warp as wp
wp.config.cuda_output = "cubin"
wp.init()
import gswarp._rasterizer, gswarp.rasterizer
from warp._src.context import user_modules
for name, module in list(user_modules.items()):
    if name.startswith("gswarp") and module.kernels:
        wp.compile_aot_module(module, arch=90, use_ptx=False)
PY
    for d in "$work"/all/*/*/; do
        t=$work/x/cache/$(basename "$(dirname "$d")")/$(basename "$d"); mkdir -p "$t"; cp "$d"/*.cubin "$d"/*.meta "$t"
    done
    PYTHONPATH="$root:$root/tools" "$python" -m gpu_day.check save "$work/x/reference.npz" --device cpu
    tar --sort=name --mtime=@0 --owner=0 --group=0 -C "$work/x" -cf - . | xz -9e -T1 > .gpu/extras/extras.tar.xz
    mkdir -p .gpu/first .gpu/second
    head -c $((40 << 20)) .gpu/warp/warp.tar.xz > .gpu/first/warp.tar.xz.1
    tail -c +$(((40 << 20) + 1)) .gpu/warp/warp.tar.xz > .gpu/second/warp.tar.xz.2
    tree=$(git ls-files -z --cached --others --exclude-standard | xargs -0 du -cb | tail -1 | cut -f1)
    size() { echo $(((tree + $(du -cb "$@" | tail -1 | cut -f1)) >> 10)); }
    echo "in KiB with the tree, of 65536 at once: first $(size .gpu/first); second, extras, gtsam, clang $(size .gpu/{second,extras,gtsam,clang})"
    exit
fi

# ---- on the GPU machine -------------------------------------------------------------------------------------
OUT=${OUT:-/tmp/out}; mkdir -p "$OUT"
log=$OUT/log.txt; : > "$log"
root=$PWD
base=/tmp/gpuday
table=()
step() { # NAME SECONDS COMMAND
    local name=$1 limit=$2 began=$SECONDS rc
    shift 2
    echo "===== $name" >> "$log"
    timeout -k 5 "$limit" bash -c "$*" >> "$log" 2>&1 < /dev/null; rc=$?
    local verdict=ok; [ $rc -eq 0 ] || verdict="rc $rc"; [ $rc -eq 124 ] && verdict="TIMED OUT"
    table+=("$(printf '%-22s %-10s %3d s' "$name" "$verdict" $((SECONDS - began)))")
    echo "${table[-1]}"
    return 0
}
side() { # NAME SECONDS COMMAND, beside what else runs
    local name=$1 limit=$2
    shift 2
    (
        began=$SECONDS
        timeout -k 5 "$limit" bash -c "$*" > "$base/$name.side" 2>&1 < /dev/null; rc=$?
        verdict=ok; [ $rc -eq 0 ] || verdict="rc $rc"; [ $rc -eq 124 ] && verdict="TIMED OUT"
        printf '%-22s %-10s %3d s\n' "$name" "$verdict" $((SECONDS - began)) > "$base/$name.verdict"
    ) &
    sides+=("$name")
    waited+=($!)
}
join() { # waits for what runs beside
    wait "${waited[@]}"
    local name
    for name in "${sides[@]}"; do
        { echo "===== $name"; cat "$base/$name.side"; } >> "$log"
        table+=("$(cat "$base/$name.verdict")")
        echo "${table[-1]}"
    done
    sides=() waited=()
}
sides=() waited=()
mkdir -p "$base"
for part in .gpu/first/warp.tar.xz.1 .gpu/second/warp.tar.xz.2; do
    if [ -s $part ]; then cp $part "$base"; fi
done
[ "$what" != first ] || { ls -l "$base"; exit 0; }
if [ ! -d "$base/site" ]; then
    for part in 1 2; do
        [ -s "$base/warp.tar.xz.$part" ] || { echo "part $part of Warp is not here: carry .gpu/first, then .gpu/second"; exit 1; }
    done
    rm -rf "$base/site.part" && mkdir "$base/site.part"
    cat "$base"/warp.tar.xz.[12] | tar -xJf - -C "$base/site.part" && mv "$base/site.part" "$base/site"
fi
[ -s .gpu/extras/extras.tar.xz ] || { echo "no .gpu/extras/extras.tar.xz here: carry .gpu/extras"; exit 1; }
if ! cmp -s .gpu/extras/extras.tar.xz "$base/extras.tar.xz"; then
    rm -rf "$base/x" && mkdir "$base/x" && tar -xJf .gpu/extras/extras.tar.xz -C "$base/x" && cp -r "$base"/x/site/* "$base/site/"
    cp .gpu/extras/extras.tar.xz "$base/extras.tar.xz"
    [ -n "${GSPLAT:-}" ] || rm -rf "$base/site/gsplat"  # importing it compiles it
fi
if [ -s .gpu/gtsam/gtsam.tar.xz ] && [ ! -d "$base/site/gtsam" ]; then tar -xJf .gpu/gtsam/gtsam.tar.xz -C "$base/site"; fi
clang=$base/site/warp/bin
if [ -s .gpu/clang/clang.tar.xz ] && [ ! -s "$clang/warp-clang.so" ]; then tar -xJf .gpu/clang/clang.tar.xz -C "$clang"; fi
export PYTHONPATH="$root:$root/tools:$base/site" WARP_CACHE_PATH="$base/x/cache" PYTHONUNBUFFERED=1
export PYTHONFAULTHANDLER=1 TORCH_EXTENSIONS_DIR=$base/ext GGWARP_TEST_DATA=/nowhere
check="python3 -m gpu_day.check" reference=$base/x/reference.npz
pytest="python3 -c \"import sys, warp as wp; wp.config.cuda_output = 'cubin'; import pytest; sys.exit(pytest.main(sys.argv[1:]))\" -q -p no:cacheprovider -o addopts='--import-mode=importlib' --timeout 40 --tb=short -rf"

b="python3 tools/benchmark.py"
kernels="$b kernels --device cuda:0 --size 1200x680 --gaussians 300000 --no-compile"

case $what in
checks)
    # gsplat compiles meanwhile where GSPLAT=1, for many minutes, on cores that nothing else wants.
    if [ -n "${GSPLAT:-}" ] && [ ! -e "$base/gsplat.started" ]; then
        touch "$base/gsplat.started"
        TORCH_CUDA_ARCH_LIST=9.0 MAX_JOBS=12 setsid nice -n 19 timeout 500 python3 -c 'import gsplat.cuda._backend' \
            > "$base/gsplat.log" 2>&1 < /dev/null &
    fi
    step machine 20 "nvidia-smi; python3 - <<'PY'
import warp as wp
from ggwarp.runtime import loading
loading.init_quietly()
d = wp.get_device('cuda:0')
print(d.name, 'driver', d.runtime.driver_version, 'toolkit', d.runtime.toolkit_version, 'mempool', d.is_mempool_enabled,
      'loops in graphs', wp.is_conditional_graph_supported(), d.get_cuda_output_format(), d.get_cuda_compile_arch())
modules = loading.kernel_modules('cuda:0')
print('not precompiled:', [m.name for m in loading.uncompiled(modules, 'cuda:0')])
loading.load(modules, 'cuda:0')
PY"
    step sequence 45 "python3 -m gpu_day.office_sequence 24 0.25 $base/small"
    small="python3 -m ggwarp.run --seq $base/small --device cuda:0 --save-renders 0"
    side compare 150 "$check compare $reference"
    side repeatable 60 "$check repeatable"
    side two-threads 60 "$check two-threads"
    side graphs-streams 100 "$pytest tests/runtime/test_graphs.py tests/runtime/test_streams.py tests/solvers/test_registration.py -k 'cuda:0'"
    side kernel-tests 150 "$pytest -n 4 tests/kernels tests/map tests/ops -k 'cuda:0'"
    side system-tests 150 "$pytest -n 4 tests/pipeline tests/objects tests/evaluation tests/editing -k 'cuda:0'"
    side small-run 100 "$small --out /tmp/small1"
    side small-in-turn 100 "$small --pipelined off --out /tmp/small2"
    side small-monogs 100 "$small --preset monogs --out /tmp/small3"
    side small-mono 100 "$small --mono --out /tmp/small4"
    join
    ;;
profile)
    step sequence 30 "[ -e /tmp/office/traj.txt ] || python3 -m gpu_day.office_sequence 60 1.0 /tmp/office"
    step frame-profile 45 "python3 -m gpu_day.frame_profile /tmp/office --warm 8 --frames 6"
    step kernels 40 "$kernels --rounds 6 --out $OUT/kernels.json"
    side system-tests 80 "$pytest -n 11 tests/pipeline tests/objects tests/evaluation tests/editing tests/kernels/losses -k 'cuda:0'"
    side doctor 60 "python3 -m ggwarp doctor --gpu"
    side gswarp 80 "python3 -m gpu_day.gswarp_peer 1200x680 300000"
    join
    ;;
bench)
    step kernels 75 "$kernels --rounds 12 --out $OUT/kernels.json"
    step gswarp 60 "python3 -m gpu_day.gswarp_peer 1200x680 300000"
    step sequence 45 "python3 -m gpu_day.office_sequence 60 1.0 /tmp/office"
    run="python3 -m ggwarp.run --device cuda:0 --save-renders 0"
    step run 90 "$run --seq /tmp/office --out /tmp/run1 && cp /tmp/run1/metrics.json $OUT/metrics.json && head -40 /tmp/run1/frames.csv"
    step run-fast 45 "$run --seq /tmp/office --preset fast --out /tmp/run4"
    step run-uncapped 60 "$run --seq /tmp/office --fps uncapped --out /tmp/run3"
    for recording in .gpu/data/*/; do
        [ -d "$recording" ] && step "run-$(basename "$recording")" 60 "$run --seq $recording --out /tmp/recorded"
    done
    step tracking 45 "$b tracking --device cuda:0 --seq /tmp/office --quick --out $OUT/tracking.json"
    step gsplat 75 "for i in \$(seq 60); do ls $base/ext/*/gsplat_cuda.so >/dev/null 2>&1 && break; sleep 1; done; tail -3 $base/gsplat.log; $kernels --quick --out $OUT/gsplat.json"
    ;;
deep)
    one="tests/kernels/raster/test_composite.py -k 'cuda:0 and matches_the_oracle'"
    step racecheck 80 "compute-sanitizer --tool racecheck --racecheck-report analysis $pytest $one"
    step memcheck 60 "compute-sanitizer --tool memcheck --leak-check no $check compare $reference --only render_20_sampled mapping registration"
    step initcheck 40 "compute-sanitizer --tool initcheck $check compare $reference --only render_20"
    step ncu 80 "ncu --clock-control none --set full -k 'regex:composite|blur|slopes|classes|finish|adam|project_adjoint|linearise' -c 40 --csv --page raw -o $OUT/ncu --force-overwrite python3 tools/benchmark.py kernels --device cuda:0 --size 1200x680 --gaussians 300000 --quick --no-compile --out $OUT/ncu.json"
    ;;
*) echo "what is $what?"; exit 2 ;;
esac
grep -E "^(FAIL|DIFF|ok  |repeatable|two threads|FAILED|ERROR|[0-9]+ (passed|failed))|^ +\* |ms$| passed| failed" "$log" | tail -60
printf '%s\n' "${table[@]}"

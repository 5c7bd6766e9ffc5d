#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Packs warp-lang for an x86-64 CUDA machine that can install nothing.
#
#   tools/gpu_day/pack_warp.sh OUTDIR [VERSION]      # with a network: 4-6 minutes, one file of about 59 MiB
#   tar -xJf OUTDIR/warp.tar.xz -C SITE             # on the CUDA machine: 6 s; SITE then belongs on PYTHONPATH
#
# The pack holds what importing and NVRTC need: no warp-clang.so, so it runs CUDA
# kernels only (`cpu` kernels do not compile there). The CUDA driver there must be R580 or newer.
set -euo pipefail
out=${1:?usage: pack_warp.sh OUTDIR [VERSION]} version=${2:-1.19.0}
mkdir -p "$out"; out=$(cd "$out" && pwd)
work=$(mktemp -d); trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m pip download -q --no-deps --only-binary=:all: --python-version 3.12 --implementation cp \
  --platform manylinux_2_34_x86_64 --platform manylinux_2_28_x86_64 --platform manylinux2014_x86_64 -d "$work" "warp-lang==$version"
( cd "$work" && python3 -m zipfile -e warp_lang-*.whl site )
cd "$work/site"
rm -f warp/bin/warp-clang.so
rm -rf warp/examples warp/tests warp/__pycache__
tar --sort=name --mtime=@0 --owner=0 --group=0 -cf - warp ./*.dist-info |
  xz --x86 --lzma2=preset=9e,dict=512MiB -T1 > "$work/warp.tar.xz"
mv "$work/warp.tar.xz" "$out/"
ls -l "$out/warp.tar.xz"

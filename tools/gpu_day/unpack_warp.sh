#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# To be sourced on the CUDA machine:  . unpack_warp.sh DIR   (DIR holds warp.tar.xz, perhaps with other wheels *.whl)
site=${WARP_SITE:-/tmp/site}
[ -d "$site/warp" ] || python3 - "$1" "$site" <<'PY'
import glob, os, sys, tarfile, zipfile
src, site = sys.argv[1:]
os.makedirs(site, exist_ok=True)
with tarfile.open(os.path.join(src, "warp.tar.xz")) as t:
    t.extractall(site)
for wheel in glob.glob(os.path.join(src, "*.whl")):
    zipfile.ZipFile(wheel).extractall(site)
PY
export PYTHONPATH="$site${PYTHONPATH:+:$PYTHONPATH}"
python3 -c 'import warp; warp.init()'

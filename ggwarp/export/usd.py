# SPDX-License-Identifier: Apache-2.0
"""Universal Scene Description: splats as ParticleField3DGaussianSplat (OpenUSD 26.03 and newer)."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

import numpy as np

from ggwarp.export.options import ExportOptions
from ggwarp.export.scene import ExportScene
from ggwarp.results.saved_run import RunError

_MODULES = ("Gf", "Sdf", "Usd", "UsdGeom", "UsdVol", "Vt")


def write_usd(scene: ExportScene, path: Path, options: ExportOptions) -> None:
    """Write one prim with the splats; ``primvars:objectId`` holds their objects.

    Raises:
        RunError: usd-core is too old to know the schema.
    """
    Gf, Sdf, Usd, UsdGeom, UsdVol, Vt = (importlib.import_module(f"pxr.{name}") for name in _MODULES)
    if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
        raise RunError(f"usd-core {Usd.GetVersion()} has no Gaussian splats; pip install 'usd-core>=26.3'")
    g = scene.gaussians
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")  # by its ending USD chooses a form
    stage: Any = Usd.Stage.CreateNew(str(part))
    try:
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/map")
        prim = splats.GetPrim()
        stage.SetDefaultPrim(prim)
        low, high = g.means.min(axis=0).tolist(), g.means.max(axis=0).tolist()
        opacities = 1.0 / (1.0 + np.exp(-g.opacity_logits.astype(np.float64)))
        values = {
            "positions": Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(g.means)),
            "orientations": Vt.QuatfArray.FromNumpy(np.ascontiguousarray(np.roll(g.quats, -1, axis=1))),
            "scales": Vt.Vec3fArray.FromNumpy(np.exp(g.log_scales)),
            "opacities": Vt.FloatArray.FromNumpy(opacities.astype(np.float32)),
            "radiance:sphericalHarmonicsDegree": 0,
            "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(
                np.ascontiguousarray(g.colours)
            ),
            "extent": Vt.Vec3fArray([Gf.Vec3f(*low), Gf.Vec3f(*high)]),
        }
        for name, value in values.items():
            prim.GetAttribute(name).Set(value)
        if g.object_ids is not None:
            primvars = UsdGeom.PrimvarsAPI(prim)
            ids = primvars.CreatePrimvar("objectId", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.vertex)
            ids.Set(Vt.IntArray.FromNumpy(np.ascontiguousarray(g.object_ids)))
        prim.SetCustomDataByKey("objectNames", {str(o.id): o.name for o in scene.objects})
        stage.GetRootLayer().Save()
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)

# SPDX-License-Identifier: Apache-2.0
import numpy as np

from ggwarp.editing.edits import recolour
from ggwarp.editing.inpaint.fitting import RefitConfig, WantedView, fit
from ggwarp.editing.map_view import MapView
from ggwarp.kernels.optim.adam import AdamRates
from ggwarp.results.saved_run import load_run


def test_free_gaussians_learn_and_held_ones_keep_every_bit(run_folder, device):
    run = load_run(run_folder)
    cube = run.gaussians.object_ids == 5
    painted = recolour(run.gaussians, cube, (40, 60, 230))
    wanted = MapView(painted, run.camera, device=device)
    targets = []
    for T_wc in run.poses[1:4]:
        seen = wanted.render(T_wc)
        targets.append(WantedView(T_wc, np.rint(255 * seen.rgb).astype(np.uint8), seen.surface_depth))

    def error(gaussians):
        view = MapView(gaussians, run.camera, device=device)
        return np.mean([np.abs(view.render(t.T_wc).rgb - t.rgb / 255.0).mean() for t in targets])

    fitted = fit(
        run.gaussians,
        cube,
        targets,
        run.camera,
        RefitConfig(iterations=60, rates=AdamRates(colours=0.1)),
        device=device,
    )
    assert error(fitted) < 0.5 * error(run.gaussians)
    for name, before in run.gaussians.arrays().items():
        np.testing.assert_array_equal(getattr(fitted, name)[~cube], before[~cube], err_msg=name)
    np.testing.assert_array_equal(fitted.object_ids, run.gaussians.object_ids)


def test_nothing_to_fit(run_folder):
    run = load_run(run_folder)
    none = np.zeros(len(run.gaussians), bool)
    assert fit(run.gaussians, ~none, [], run.camera) is run.gaussians
    target = WantedView(np.eye(4), np.zeros((64, 96, 3), np.uint8), np.ones((64, 96), np.float32))
    assert fit(run.gaussians, none, [target], run.camera) is run.gaussians

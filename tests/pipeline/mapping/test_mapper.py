# SPDX-License-Identifier: Apache-2.0
import dataclasses

import numpy as np
import pytest

from ggwarp.datasets.built_in.synthetic import SyntheticOffice
from ggwarp.geometry import se3
from ggwarp.map.gaussian_map import GaussianMap
from ggwarp.pipeline.mapping import optimiser
from ggwarp.pipeline.mapping.build import build_mapper
from ggwarp.pipeline.mapping.keyframe_window import WindowConfig
from ggwarp.pipeline.mapping.mapper import Mapper, MapperConfig
from ggwarp.types import Frame

OFFICE = SyntheticOffice(scale=0.1)


@pytest.fixture(scope="module")
def frame() -> Frame:
    return OFFICE[0]


def made(device: str, config: MapperConfig = MapperConfig(), *, use_identity: bool = True) -> Mapper:  # noqa: B008
    return build_mapper(config, OFFICE.camera, device=device, use_identity=use_identity)


def psnr(mapper: Mapper, frame: Frame) -> float:
    assert frame.T_wc is not None
    view = mapper.render(frame.T_wc)
    return float(-10.0 * np.log10(np.mean((view.rgb - frame.rgb / 255.0) ** 2)))


def test_iterations_fit_the_map_to_its_keyframe(device: str, frame: Frame) -> None:
    mapper = made(device)
    assert not mapper.ready
    assert frame.T_wc is not None
    mapper.insert(frame, frame.T_wc)
    before = psnr(mapper, frame)

    losses = [(mapper.iterate(), mapper.synchronise())[1] for _ in range(60)]

    assert mapper.keyframe_indices == [0]
    assert np.mean(losses[-10:]) < 0.6 * losses[0]
    assert psnr(mapper, frame) > before + 4.0


def test_the_loss_of_several_iterations_is_their_mean(device: str, frame: Frame) -> None:
    one, all_at_once = made(device), made(device)
    assert frame.T_wc is not None
    for mapper in (one, all_at_once):
        mapper.insert(frame, frame.T_wc)
        assert np.isnan(mapper.synchronise())
    losses = [(one.iterate(), one.synchronise())[1] for _ in range(7)]
    for _ in range(7):
        all_at_once.iterate()
    assert all_at_once.synchronise() == pytest.approx(np.mean(losses), rel=1e-12)
    assert np.isnan(all_at_once.synchronise())


def test_rendered_objects_are_the_masks_own_ids(device: str, frame: Frame) -> None:
    mapper = made(device)
    assert frame.T_wc is not None and frame.mask is not None
    renamed = dataclasses.replace(frame, mask=frame.mask * 1000 + 7)
    mapper.insert(renamed, frame.T_wc)
    for _ in range(40):
        mapper.iterate()
    view = mapper.render(frame.T_wc)
    assert view.objects is not None and renamed.mask is not None
    assert (view.objects == renamed.mask).mean() > 0.85
    assert set(np.unique(next(mapper.parts()).object_ids)) <= {0, *np.unique(renamed.mask)}


def test_a_keyframe_seen_twice_adds_little(device: str, frame: Frame) -> None:
    mapper = made(device)
    assert frame.T_wc is not None
    mapper.insert(frame, frame.T_wc)
    first = mapper.map.count
    for _ in range(60):
        mapper.iterate()
    mapper.insert(frame, frame.T_wc)
    assert mapper.map.count < 1.3 * first


def test_transparent_and_huge_gaussians_are_pruned(
    device: str, frame: Frame, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optimiser, "_PRUNE_INTERVAL", 1)
    mapper = made(device, use_identity=False)
    assert frame.T_wc is not None
    mapper.insert(frame, frame.T_wc)
    count = mapper.map.count
    logits = mapper.map.fields["opacity_logits"].numpy().copy()
    logits[:10] = -20.0
    mapper.map.fields["opacity_logits"].assign(logits)
    scales = mapper.map.fields["log_scales"].numpy().copy()
    scales[20:25] = np.log(2.0)
    mapper.map.fields["log_scales"].assign(scales)
    mapper.iterate()
    assert mapper.map.count == count - 15


@pytest.mark.parametrize("views", [0, 20])
def test_gaussians_that_stay_hidden_are_pruned(
    views: int, device: str, frame: Frame, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(optimiser, "_PRUNE_INTERVAL", 25)
    mapper = made(device, MapperConfig(prune_low_weight=views), use_identity=False)
    assert frame.T_wc is not None
    mapper.insert(frame, frame.T_wc)
    count, eye = mapper.map.count, frame.T_wc[:3, 3].astype(np.float32)
    logits = mapper.map.fields["opacity_logits"].numpy().copy()
    logits[:count] = 4.0
    mapper.map.fields["opacity_logits"].assign(logits)
    some = mapper.map.to_host().take(np.arange(0, count, 50))
    behind = dataclasses.replace(
        some,
        means=eye + 2.0 * (some.means - eye),
        opacity_logits=np.full(len(some), -3.0, np.float32),
        keyframe_ids=np.full(len(some), 7, np.int32),
    )
    mapper.map.append(behind)
    for _ in range(25):
        mapper.iterate()
    mapper.synchronise()
    left = np.count_nonzero(mapper.map.fields["keyframe_ids"].numpy()[: mapper.map.count] == 7)
    if views:
        assert left < 0.5 * len(behind)
        assert mapper.map.count > 0.9 * count, "what is seen stays"
    else:
        assert left == len(behind)


@pytest.mark.parametrize("use_identity", [True, False])
def test_a_frame_without_any_depth_adds_nothing(use_identity: bool, device: str, frame: Frame) -> None:
    mapper = made(device, use_identity=use_identity)
    assert frame.depth is not None and frame.T_wc is not None
    mapper.insert(dataclasses.replace(frame, depth=np.zeros_like(frame.depth)), frame.T_wc)
    assert not mapper.ready
    assert mapper.render(frame.T_wc).opacity.max() == 0.0


def test_a_frame_without_mask_still_teaches_colour(device: str, frame: Frame) -> None:
    mapper = made(device)
    assert frame.T_wc is not None
    mapper.insert(dataclasses.replace(frame, mask=None), frame.T_wc)
    before = psnr(mapper, frame)
    for _ in range(20):
        mapper.iterate()
    assert psnr(mapper, frame) > before


@pytest.mark.parametrize("change", [{"weight": 0.0, "weight_3d": 0.0}, {"shapes": False}], ids=str)
def test_identities_that_shape_nothing_change_nothing_else(
    change: dict, device: str, frame: Frame, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same Gaussians are seeded, the same keyframes drawn, and the map is the one without identities."""
    classifier = dataclasses.replace(MapperConfig().classifier, **change)
    monkeypatch.setattr(optimiser, "_PRUNE_INTERVAL", 11)
    config = MapperConfig(classifier=classifier)
    mappers = [made(device, config, use_identity=use) for use in (True, False)]
    for new in (frame, OFFICE[5], OFFICE[10]):
        for mapper in mappers:
            assert new.T_wc is not None
            mapper.insert(new, new.T_wc)
            for _ in range(8):
                mapper.iterate()
    identified, plain = (mapper.map.to_host().arrays() for mapper in mappers)
    for name, expected in plain.items():
        np.testing.assert_array_equal(identified[name], expected, err_msg=name)


@pytest.mark.parametrize("use_identity", [True, False])
def test_recorded_iterations_are_the_direct_ones_to_the_bit(
    use_identity: bool, device: str, frame: Frame, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Little room, so that the map's arrays grow between recordings.
    monkeypatch.setitem(GaussianMap.__init__.__kwdefaults__, "capacity", 4500)
    monkeypatch.setattr(optimiser, "_PRUNE_INTERVAL", 7)
    monkeypatch.setattr(optimiser, "_PRUNE_SCALE", 0.08)
    config = MapperConfig(pose_rates=(1e-4, 1e-4))
    mappers = [
        build_mapper(config, OFFICE.camera, device=device, use_identity=use_identity, recorded=recorded)
        for recorded in (False, True)
    ]
    frames = [frame, dataclasses.replace(OFFICE[40], mask=None), OFFICE[80]]
    capacities = set()
    for new in frames:
        for mapper in mappers:
            assert new.T_wc is not None
            mapper.insert(new, new.T_wc)
            for _ in range(11):
                mapper.iterate()
        direct, recorded = mappers
        assert direct.synchronise() == recorded.synchronise()
        expected, got = (mapper.map.to_host().arrays() for mapper in mappers)
        for name in expected:
            np.testing.assert_array_equal(got[name], expected[name], err_msg=name)
        np.testing.assert_array_equal(recorded.keyframe_pose(-1), direct.keyframe_pose(-1))
        capacities.add(direct.map.capacity)
    assert len(capacities) > 1, "grown"
    assert mappers[0].map.version > len(frames), "pruned"
    assert any(mappers[1]._optimiser._graphs._graphs.values()), "recorded"


def test_monocular_keyframes_get_their_depth_from_the_map_and_the_motion(device: str) -> None:
    office = SyntheticOffice(scale=0.2)
    mapper = build_mapper(MapperConfig(), office.camera, device=device, use_identity=False, monocular=True)
    frames = [dataclasses.replace(office[i], depth=None) for i in range(8)]
    for frame in frames[:-1]:
        assert frame.T_wc is not None
        if frame.index == 0:
            mapper.insert(office[0], frame.T_wc)  # as a start estimates it
            for _ in range(20):
                mapper.iterate()
        mapper.observe_frame(frame, frame.T_wc)
    before = mapper.map.count
    T_wc = frames[7].T_wc
    assert T_wc is not None
    mapper.insert(frames[7], T_wc)
    new = mapper.map.to_host().means[before:]
    assert len(new) > 500
    z = (new - T_wc[:3, 3]) @ T_wc[:3, 2]
    pixels = (new - T_wc[:3, 3]) @ T_wc[:3, :2] / z[:, None] * office.camera.fx
    columns, rows = np.rint(pixels + np.array([office.camera.cx, office.camera.cy])).astype(int).T
    true = office[7].depth
    assert true is not None
    assert np.median(np.abs(z / true[rows, columns] - 1.0)) < 0.08
    assert not any(keyframe.has_depth for keyframe in mapper._keyframes)
    assert np.isfinite((mapper.iterate(), mapper.synchronise())[1])


def test_a_full_window_drops_what_it_does_not_confirm(device: str) -> None:
    config = WindowConfig(size=3, cutoff=0.0, confirmations=2)
    shots = [0, 1, 2, 20]  # the last but one brings what the last does not see
    counts = {}
    for name, window in (("kept", dataclasses.replace(config, confirmations=0)), ("dropped", config)):
        mapper = build_mapper(MapperConfig(), OFFICE.camera, device=device, use_identity=False, window=window)
        for number, index in enumerate(shots):
            frame = OFFICE[index]
            assert frame.T_wc is not None
            mapper.insert(frame, frame.T_wc)
            keyframe_ids = mapper.map.fields["keyframe_ids"].numpy()[: mapper.map.count]
            counts[name, number] = np.bincount(keyframe_ids, minlength=4)[:4].tolist()
            assert set(keyframe_ids) <= set(range(number + 1))
    assert counts["kept", 1] == counts["dropped", 1], "not before the window is full"
    assert sum(counts["dropped", 3]) < sum(counts["kept", 3])
    assert counts["dropped", 3][3] > 500, "the newest have not had their chance"


def test_the_isotropic_term_keeps_gaussians_round(device: str, frame: Frame) -> None:
    def stretch(weight: float) -> float:
        mapper = made(device, MapperConfig(isotropic_weight=weight), use_identity=False)
        assert frame.T_wc is not None
        mapper.insert(frame, frame.T_wc)
        for _ in range(40):
            mapper.iterate()
        mapper.synchronise()
        log_scales = mapper.map.to_host().log_scales
        return float(np.median(np.ptp(log_scales, axis=1)))

    assert stretch(100.0) < 0.7 * stretch(0.0)


def test_a_keyframe_s_pose_is_fitted_with_the_map(device: str, frame: Frame) -> None:
    mapper = made(device, MapperConfig(pose_rates=(1e-3, 1e-3)), use_identity=False)
    assert frame.T_wc is not None
    mapper.insert(frame, frame.T_wc)
    for _ in range(60):
        mapper.iterate()
    wrong = frame.T_wc @ se3.se3_exp([0.01, -0.006, 0.0, 0.0, 0.0, 0.0])
    mapper.insert(dataclasses.replace(frame, index=1), wrong)
    for _ in range(100):
        mapper.iterate()
    error = np.linalg.norm(mapper.keyframe_pose(1)[:3, 3] - frame.T_wc[:3, 3])
    assert error < 0.5 * np.linalg.norm(wrong[:3, 3] - frame.T_wc[:3, 3])
    np.testing.assert_allclose(mapper.keyframe_pose(0), frame.T_wc, atol=1e-6)


def test_the_same_views_again_do_not_make_the_map_grow(device: str, rng: np.random.Generator) -> None:
    """As a sensor's edges are another pixel's in each frame, a part of every view seems to be new."""
    config = MapperConfig(depth_weight=0.0)
    mapper = made(device, config, use_identity=False)
    counts, frames = [], [OFFICE[i] for i in (0, 2, 4)]
    for round_ in range(4):
        for frame in frames:
            assert frame.depth is not None and frame.T_wc is not None
            moved = np.roll(frame.depth, rng.integers(-1, 2, 2).tolist(), (0, 1)) if round_ else frame.depth
            noise = 1.0 + 0.005 * rng.normal(size=moved.shape)
            seen = dataclasses.replace(frame, index=3 * round_ + frame.index, depth=np.float32(moved * noise))
            mapper.insert(seen, frame.T_wc)
            for _ in range(4):
                mapper.iterate()
        counts.append(mapper.map.count)
    assert counts[0] > 2000 and counts[-1] < 1.05 * counts[1] < 1.25 * counts[0], counts


def test_identities_leave_the_device_for_those_who_look_at_them_alone(monkeypatch, device: str) -> None:
    """They are four fifths of a view: 52 MB of 1200 x 680 pixels, which no decision needs."""
    mapper, asked = made(device), []
    identity = mapper._renderer.identity
    monkeypatch.setattr(mapper._renderer, "identity", lambda: (asked.append(0), identity())[1])
    for index in range(3):
        frame = OFFICE[index]
        assert frame.T_wc is not None
        if index != 1:
            mapper.insert(frame, frame.T_wc)
        mapper.observe_frame(frame, frame.T_wc)
        mapper.iterate()
    assert not asked
    view = mapper.render(frame.T_wc)
    assert asked and view.identity is not None and view.identity.shape == (*view.opacity.shape, 16)

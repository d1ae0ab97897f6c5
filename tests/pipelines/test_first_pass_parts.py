"""The first pass' small parts: a chain of steps, repeated pictures, when a keyframe is due and what it is linked to."""

from __future__ import annotations

import numpy as np
import pytest

from mosaic.coords import default_anchors, normalise_homography
from mosaic.records import FlowGrid, PairFit, PairStatus
from pipelines.bridge import CameraPose
from pipelines.chain import STEP_VARIANCE_PX2, Chain, centre_motion
from pipelines.config import RegistrationOptions
from pipelines.keyframes import MAX_LINKS, WEAK_CHAIN, KeyframePolicy
from pipelines.repeats import Repeats

SIZE = (640, 360)
POLICY = KeyframePolicy(size_px=SIZE, options=RegistrationOptions())
FAR_PX = POLICY.options.keyframe_shift * SIZE[0]


def shift(x_px: float) -> np.ndarray:
    H = np.eye(3)
    H[0, 2] = x_px
    return H


def fit(
    src: int, dst: int, H: np.ndarray, *, status: PairStatus = PairStatus.OK, score: float = 0.2
) -> PairFit:
    points = np.array([[100.0, 100.0], [320.0, 180.0], [500.0, 300.0]])
    flow = FlowGrid(
        src_px=points, dst_px=points + H[:2, 2], info=np.tile(4.0 * np.eye(2), (3, 1, 1)), weight=np.ones(3),
        cell=np.arange(3),
    )  # fmt: skip
    return PairFit(
        src=src, dst=dst, H_dst_src=H, status=status, reason="", overlap=0.9, rms_grey=2.0, score=score, gain=1.0,
        offset=0.0, n_steps=3, route="predicted", flow=flow, anchors_px=default_anchors(SIZE), info=np.eye(8),
    )  # fmt: skip


def test_a_chain_is_the_product_of_its_steps_with_each_step_s_error_added():
    chain = Chain().followed(fit(0, 1, shift(5)), fit(0, 1, shift(5)))
    assert chain.fit is not None and (chain.n_composed, chain.fit.route) == (0, "predicted")
    turned = normalise_homography(np.array([[0.99, -0.02, 3.0], [0.02, 0.99, 1.0], [1e-5, 0, 1]]))
    chain = chain.followed(None, fit(1, 2, turned)).followed(None, fit(2, 3, shift(2)))
    assert chain.fit is not None
    assert (chain.fit.src, chain.fit.dst, chain.fit.route, chain.n_composed) == (0, 3, "composed", 2)
    np.testing.assert_allclose(
        chain.H_frame_keyframe, normalise_homography(shift(2) @ turned @ shift(5)), atol=1e-12
    )
    variance = np.linalg.inv(chain.fit.flow.info)
    np.testing.assert_allclose(variance, np.tile((1 / 4 + 2 * STEP_VARIANCE_PX2) * np.eye(2), (3, 1, 1)))


def test_a_direct_pair_ends_a_chain_and_without_any_pair_it_stays():
    chain = Chain().followed(fit(0, 1, shift(5)), None).followed(None, fit(1, 2, shift(5)))
    assert chain.followed(None, None) is chain
    again = chain.followed(fit(0, 3, shift(14)), fit(2, 3, shift(5)))
    assert again.n_composed == 0 and again.H_frame_keyframe[0, 2] == 14
    # The motion since the frame before, where only the pair with the keyframe held.
    np.testing.assert_allclose(again.H_since(chain), shift(4), atol=1e-12)


def test_motion_of_the_centre_is_its_shift_and_the_scale_there():
    x, y = (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2
    H = np.array([[1.2, 0, 3 - 0.2 * x], [0, 1.2, 4 - 0.2 * y], [0, 0, 1]])
    moved_px, zoom = centre_motion(H, SIZE)
    assert moved_px == pytest.approx(5.0) and zoom == pytest.approx(1.2)
    assert centre_motion(np.diag([1.0, 1.0, -1.0]), SIZE) == (np.inf, 1.0)


def due(direct: PairFit, *, n_composed: int = 0, n_keyframes: int = 9) -> bool:
    return POLICY.is_due(Chain(fit=direct, n_composed=n_composed), direct, [direct], n_keyframes)


def test_a_keyframe_is_due_at_its_distance_sooner_at_first_and_later_where_in_doubt():
    assert not due(fit(0, 5, shift(0.9 * FAR_PX))) and due(fit(0, 5, shift(1.1 * FAR_PX)))
    assert due(fit(0, 5, shift(0.4 * FAR_PX)), n_keyframes=1)
    doubtful = [fit(0, 5, shift(share * FAR_PX), status=PairStatus.WEAK) for share in (1.9, 2.1)]
    assert [due(pair) for pair in doubtful] == [False, True]
    assert due(fit(0, 5, shift(1.0), score=0.55)), "players cover what it saw: the last good frame is taken"
    assert due(fit(0, 5, shift(1.0)), n_composed=WEAK_CHAIN)


def test_a_new_keyframe_is_linked_to_the_nearest_and_the_farthest_that_it_sees():
    def at(pan_rad: float) -> CameraPose:
        c, s = np.cos(pan_rad), np.sin(pan_rad)
        return CameraPose(log_f=np.log(1000.0), R=np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]))

    near = POLICY.nearest(at(0.0), {k: at(0.03 * k) for k in range(20)})
    assert [k for _, k in near] == list(range(20))
    seen = [k for d, k in near if d < 1 - POLICY.options.min_overlap and k != 0]
    linked = POLICY.to_link(near, current=0)
    assert len(seen) > MAX_LINKS == len(linked)
    assert linked == seen[: MAX_LINKS // 2] + seen[-MAX_LINKS // 2 :]
    assert POLICY.same_view(near, current=0) == [1] and POLICY.same_view(near, current=1) == [0]


def test_a_repeat_differs_far_less_than_pictures_of_the_shot_do():
    rng = np.random.default_rng(1)
    picture = rng.uniform(40, 200, (45, 80)).astype(np.float32)
    repeats = Repeats()
    for _ in range(5):
        moved = picture + rng.normal(0, 5, picture.shape).astype(np.float32)
        assert not repeats.is_repeat(picture, moved)
    coded_again = picture + rng.normal(0, 0.5, picture.shape).astype(np.float32)  # mean change .4
    assert repeats.is_repeat(picture, coded_again)
    assert not Repeats().is_repeat(picture, coded_again), "in a shot of small changes it may be motion"
    assert Repeats().is_repeat(picture, picture)

"""DirectHomography: batches, agreement with `register`, and gradients that mean what the docstring says."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mosaic import torch_module
from mosaic.pair import PairOptions, register
from mosaic.torch_module import DirectHomography
from tests.mosaic.textures import SIZE, as_uint8, corner_error_px, grid, homography, look, picture

H_TRUE = homography(6.3, -4.2, 1.04, 1.5, 0.01, -0.02)
CENTRE = torch.tensor([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2, 1.0], dtype=torch.float64)


def tensor(gray: np.ndarray) -> torch.Tensor:
    """(1, 1, h, w) float, white 1."""
    return torch.from_numpy(gray.astype(np.float32) / 255.0)[None, None]


def centre_of(H: torch.Tensor) -> torch.Tensor:
    q = H @ CENTRE
    return q[:2] / q[2]


def test_a_batch_is_its_pairs_and_a_failed_one_is_nan():
    seeds = (0, 1, 2)
    a = torch.cat([tensor(as_uint8(picture(s), noise=1, seed=1)) for s in seeds])
    b = torch.cat([tensor(as_uint8(picture(s, H_TRUE), noise=1, seed=2)) for s in (0, 11, 2)])
    module = DirectHomography()
    H = module(a, b)
    assert H.shape == (3, 3, 3) and H.dtype == torch.float64
    assert [f.usable for f in module.fits(a, b)] == [True, False, True]
    assert torch.isfinite(H).all(dim=(1, 2)).tolist() == [True, False, True]
    for i in (0, 2):
        assert corner_error_px(H[i].numpy(), H_TRUE) < 0.05
        assert float(torch.linalg.det(H[i])) == pytest.approx(1.0, abs=1e-9)
        assert torch.equal(module(a[i : i + 1], b[i : i + 1])[0], H[i])
    assert module(a[:0], b[:0]).shape == (0, 3, 3)


def test_without_refinement_it_is_register_without_gradients():
    a, b = tensor(picture(0)), tensor(picture(0, H_TRUE))
    H = DirectHomography(n_refine=0)(a.requires_grad_(), b)
    np.testing.assert_array_equal(H[0].numpy(), register(a, b).H_dst_src)
    assert not H.requires_grad


def test_the_refinement_converges():
    a, b = (
        tensor(as_uint8(picture(3), noise=2, seed=1)),
        tensor(as_uint8(picture(3, H_TRUE), noise=2, seed=2)),
    )
    H = [DirectHomography(n_refine=n)(a, b)[0].numpy() for n in (2, 3, 8)]
    assert corner_error_px(H[0], H[2]) < 5e-3
    assert corner_error_px(H[1], H[2]) < 1e-3


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("which", ["a", "b"])
def test_gradients_say_what_a_shifted_picture_does(which, axis):
    """The textures' own derivative along an axis: shifting b by it moves H's translation 1 : 1, shifting a back."""
    at = grid()
    back = np.linalg.inv(H_TRUE)
    step = 0.01 * np.eye(2)[axis]

    def seen(xy):
        if which == "b":
            p = xy @ back[:, :2].T + back[:, 2]
            xy = p[..., :2] / p[..., 2:]
        return look(0, xy)

    shifted = torch.from_numpy((seen(at - step) - seen(at + step)) / (2 * 0.01) / 255.0)
    pictures = {"a": tensor(picture(0)), "b": tensor(picture(0, H_TRUE))}
    pictures[which].requires_grad_()
    H = DirectHomography()(pictures["a"], pictures["b"])[0]
    moved = [
        float((torch.autograd.grad(value, pictures[which], retain_graph=True)[0][0, 0] * shifted).sum())
        for value in centre_of(H)
    ]
    # Shifting a by t is H <- H T(-t): at the centre minus the derivative of the map, here A.
    p = H.detach().numpy() @ np.append(CENTRE[:2].numpy(), 1.0)
    A = (H.detach().numpy()[:2, :2] - np.outer(p[:2] / p[2], H.detach().numpy()[2, :2])) / p[2]
    expected = np.eye(2)[axis] if which == "b" else -A[:, axis]
    np.testing.assert_allclose(moved, expected, atol=0.02)


def test_gradients_are_those_of_the_solution(monkeypatch):
    """Noisy pictures, any small change of b (another texture fading in), against differences of the converged steps.

    Exact but for what the docstring calls constant: so gain and start are held, and the weights made equal.
    """
    monkeypatch.setattr(torch_module, "TUKEY", 1e6)
    a = tensor(picture(1) + np.random.default_rng(0).normal(0, 2, SIZE[::-1]))
    b = tensor(picture(1, H_TRUE) + np.random.default_rng(1).normal(0, 2, SIZE[::-1])).requires_grad_()
    module = DirectHomography()
    points = module._points(module._gray(a[0], 1.0), None)

    def solution(picture_b):
        H, target = torch.from_numpy(H_TRUE), module._gray(picture_b[0], 1.0)
        with torch.no_grad():
            for _ in range(12):
                H = torch_module._step(H, points, target, None, 1.0, 0.0)
        return centre_of(torch_module._step(H, points, target, None, 1.0, 0.0))

    direction, size = tensor(picture(9) - 120.0), 0.02
    slopes = [float((torch.autograd.grad(x, b, retain_graph=True)[0] * direction).sum()) for x in solution(b)]
    with torch.no_grad():
        plus, minus = (solution(b + s * size * direction) for s in (1, -1))
    difference = ((plus - minus) / (2 * size)).numpy()
    assert np.linalg.norm(difference) > 0.1
    np.testing.assert_allclose(slopes, difference, atol=1e-3)


def test_gradients_stay_inside_the_masks_and_the_overlap():
    a, b = tensor(picture(0)), tensor(picture(0, homography(dx=60))).requires_grad_()
    mask = torch.ones(1, 1, SIZE[1], SIZE[0])
    mask[..., 150:, :] = 0
    DirectHomography()(a, b, mask_b=mask)[0, 0, 2].backward()
    reached = b.grad[0, 0] != 0
    assert reached[:150, 70:].float().mean() > 0.5
    assert not reached[156:].any() and not reached[:, :55].any()


@pytest.mark.parametrize(
    ("shapes", "said"),
    [
        (((2, 1, 40, 40), (1, 1, 40, 40)), r"\(2, 1, 40, 40\) and \(1, 1, 40, 40\)"),
        (((1, 2, 40, 40), (1, 2, 40, 40)), "C = 1 or 3"),
        (((40, 40), (40, 40)), "B, C, H, W"),
    ],
)
def test_other_shapes_are_refused(shapes, said):
    with pytest.raises(ValueError, match=said):
        DirectHomography()(*(torch.zeros(s) for s in shapes))
    with pytest.raises(ValueError, match="mask"):
        DirectHomography()(torch.zeros(1, 1, 40, 40), torch.zeros(1, 1, 40, 40), torch.ones(1, 40, 40))
    with pytest.raises(ValueError, match="-1"):
        DirectHomography(n_refine=-1)


def test_colour_and_options_pass_through():
    a, b = tensor(picture(2)).expand(-1, 3, -1, -1), tensor(picture(2, H_TRUE)).expand(-1, 3, -1, -1)
    H = DirectHomography(options=PairOptions(rescue=False, smooth=False), n_points=3000)(a, b)
    assert corner_error_px(H[0].numpy(), H_TRUE) < 0.05

"""Of what was seen at a place, the colour that comes again and looks least like a body."""

import numpy as np

from mosaic.ground import Witness, decide, evidence
from mosaic.surface import Surface
from tests.mosaic.pinhole import Pinhole

SIZE_PX = (96, 64)
GROUND, SHIRT = (70, 120, 60), (220, 220, 225)
SURFACE = Surface(kind="planar", scale_px=300.0, cx=47.5, cy=31.5, width=96, height=64)
INNER = np.s_[20:44, 30:60]


def witness(frame, colour, nats=0.0, usable=True):
    picture = np.full((SIZE_PX[1], SIZE_PX[0], 3), GROUND, np.uint8)
    says = np.zeros(picture.shape[:2], np.float32)
    picture[10:54, 20:70] = colour
    says[10:54, 20:70] = nats
    placement = Pinhole(frame=frame, size_px=SIZE_PX, f_px=300.0)
    seen = np.full(picture.shape[:2], int(usable), np.uint8)
    box = (0.0, 0.0, float(SIZE_PX[0]), float(SIZE_PX[1]))
    return Witness(placement, np.dstack([picture, evidence(says)]), seen, 1, box)


def decided(witnesses, composite_colour=SHIRT, contested=True):
    composite = np.full((64, 96, 3), composite_colour, np.uint8)
    where = np.full((64, 96), contested)
    return decide(witnesses, composite, where, SURFACE, 1)[:2]


def test_a_body_in_most_frames_is_outvoted_by_how_it_looks():
    bodies = [witness(10 * k, SHIRT, nats=-3.0) for k in range(6)]
    clear = [witness(70, GROUND, nats=2.0), witness(90, GROUND, nats=2.0)]
    image, moments = decided(bodies + clear)
    assert (np.abs(image[INNER] - np.array(GROUND, int)) <= 1).all()
    assert (moments[INNER] == 2).all()


def test_without_looks_the_colour_of_most_moments_wins():
    image, moments = decided([witness(10 * k, SHIRT if k < 4 else GROUND) for k in range(6)])
    assert (np.abs(image[INNER] - np.array(SHIRT, int)) <= 1).all()
    assert (moments[INNER] == 4).all()


def test_frames_of_one_moment_are_one_witness():
    crowd = [witness(k, SHIRT) for k in range(5)]
    image, moments = decided([*crowd, witness(30, GROUND), witness(60, GROUND)])
    assert (np.abs(image[INNER] - np.array(GROUND, int)) <= 1).all()
    assert (moments[INNER] == 2).all()


def test_what_is_not_contested_or_not_seen_stays():
    bodies = [witness(10 * k, GROUND, nats=3.0) for k in range(4)]
    image, moments = decided(bodies, contested=False)
    assert (image == SHIRT).all() and not moments.any()
    image, moments = decided([witness(10 * k, GROUND, usable=False) for k in range(4)])
    assert (image == SHIRT).all() and not moments.any()


def test_evidence_survives_its_eight_bits():
    nats = np.linspace(-6, 6, 49, dtype=np.float32)[None]
    back = (evidence(nats).astype(np.float32) - 128) / 20
    assert np.abs(back - nats).max() <= 0.026
    assert evidence(np.array([[-99.0, 99.0]], np.float32)).tolist() == [[0, 255]]


def test_tiles_leave_no_trace(monkeypatch):
    rng = np.random.default_rng(2)
    witnesses = []
    for k in range(7):
        one = witness(10 * k, GROUND if k < 3 else SHIRT)
        noisy = one.picture.copy()
        noisy[..., :3][rng.uniform(size=noisy.shape[:2]) < 0.3] = SHIRT if k < 3 else GROUND
        witnesses.append(Witness(one.placement, noisy, one.usable, one.shrink, one.box))
    whole = decided(witnesses)
    monkeypatch.setattr("mosaic.ground.TILE_PX", 24)
    tiled = decided(witnesses)
    assert (whole[0] == tiled[0]).all() and (whole[1] == tiled[1]).all()
    assert len(np.unique(whole[0].reshape(-1, 3), axis=0)) > 1

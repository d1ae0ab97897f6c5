"""States of contested pixels: what was seen together stays together."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import mosaic.states as states_module
from mosaic.states import (
    APART,
    EVIDENCE_STEP,
    N_STATES,
    NEVER,
    REACH,
    UNSEEN,
    find_states,
    no_states,
    settle,
)

GROUND, SHIRT, WHITE = (70, 120, 60), (220, 30, 40), (240, 240, 240)


def states_of(views, nats=None, seen=None, composite=GROUND, contested=None, moments=10):
    """The states of views (n, h, w, 3) that are `moments` frames apart, and where they are contested."""
    views = np.asarray(views, np.uint8)
    n, height, width = views.shape[:3]
    says = np.zeros((n, height, width)) if nats is None else np.asarray(nats, float)
    evidence = np.rint(128 + says / EVIDENCE_STEP).astype(np.uint8)
    usable = np.ones((n, height, width), np.uint8) if seen is None else np.asarray(seen, np.uint8)
    where = np.ones((height, width), bool) if contested is None else contested
    found = no_states(height, width)
    behind = np.broadcast_to(np.asarray(composite, np.uint8), (height, width, 3))
    frames = np.arange(n, dtype=np.int64) * moments
    find_states(np.concatenate([views, evidence[..., None]], axis=-1), usable, frames, behind, where, found)
    return found, where, np.ascontiguousarray(behind)


def picture_of(found, where, behind):
    return found.picture(settle(found, where), behind, where)


def flat(colours, shape):
    return np.broadcast_to(np.asarray(colours, np.uint8)[:, None, None, :], (len(colours), *shape, 3)).copy()


def test_states_are_the_distinct_colours_the_likeliest_first():
    colours = [GROUND, GROUND, GROUND, SHIRT, SHIRT, WHITE]
    found, _, _ = states_of(flat(colours, (2, 3)))
    assert (found.colour[0, 0, :3] == [GROUND, SHIRT, WHITE]).all()
    assert found.moments[1, 2].tolist() == [3, 2, 1, 0]
    assert found.value[0, 1, :3] == pytest.approx(np.log([3, 2, 1]), abs=1e-6)
    assert found.value[0, 1, 3] == NEVER


def test_evidence_weighs_with_the_moments():
    colours = [SHIRT] * 4 + [GROUND]
    nats = np.zeros((5, 1, 2))
    nats[:4], nats[4] = -2.0, 1.0
    found, where, behind = states_of(flat(colours, (1, 2)), nats)
    assert found.value[0, 0, :2] == pytest.approx([1.0, np.log(4) - 2], abs=1e-6)
    image, moments = picture_of(found, where, behind)
    assert (image == GROUND).all() and (moments == 1).all()


def test_a_hoarding_that_changed_its_text_keeps_one_of_the_texts():
    # Two texts of stripes, in the one state wide and in the other narrow; each letter of its own was seen once more
    # often or once less often in the one than in the other, by chance (players before it).
    rng = np.random.default_rng(3)
    height, width = 12, 40
    texts = np.full((2, height, width, 3), 40, np.uint8)
    texts[0, :, (np.arange(width) // 3) % 2 == 0] = WHITE
    texts[1, :, (np.arange(width) // 5) % 2 == 1] = SHIRT
    views = np.repeat(texts, 5, axis=0)
    seen = np.ones((10, height, width), np.uint8)
    for block in range(0, width, 8):  # players hide a part of the one or of the other
        hidden = rng.choice([0, 1])
        seen[5 * hidden : 5 * hidden + 2, :, block : block + 8] = 0
    found, where, behind = states_of(views, seen=seen)
    image, _ = picture_of(found, where, behind)
    wrong = [(np.abs(image.astype(int) - text).max(axis=-1) > 12).mean() for text in texts]
    alone, _ = found.picture(np.zeros((height, width), np.uint8), behind, where)
    before = [(np.abs(alone.astype(int) - text).max(axis=-1) > 12).mean() for text in texts]
    assert min(before) > 0.1  # pixel by pixel it is a mixture
    assert min(wrong) == 0.0


def test_a_piece_of_a_body_is_not_left_alone_on_the_ground():
    # The body stood in half of the frames; in a band across it colours and moments speak for it, elsewhere against.
    height, width = 30, 30
    body = np.s_[3:27, 8:22]
    views = flat([GROUND] * 12, (height, width))
    nats = np.full(views.shape[:3], 0.5)
    for k in range(6):
        views[k][body] = SHIRT
        nats[k][body] = -0.5
        nats[k][12:15, 8:22] = 0.7  # a stripe that might as well be ground
    found, where, behind = states_of(views, nats, composite=GROUND)
    alone, _ = found.picture(np.zeros((height, width), np.uint8), behind, where)
    assert (alone[13, 15] == SHIRT).all() and (alone[5, 15] == GROUND).all()
    image, _ = picture_of(found, where, behind)
    assert (image == GROUND).all()


def test_certain_ground_beside_it_speaks_for_what_was_seen_with_it():
    # Left of column 10 all is certain and dark; SHIRT was seen only while that was bright there (another light).
    views = flat([GROUND] * 3 + [SHIRT] * 3, (6, 16))
    views[3:, :, :10] = WHITE
    contested = np.zeros((6, 16), bool)
    contested[:, 10:] = True
    nats = np.zeros(views.shape[:3])
    nats[3:] = 0.4
    found, where, behind = states_of(views, nats, contested=contested)
    alone, _ = found.picture(np.zeros((6, 16), np.uint8), behind, where)
    assert (alone[:, 10:] == SHIRT).all()
    image, moments = picture_of(found, where, behind)
    assert (image == GROUND).all()
    assert not moments[:, :10].any() and (moments[:, 10:] == 3).all()


def test_a_row_is_solved_exactly(monkeypatch):
    # Belief propagation is exact on a chain: neighbours only.
    monkeypatch.setattr(states_module, "APART", ((0, 1),))
    monkeypatch.setattr(states_module, "UNSEEN", (1.0,))
    rng = np.random.default_rng(11)
    for _ in range(20):
        width = 6
        found = no_states(1, width)
        found.value[:] = rng.normal(0, 1, found.value.shape)
        together = rng.integers(0, 1 << 16, (1, width, 1)).astype(np.uint16)
        found = replace(found, together=together)
        chosen = settle(found, np.ones((1, width), bool))[0]

        def worth(way, values=found.value[0], bits=together[0, :, 0]):
            own = sum(float(values[j, s]) for j, s in enumerate(way))
            seams = sum(
                not int(bits[j]) >> (s * N_STATES + t) & 1 for j, (s, t) in enumerate(itertools.pairwise(way))
            )
            return own - seams

        best = max(itertools.product(range(N_STATES), repeat=width), key=worth)
        assert worth(chosen.tolist()) == pytest.approx(worth(best), abs=1e-4)


def test_what_lies_beyond_the_part_is_seen_together_with_it():
    # A part in the middle of a larger tile knows its pairs to the right and below, the same as the whole does.
    rng = np.random.default_rng(5)
    views = np.array([GROUND, SHIRT, WHITE], np.uint8)[rng.integers(0, 3, (9, 20 + REACH, 24 + REACH))]
    whole, _, behind = states_of(views)
    part = no_states(20, 24)
    evidence = np.full((*views.shape[:3], 1), 128, np.uint8)
    find_states(
        np.concatenate([views, evidence], axis=-1), np.ones(views.shape[:3], np.uint8),
        np.arange(9, dtype=np.int64) * 10, behind, np.ones(views.shape[1:3], bool), part,
    )  # fmt: skip
    assert (part.together == whole.together[:20, :24]).all()
    assert (part.together > 0).all()
    assert len(APART) == len(UNSEEN) == part.together.shape[-1]

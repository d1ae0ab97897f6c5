"""Who is the object where two pictures differ, and what the frames that show ground agree on."""

import cv2
import numpy as np
import pytest

from mosaic.contest import ACCEPTED, GHOST, GroundVote, verdict

BODY = np.s_[30:70, 40:60]


def textured(seed=1, contrast=12.0):
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(0, 1, (100, 120, 3)).astype(np.float32), (0, 0), 1.5)
    return np.clip(110 + contrast * noise / noise.std(), 0, 255).astype(np.uint8)


def with_body(ground, colour=(210, 40, 60)):
    picture = ground.copy()
    picture[BODY] = colour
    return picture


def labels_of(a, b):
    differs = (np.abs(a.astype(int) - b.astype(int)).max(axis=-1) > 14).astype(np.uint8)
    opened = cv2.morphologyEx(differs, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    n, labels = cv2.connectedComponents(opened, connectivity=8)
    return labels, np.bincount(labels.ravel(), minlength=n)


@pytest.mark.parametrize("contrast", [2.0, 12.0, 25.0])
def test_the_picture_whose_colour_breaks_off_shows_the_object(contrast):
    ground = textured(contrast=contrast)
    body = with_body(ground)
    labels = labels_of(body, ground)
    assert np.median(verdict(body, ground, *labels)[BODY]) > 0.3
    assert np.median(verdict(ground, body, *labels)[BODY]) < GHOST - 0.1


def test_a_body_before_a_painted_body_is_no_ground():
    ground = textured()
    painted, passing = with_body(ground), ground.copy()
    passing[20:80, 45:75] = (30, 40, 200)
    found = verdict(passing, painted, *labels_of(passing, painted))
    assert (found[25:75, 62:72] > 0).all()  # where he stands before the ground that the composite shows


def map_of(shape):
    return np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1).astype(np.float32)


def voted(pictures, painted):
    vote = GroundVote(painted.shape[:2])
    ghost = np.zeros(painted.shape[:2], bool)
    ghost[BODY] = True
    for frame, picture in pictures:
        vote.add(frame, picture, ghost, map_of(ghost.shape))
    return vote.correct(painted, 14.0)


def test_ground_seen_at_two_moments_replaces_a_painted_body():
    ground = textured()
    painted = with_body(ground)
    found = voted([(3, ground), (20, ground)], painted)
    inner = np.s_[32:68, 42:58]
    assert found.accepted[inner].all()
    assert np.array_equal(found.ground[inner], ground[inner])
    outside = np.ones(found.accepted.shape, bool)
    outside[29:71, 39:61] = False
    assert not found.accepted[outside].any()


def test_one_moment_or_frames_that_disagree_replace_nothing():
    ground = textured()
    painted = with_body(ground)
    assert not voted([(3, ground), (5, ground)], painted).accepted.any()
    others = [(k, with_body(ground, colour)) for k, colour in ((3, (250, 250, 250)), (20, (20, 20, 20)))]
    assert not voted(others, painted).accepted.any()


def test_what_breaks_off_more_than_the_composite_is_not_accepted():
    ground = textured()
    body = with_body(ground)
    assert ACCEPTED < 0
    assert not voted([(3, body), (20, body), (40, body)], ground).accepted.any()

"""A shot of hundreds of frames that goes there and back: small errors from frame to frame must not add up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib import HomographyGraph, refine, rotation, solve_poses
from calib.problem import pack
from calib.starts import state_from_solution
from tests.calib import tracks

N_KEYFRAMES, N_BETWEEN = 6, 500
# Frame to frame, every zoom is measured 1 in 1000 too short: nothing for a pair, a factor of .6 after 500 of them.
ZOOM = 0.999


def test_frames_far_in_time_from_every_keyframe_are_solved_against_them() -> None:
    rng = np.random.default_rng(3)
    turns = tracks.path(rng, N_KEYFRAMES, pan_deg=20, zoom=1.3, roll_deg=0.0)
    held = refine(tracks.graph(rng, turns), priors=None)
    # Afterwards the camera looks about within what the keyframes saw, for 500 frames.
    pick = (np.sin(np.linspace(0, 40, N_BETWEEN)) + 1) / 2 * (N_KEYFRAMES - 1)
    low = np.minimum(pick.astype(int), N_KEYFRAMES - 2)
    part = (pick - low)[:, None]
    step = rotation.log(turns.R[low + 1] @ np.swapaxes(turns.R[low], 1, 2))
    R = rotation.exp(part * step) @ turns.R[low]
    log_f = turns.log_f[low] + part[:, 0] * (turns.log_f[low + 1] - turns.log_f[low])
    frames = np.concatenate([turns.frames, np.arange(N_BETWEEN) + 1000])
    truth = tracks.Truth(
        frames=frames,
        log_f=np.concatenate([turns.log_f, log_f]),
        R=np.concatenate([turns.R, R]),
        lens=turns.lens,
    )
    edges = []
    for row in range(N_KEYFRAMES, len(frames)):
        nearest = round(float(pick[row - N_KEYFRAMES]))
        edges.append(tracks.edge(rng, truth, nearest, row))
        if row > N_KEYFRAMES:
            e = tracks.edge(rng, truth, row - 1, row)
            about = (np.array(truth.lens.size_px) - 1) / 2 * (1 - ZOOM)
            short = np.array([[ZOOM, 0, about[0]], [0, ZOOM, about[1]], [0, 0, 1]]) / ZOOM ** (2 / 3)
            edges.append(replace(e, grid_b=ZOOM * e.grid_b + about, H=short @ e.H))
    graph = HomographyGraph(frames=frames, edges=tuple(edges), size_px=truth.lens.size_px)

    # Where the solution starts: a few hundred frames of drift have ended beyond the horizon, where nothing converges.
    start = state_from_solution(pack(graph), frames, held, 0)
    common = held.log_f[0] - turns.log_f[0]
    assert np.abs(start.log_f[0] - truth.log_f - common).max() < 0.02

    out = solve_poses(graph, held)

    assert np.isfinite(out.log_f).all() and out.converged
    assert np.abs(out.log_f - truth.log_f - common).max() < 0.01
    turn = rotation.log(out.R @ out.R[0].T @ np.swapaxes(truth.R @ truth.R[0].T, 1, 2))
    assert np.degrees(np.linalg.norm(turn, axis=-1)).max() < 0.3

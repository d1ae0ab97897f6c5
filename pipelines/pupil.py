"""The parallax of the entrance pupil in a shot: estimated from its keyframes and taken out of what they measured.

Keyframes are registered again with the lens that is left when the parallax is out, because a pair measures a little
of the lens that it was registered through. What the parallax is and how it is found: `calib.parallax`, `calib.pupil`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calib.pupil import PupilFit, PupilOptions, fit_pupil
from calib.records import HomographyGraph, Solution
from calib.refine import refine
from mosaic.records import PairFit
from pipelines.bridge import homography_graph
from pipelines.keyframe_graph import KeyframeResult

log = logging.getLogger(__name__)

MAX_ROUNDS = 4  # of registering the keyframes again; half of what is left goes per round
SETTLED = 0.001  # change of mean log f at which they stop


def with_pupil(result: KeyframeResult, register: Callable[[Solution], list[PairFit]]) -> KeyframeResult:
    """The keyframes without the pupil's parallax, where they show one; else as they are, with the reason in `pupil`.

    register: the keyframe pairs anew, through a solution's lens. The result's graph is the corrected one.
    """
    if not (result.options.distortion and np.isfinite(result.solution.log_f).sum() >= 2):
        return result  # the plain model of a torn graph claims nothing, so there is nothing to correct
    found = _fit(result.graph, result.solution, result)
    # Not accepted: its solution and graph are those handed in.
    result = replace(result, solution=found.solution, graph=found.graph, pupil=found)
    for _ in range(MAX_ROUNDS if found.accepted else 0):
        fits = register(found.solution)
        graph = homography_graph(found.solution.frames, fits, result.graph.size_px)
        options = replace(result.options, reference=found.solution.reference)
        solution = refine(graph, start=found.solution, priors=found.solution.priors, options=options)
        if not np.isfinite(solution.log_f).all():
            break
        before, found = found, _fit(graph, solution, result)
        if not found.accepted:
            break
        change = float(np.mean(found.solution.log_f - before.solution.log_f))
        log.debug("pupil: mean log f moved by %.4f, by another registration %.4f", found.shift_log_f, change)
        result = replace(result, solution=found.solution, graph=found.graph, fits=tuple(fits), pupil=found)
        if abs(change) < SETTLED:
            break
    return result


def _fit(graph: HomographyGraph, solution: Solution, result: KeyframeResult) -> PupilFit:
    return fit_pupil(graph, solution, PupilOptions(refine=result.options))

"""Straight lines against a graph of homographies: how much they count, and the calibration with them.

A lens model that is wrong in a way that all edges share (a pupil before the pan axis, say) pulls k1 and the focal
length along their common valley, and the more edges there are, the surer they look. Lines have errors of their own;
they must weigh against what the edges' errors are, not against what those would be if they averaged out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calib.gates import GateOptions
from calib.records import HomographyGraph, Priors, Solution, StraightLine
from calib.refine import RefineOptions, refine
from calib.systematic import systematic_px


def fit_lines(
    graph: HomographyGraph,
    lines: Sequence[StraightLine],
    *,
    start: Solution | None = None,
    priors: Priors | None = None,
    options: RefineOptions | None = None,
    gates: GateOptions | None = None,
) -> Solution:
    """refine() with lines that are straight in the scene, weighted by how far the edges' errors are from averaging out.

    graph, start, priors, options: as refine() takes them; lines: of frames of the graph (others do not count). Weight:
    variance of the common log f with the systematic part (gates: as judge() has it) over the formal one, both without
    the lines. Returns a Solution whose priors carry the weighted lines; judge() it with `graph`. A graph that cannot be
    calibrated without the lines is returned as it is. ValueErrors as refine().
    """
    priors, gates = priors or Priors(), gates or GateOptions()
    without = refine(graph, start=start, priors=priors, options=options)
    if not (without.converged and without.sigma_mean_formal > 0 and without.s10_px > 0):
        return without
    signal = 0.1 * systematic_px(without, graph, gates)["systematic_px"] / without.s10_px
    weight = max((np.hypot(without.sigma_mean_log_f, signal) / without.sigma_mean_formal) ** 2, 1.0)
    weighted = tuple(replace(line, weight=float(weight * line.weight)) for line in lines)
    options = replace(options or RefineOptions(), reference=without.reference)
    return refine(
        graph, start=without, options=options,
        priors=replace(priors, straight_lines=(*priors.straight_lines, *weighted)),
    )  # fmt: skip

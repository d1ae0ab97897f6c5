"""The whole program on one scene in several shapes: what is done to a picture must not move the focal length."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.pipelines.end_to_end import run
from tests.pipelines.variants import fine_clip, read_pictures, relative_errors, write_variant
from tests.synth.clip import read_truth, truth_path

pytestmark = pytest.mark.slow  # whole runs

INTERLACED, SQUEEZED = "interlaced (H.264, top field first, ts)", "anamorphic (480x360, pixels 4:3)"


def test_fields_and_anamorphic_pixels_keep_the_focal_length(tmp_path: Path) -> None:
    path = fine_clip(tmp_path)
    fine, truth = read_pictures(path), read_truth(truth_path(path))
    for name, n_pictures in ((INTERLACED, 96), (SQUEEZED, 48)):
        out = tmp_path / str(n_pictures)
        done = run(write_variant(name, fine, tmp_path), out, "--panorama.enabled", "false", "-q")
        assert done.code == 0 and len(done.table) == n_pictures
        errors = relative_errors(name, done, truth)
        known = np.isfinite(errors)
        assert known.mean() > 0.9
        # Two stated sigma: 3 % here. Wrong fields or a wrong aspect would be off by 10 % and more, or claim nothing.
        assert (np.abs(errors[known]) < 2 * (done.table.f_std_px / done.table.f_px)[known]).all()
        assert np.median(done.table.aspect[known]) == pytest.approx(
            0.75 if name == SQUEEZED else 1.0, rel=0.01
        )

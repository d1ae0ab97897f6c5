"""docs/calibration-example.md runs as it stands, tells the truth, and draws the figure that it shows."""

import re
from pathlib import Path

import numpy as np

DOCS = Path(__file__).parents[2] / "docs"


def numbers(svg: str) -> np.ndarray:
    return np.array([float(x) for x in re.findall(r'c[xy]="([\d.]+)"|([\d.]+),', svg) for x in x if x])


def test_the_worked_example_runs_and_its_ellipse_holds_the_estimates(tmp_path, monkeypatch, capsys):
    text = (DOCS / "calibration-example.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    assert len(blocks) == 5
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, "calibration-example.md", "exec"), names)
    said = capsys.readouterr().out
    assert "ok - The focal length is known" in said and "no_rotation" in said and "must turn" in said
    found = names["found"]
    assert np.all(np.abs(found.fx_px - names["focal_px"]) < 3 * found.fx_std_px)
    # 60 draws of a 95 % event: three standard errors are 8.4 %.
    assert names["share"] > 0.86
    drawn = (tmp_path / "calibration-ellipse.svg").read_text(encoding="utf-8")
    shown = (DOCS / "images" / "calibration-ellipse.svg").read_text(encoding="utf-8")
    np.testing.assert_allclose(numbers(drawn), numbers(shown), atol=1.0)

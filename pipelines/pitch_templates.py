"""Named points and lines of playing fields, in metres: what people click, and what can be drawn back.

Origin in the middle of the field, X along it to the right, Y across it away from the camera's side, on the ground.
Sizes are the rules' own, which run to a marking's outer edge; the middle of it, which people click, is 6 cm from
there at most, and that is left out.

Sources (dimensions only): football, IFAB Laws of the Game, law 1 (105 x 68 m is usual in stadiums; other sizes by
`football(length, width)`); basketball, FIBA Official Basketball Rules, article 2; American football, NFL rulebook,
rule 1 (hash marks of the NFL, 70 ft 9 in from each sideline).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

YARD, FOOT, INCH = 0.9144, 0.3048, 0.0254


@dataclass(frozen=True, slots=True, kw_only=True)
class PitchTemplate:
    """points: name to (X, Y); lines: (X0, Y0, X1, Y1); circles: (X, Y, radius), whole or in part drawn on the field."""

    name: str
    length_m: float
    width_m: float
    points: dict[str, tuple[float, float]]
    lines: tuple[tuple[float, float, float, float], ...]
    circles: tuple[tuple[float, float, float], ...]


def _mirrored(points: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    """Points named 'right far ...' (X, Y >= 0) in all four quarters."""
    found = {}
    for name, (x, y) in points.items():
        for side, sx in (("right", 1), ("left", -1)):
            for depth, sy in (("far", 1), ("near", -1)):
                found[f"{side} {depth} {name}"] = (sx * x, sy * y)
    return found


def _box(x0: float, y0: float, x1: float, y1: float) -> tuple[tuple[float, float, float, float], ...]:
    return ((x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0))


def football(length_m: float = 105.0, width_m: float = 68.0) -> PitchTemplate:
    """Association football. Penalty area 16.5 m beyond the posts (7.32 m apart), goal area 5.5 m, circle 9.15 m."""
    x, y, post = length_m / 2, width_m / 2, 3.66
    corners = {
        "corner": (x, y),
        "penalty area corner": (x - 16.5, post + 16.5),
        "penalty area at goal line": (x, post + 16.5),
        "goal area corner": (x - 5.5, post + 5.5),
        "goal area at goal line": (x, post + 5.5),
        "goal post": (x, post),
        # Where the arc of 9.15 m about the spot, 11 m from the line, meets the area's edge at 16.5 m.
        "arc at penalty area": (x - 16.5, (9.15**2 - 5.5**2) ** 0.5),
    }
    points = _mirrored(corners) | {
        "centre spot": (0.0, 0.0), "far halfway": (0.0, y), "near halfway": (0.0, -y),
        "far circle": (0.0, 9.15), "near circle": (0.0, -9.15),
        "left circle": (-9.15, 0.0), "right circle": (9.15, 0.0),
        "left penalty spot": (-x + 11, 0.0), "right penalty spot": (x - 11, 0.0),
    }  # fmt: skip
    lines = [*_box(-x, -y, x, y), (0.0, -y, 0.0, y)]
    for s in (-1, 1):
        lines += _box(s * x, -post - 16.5, s * (x - 16.5), post + 16.5)
        lines += _box(s * x, -post - 5.5, s * (x - 5.5), post + 5.5)
    circles = ((0.0, 0.0, 9.15), (-x + 11, 0.0, 9.15), (x - 11, 0.0, 9.15))
    return PitchTemplate(
        name="football",
        length_m=length_m,
        width_m=width_m,
        points=points,
        lines=tuple(lines),
        circles=circles,
    )


def basketball() -> PitchTemplate:
    """FIBA: 28 x 15 m, lane 5.8 x 4.9 m, three-point line 6.75 m about the basket, .9 m from the sidelines."""
    x, y, basket, arc = 14.0, 7.5, 14.0 - 1.575, 6.75
    side = y - 0.9
    meets = basket - (arc**2 - side**2) ** 0.5
    corners = {
        "corner": (x, y),
        "lane at free throw line": (x - 5.8, 2.45),
        "lane at end line": (x, 2.45),
        "three-point line at end line": (x, side),
        "three-point line bend": (meets, side),
    }
    points = _mirrored(corners) | {
        "centre spot": (0.0, 0.0), "far halfway": (0.0, y), "near halfway": (0.0, -y), "far circle": (0.0, 1.8),
        "near circle": (0.0, -1.8), "left circle": (-1.8, 0.0), "right circle": (1.8, 0.0),
    }  # fmt: skip
    lines = [*_box(-x, -y, x, y), (0.0, -y, 0.0, y)]
    for s in (-1, 1):
        lines += _box(s * x, -2.45, s * (x - 5.8), 2.45)
        lines += [(s * x, k * side, s * meets, k * side) for k in (-1, 1)]
    circles = (
        (0.0, 0.0, 1.8),
        *((s * (x - 5.8), 0.0, 1.8) for s in (-1, 1)),
        *((s * basket, 0.0, arc) for s in (-1, 1)),
    )
    return PitchTemplate(
        name="basketball", length_m=2 * x, width_m=2 * y, points=points, lines=tuple(lines), circles=circles
    )


def american_football() -> PitchTemplate:
    """NFL: 120 x 53 1/3 yards with the end zones. Points like 'left 20 far sideline', '50 near hash'."""
    x, y = 60 * YARD, 160 * FOOT / 2
    hash_y = y - (70 * FOOT + 9 * INCH)
    across = {"far sideline": y, "near sideline": -y, "far hash": hash_y, "near hash": -hash_y}
    points: dict[str, tuple[float, float]] = {}
    lines = list(_box(-x, -y, x, y))
    for yards in range(0, 51, 5):
        for side, s in (("left", -1), ("right", 1)):
            at = s * (50 - yards) * YARD
            label = "50" if yards == 50 else f"{side} {'goal' if yards == 0 else yards}"
            points |= {f"{label} {name}": (at, value) for name, value in across.items()}
            lines.append((at, -y, at, y))
    points |= {
        f"{s} {d} corner": (sx * x, sy * y)
        for s, sx in (("left", -1), ("right", 1))
        for d, sy in (("far", 1), ("near", -1))
    }
    return PitchTemplate(
        name="american-football", length_m=2 * x, width_m=2 * y, points=points,
        lines=tuple(dict.fromkeys(lines)), circles=(),
    )  # fmt: skip


TEMPLATES: dict[str, Callable[[], PitchTemplate]] = {
    "football": football,
    "basketball": basketball,
    "american-football": american_football,
}


def template_named(text: str) -> PitchTemplate:
    """'football', 'football:100x64' (length x width, m), 'basketball', ... Raises ValueError that lists the names."""
    name, _, size = text.partition(":")
    if name == "football" and size:
        length, _, width = size.partition("x")
        try:
            return football(float(length), float(width))
        except ValueError:
            raise ValueError(f"the size of a football pitch is LENGTHxWIDTH in m, not {size!r}") from None
    if name not in TEMPLATES or size:
        raise ValueError(f"no template is called {text!r}: {', '.join(TEMPLATES)}")
    return TEMPLATES[name]()

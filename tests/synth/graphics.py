"""What is fixed on the screen: an opaque scoreboard with a running clock, a half-transparent channel logo."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlay:
    """rgba (h, w, 4) float32 0..255, alpha 0..1, at (x, y); clock_at: where a clock is written, None: nowhere."""

    rgba: np.ndarray
    x: int
    y: int
    clock_at: tuple[int, int] | None = None
    clock_scale: float = 1.0

    def draw(self, image: np.ndarray, mask: np.ndarray, time_s: float) -> None:
        """Blend into image (h, w, 3) uint8 and mark mask (h, w) bool."""
        rgba = self.rgba
        if self.clock_at is not None:
            rgb = np.ascontiguousarray(rgba[..., :3].astype(np.uint8))
            text = f"{27 + int(time_s) // 60:02d}:{(14 + int(time_s)) % 60:02d}"
            thick = max(1, round(1.6 * self.clock_scale))
            cv2.putText(
                rgb,
                text,
                self.clock_at,
                cv2.FONT_HERSHEY_DUPLEX,
                self.clock_scale,
                (255, 255, 255),
                thick,
                cv2.LINE_AA,
            )
            rgba = np.dstack([rgb.astype(np.float32), rgba[..., 3]])
        h, w = rgba.shape[:2]
        part = image[self.y : self.y + h, self.x : self.x + w]
        alpha = rgba[..., 3:]
        part[:] = (part * (1 - alpha) + rgba[..., :3] * alpha + 0.5).astype(np.uint8)
        mask[self.y : self.y + h, self.x : self.x + w] |= alpha[..., 0] > 0


def scoreboard(width: int, height: int) -> Overlay:
    """Opaque box, top left, about 1.6 % of the picture."""
    w, h = round(width * 0.26), round(height * 0.06)
    box = np.zeros((h, w, 3), np.uint8)
    box[:] = (18, 24, 48)
    box[:, : w // 3] = (170, 20, 40)
    box[:, 2 * w // 3 :] = (40, 40, 44)
    box[: max(1, h // 14)] = (235, 200, 60)
    scale = h / 48
    thick = max(1, round(1.8 * scale))
    for text, x in (("NOR 2", 0.04), ("1 SUD", 0.375)):
        cv2.putText(
            box,
            text,
            (round(w * x), round(h * 0.74)),
            cv2.FONT_HERSHEY_DUPLEX,
            scale,
            (255, 255, 255),
            thick,
            cv2.LINE_AA,
        )
    rgba = np.dstack([box.astype(np.float32), np.ones((h, w), np.float32)])
    return Overlay(
        rgba=rgba,
        x=round(width * 0.05),
        y=round(height * 0.06),
        clock_at=(round(w * 0.72), round(h * 0.74)),
        clock_scale=scale,
    )


def logo(width: int, height: int) -> Overlay:
    """Ring and letters at alpha .5, top right."""
    size = round(height * 0.11)
    fine = np.zeros((4 * size, 4 * size), np.uint8)
    cv2.circle(fine, (2 * size, 2 * size), round(1.75 * size), 255, round(0.34 * size), cv2.LINE_AA)
    cv2.putText(
        fine,
        "BM",
        (round(0.85 * size), round(2.55 * size)),
        cv2.FONT_HERSHEY_DUPLEX,
        size / 22,
        255,
        max(1, size // 6),
        cv2.LINE_AA,
    )
    alpha = cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA).astype(np.float32) / 255 * 0.5
    rgba = np.dstack([np.full((size, size, 3), 250, np.float32), alpha])
    return Overlay(rgba=rgba, x=round(width * 0.95) - size, y=round(height * 0.05))

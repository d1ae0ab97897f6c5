"""What is fixed on the screen: a scoreboard with a running clock, a half-transparent channel logo, a running ticker."""

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
    runs_px_s: float = 0.0  # speed of the letters that run behind the part left of runs_from, 0: none
    runs_from: int = 0
    running: np.ndarray | None = None  # (h, any, 3) uint8, repeated

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
        if self.running is not None:
            rgba = rgba.copy()
            at = (np.arange(w - self.runs_from) + round(self.runs_px_s * time_s)) % self.running.shape[1]
            rgba[:, self.runs_from :, :3] = self.running[:, at]
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


def ticker(width: int, height: int) -> Overlay:
    """Opaque bar over the lower 60 % of the width: a label that stands, news that run by."""
    w, h = round(width * 0.6), round(height * 0.055)
    scale = h / 44
    thick = max(1, round(1.8 * scale))

    def lettered(length: int, colour: tuple[int, int, int], text: str) -> np.ndarray:
        bar = np.zeros((h, length, 3), np.uint8)
        bar[:] = colour
        cv2.putText(
            bar, text, (round(0.15 * h), round(h * 0.74)), cv2.FONT_HERSHEY_DUPLEX, scale, (255, 255, 255), thick,
            cv2.LINE_AA,
        )  # fmt: skip
        return bar

    label = lettered(w // 5, (190, 30, 30), "NEWS")
    running = lettered(
        3 * w, (24, 26, 34), "CUP FINAL ON SUNDAY + TRANSFER OF THE YEAR + RAIN IN THE NORTH + "
    )
    box = np.concatenate([label, running[:, : w - w // 5]], axis=1).astype(np.float32)
    return Overlay(
        rgba=np.dstack([box, np.ones((h, w), np.float32)]),
        x=round(width * 0.2),
        y=round(height * 0.9),
        runs_px_s=width * 0.08,
        runs_from=w // 5,
        running=running,
    )

"""A picture as a researcher has it (array or tensor, gray or RGB, 8 bits or float) to the gray that registration takes.

Imports no torch: a tensor is recognised by what it can do.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Rec. 601 luma, as cv2.cvtColor and kornia.color.rgb_to_grayscale take it: registration needs the same weights in both
# pictures, not the right ones.
LUMA = (0.299, 0.587, 0.114)


def as_planes(picture: Any) -> NDArray[Any]:
    """(h, w) or (h, w, 3) numpy from a numpy picture or a tensor (H, W), (C, H, W), (1, C, H, W), C = 1 or 3.

    Raises TypeError for anything else, ValueError for another shape; both say what they were given.
    """
    if hasattr(picture, "detach") and hasattr(picture, "cpu"):
        planes = np.asarray(picture.detach().cpu().numpy())
        if planes.ndim == 4 and planes.shape[0] == 1:
            planes = planes[0]
        if planes.ndim == 3 and planes.shape[0] in (1, 3):
            planes = planes[0] if planes.shape[0] == 1 else np.moveaxis(planes, 0, -1)
        if planes.ndim == 2 or (planes.ndim == 3 and planes.shape[-1] == 3):
            return planes
        raise ValueError(
            f"tensor (H, W), (C, H, W) or (1, C, H, W) with C = 1 or 3 expected, got {tuple(picture.shape)}"
        )
    if not isinstance(picture, np.ndarray):
        raise TypeError(f"numpy array or torch tensor expected, got {type(picture).__name__}")
    if picture.ndim == 3 and picture.shape[2] == 1:
        return picture[:, :, 0]
    if picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] == 3):
        return picture
    raise ValueError(f"array (h, w), (h, w, 1) or (h, w, 3) expected, got {picture.shape}")


def white_of(*pictures: NDArray[Any]) -> float:
    """What white is in pictures that belong together: 255 or 65535 by type; floats: 1 where none exceeds 1.5, else 255.

    Floats are judged together, so that a dark picture is not taken for one of the other range. Raises TypeError for
    types without such a rule (bool, signed and 32-bit integers), ValueError for types that do not go together.
    """
    types = {picture.dtype for picture in pictures}
    if types == {np.dtype(np.uint8)}:
        return 255.0
    if types == {np.dtype(np.uint16)}:
        return 65535.0
    if all(np.issubdtype(kind, np.floating) for kind in types):
        return 1.0 if max(float(np.max(p, initial=0.0)) for p in pictures) <= 1.5 else 255.0
    if len(types) > 1:
        raise ValueError(
            f"pictures of one type expected, got {sorted(str(kind) for kind in types)}; or say white="
        )
    raise TypeError(f"uint8, uint16 or float picture expected, got {types.pop()}; or say white=")


def as_gray(planes: NDArray[Any], white: float) -> NDArray[np.generic]:
    """Gray (h, w) with white at 255: uint8 for a uint8 gray picture with white 255, else float32.

    Raises ValueError for values that are not finite: such pixels are to be masked and given a value.
    """
    if planes.ndim == 2 and planes.dtype == np.uint8 and white == 255.0:
        return np.ascontiguousarray(planes)
    gray = planes @ np.array(LUMA, np.float32) if planes.ndim == 3 else planes
    gray = np.ascontiguousarray(gray, np.float32) * np.float32(255.0 / white)
    if not np.isfinite(gray).all():
        bad = int((~np.isfinite(gray)).sum())
        raise ValueError(f"{bad} pixels are not finite; fill them and mask them out")
    return gray


def as_mask(mask: Any, size_px: tuple[int, int]) -> NDArray[np.bool_] | None:
    """Mask (h, w) bool, True = usable, from bool or number (> 0) of shape (h, w) or a tensor; None stays None.

    Raises ValueError when it does not match the picture.
    """
    if mask is None:
        return None
    planes = as_planes(mask)
    if planes.shape != (size_px[1], size_px[0]):
        raise ValueError(f"mask {planes.shape} does not match the picture {(size_px[1], size_px[0])}")
    return planes if planes.dtype == np.bool_ else planes > 0

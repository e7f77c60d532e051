"""Conversion of linear RGB of other primaries, and of CIE XYZ, to the primaries of Rec. 709, which wlm uses everywhere.

White is adapted by the Bradford transform, as in ACES and ICC profiles, so that white stays white. CIE XYZ is converted
without adaptation.
"""

from collections.abc import Sequence

import numpy as np

from wlm.errors import WlmError

REC709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""The chromaticities x, y of red, green, blue and white of Rec. 709 and sRGB."""

CIE_XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
"""The chromaticities that mark CIE XYZ in the place of RGB."""

ACES_AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
"""The chromaticities of ACES2065-1."""

ACES_AP1 = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
"""The chromaticities of ACEScg."""

REC2020 = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)
P3_D65 = (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329)
ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.329)

_NAMES = {
    CIE_XYZ: "CIE XYZ",
    ACES_AP0: "ACES AP0",
    ACES_AP1: "ACES AP1 (ACEScg)",
    REC2020: "Rec. 2020",
    P3_D65: "P3 D65",
    ADOBE_RGB: "Adobe RGB",
}
_CLOSE = 2e-3  # files round chromaticities to two or three digits
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
_SINGULAR = 1e3  # condition number of primaries that are no longer distinct; that of AP0 is 2


def to_rec709(pixels: np.ndarray, chromaticities: Sequence[float], where: str, notes: list[str]) -> None:
    """Converts linear light, float32 [..., at least 3], to the primaries of Rec. 709, in place; channels after the
    third are kept.

    `chromaticities` are x, y of red, green, blue and white; `where` names the file and its field in messages. `notes`
    gets a line if the chromaticities are not those of Rec. 709.
    """
    if _close(chromaticities, REC709):
        return
    name = next((text for known, text in _NAMES.items() if _close(chromaticities, known)), "")
    ours = _to_xyz(REC709)
    theirs = _to_xyz(chromaticities)
    if theirs is None or ours is None:
        raise WlmError(
            f"{where}: expected the chromaticities of three primaries and white, found {_text(chromaticities)}"
        )
    if name != "CIE XYZ":
        ratio = (_BRADFORD @ ours.sum(1)) / (_BRADFORD @ theirs.sum(1))
        theirs = np.linalg.inv(_BRADFORD) @ np.diag(ratio) @ _BRADFORD @ theirs
    matrix = (np.linalg.inv(ours) @ theirs).astype(np.float32)
    with np.errstate(invalid="ignore", over="ignore"):  # the caller checks the values
        pixels[..., :3] = pixels[..., :3] @ matrix.T
    notes.append(f"converted to Rec. 709 from {name or f'the primaries {_text(chromaticities)}'}")


def _close(one: Sequence[float], other: Sequence[float]) -> bool:
    return all(abs(a - b) <= _CLOSE for a, b in zip(one, other, strict=True))


def _to_xyz(chromaticities: Sequence[float]) -> np.ndarray | None:
    """Returns the matrix [3, 3] from RGB to CIE XYZ, with white at Y = 1; None if there is none."""
    x, y = np.asarray(chromaticities, np.float64).reshape(4, 2).T
    if not (np.isfinite(x).all() and np.isfinite(y).all() and y[3] > 0):
        return None
    columns = np.stack([x, y, 1.0 - x - y])
    if np.linalg.cond(columns[:, :3]) > _SINGULAR:
        return None
    return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3] / y[3])


def _text(chromaticities: Sequence[float]) -> str:
    return " ".join(f"{number:.4g}" for number in chromaticities)

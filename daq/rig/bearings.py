"""Geometry of common ball bearings by designation, for the kinematic orders.

Ring and ball dimensions inside a bearing are not standardised: makers differ by 1 to 2 % in the pitch diameter, which
moves a defect order by less than 0.5 %. Values in the rig file go first.
"""

from __future__ import annotations

BEARING_GEOMETRIES: dict[str, dict[str, int | float]] = {
    # Case Western Reserve University Bearing Data Center, bearing information (SKF 6203-2RS JEM, 6205-2RS JEM)
    "6203": {"balls": 8, "ball_diameter_mm": 6.746, "pitch_diameter_mm": 28.50},
    "6205": {"balls": 9, "ball_diameter_mm": 7.940, "pitch_diameter_mm": 39.04},
    # Wang et al., IEEE Trans. Reliability 69 (2020): XJTU-SY bearing data sets (LDK UER204)
    "UER204": {"balls": 8, "ball_diameter_mm": 7.92, "pitch_diameter_mm": 34.55},
    # Huang & Baddour, Data in Brief 21 (2018): University of Ottawa bearing data (ER16K)
    "ER16K": {"balls": 9, "ball_diameter_mm": 7.94, "pitch_diameter_mm": 38.52},
}


def of_designation(name: str) -> dict[str, int | float] | None:
    """The geometry of a bearing; None where the table lacks it.

    name : designation. Suffixes of seals, cages and clearance ("6205-2RS", "6205 C3") are left out: they do not change
    the geometry.
    """
    word = name.upper().replace("SKF", "").strip()
    first = word.split()[0].split("/")[0] if word else ""
    for known, geometry in BEARING_GEOMETRIES.items():
        rest = first.removeprefix(known)
        if first.replace("-", "").startswith(known) and not rest[:1].isdigit():
            return geometry
    return None

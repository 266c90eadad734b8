"""Independent methods of the literature: Fokker-Planck density and score matching."""

from .fokker_planck import Form, fokker_planck_parameters
from .plane_moments import PlaneMoments
from .planes import Cap, Plane
from .score_matching import RollingScoreMatching
from .stationary import plane_diagnostics

__all__ = [
    "Cap",
    "Form",
    "Plane",
    "PlaneMoments",
    "RollingScoreMatching",
    "fokker_planck_parameters",
    "plane_diagnostics",
]

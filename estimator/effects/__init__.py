"""The catalogue: one effect per file, listed by hand. A new effect is its file, its test and a line here."""

from dataclasses import replace

from estimator.effects.damping.bouc_wen import BOUC_WEN
from estimator.effects.damping.coulomb import COULOMB
from estimator.effects.damping.displacement_damping import DISPLACEMENT_DAMPING
from estimator.effects.damping.quadratic_damping import QUADRATIC_DAMPING
from estimator.effects.damping.stribeck import STRIBECK
from estimator.effects.excitation.coloured_excitation import COLOURED_EXCITATION
from estimator.effects.excitation.correlated_force import CORRELATED_FORCE
from estimator.effects.excitation.line import LINE
from estimator.effects.excitation.pedestal import PEDESTAL
from estimator.effects.rotating.ball_pass import BALL_PASS
from estimator.effects.rotating.bow import BOW
from estimator.effects.rotating.crack import CRACK
from estimator.effects.rotating.cross_coupling import CROSS_COUPLING
from estimator.effects.rotating.gyroscopic import GYROSCOPIC
from estimator.effects.rotating.imbalance import IMBALANCE
from estimator.effects.rotating.local_defect import LOCAL_DEFECT
from estimator.effects.rotating.misalignment import MISALIGNMENT
from estimator.effects.rotating.rub import RUB
from estimator.effects.sensor.sensor_clipping import SENSOR_CLIPPING
from estimator.effects.sensor.sensor_gain import SENSOR_GAIN
from estimator.effects.sensor.sensor_noise import SENSOR_NOISE
from estimator.effects.sensor.sensor_resonance import SENSOR_RESONANCE
from estimator.effects.sensor.sensor_skew import SENSOR_SKEW
from estimator.effects.stiffness.anisotropy import ANISOTROPY
from estimator.effects.stiffness.clearance import CLEARANCE
from estimator.effects.stiffness.cubic import CUBIC
from estimator.effects.stiffness.hertz import HERTZ
from estimator.effects.stiffness.quadratic import QUADRATIC
from estimator.effects.stiffness.quintic import QUINTIC
from estimator.effects.stiffness.stiffness_drift import STIFFNESS_DRIFT
from estimator.effects.stiffness.stop import STOP
from estimator.model.effect import Effect, FoundBy

from .places import places

__all__ = ["CATALOGUE", "LINE_NAMES", "MORE_LINES", "NAMED", "found_by", "places"]

_CATALOGUE_EFFECTS = (
    CUBIC, QUINTIC, QUADRATIC, CLEARANCE, STOP, HERTZ, COULOMB, STRIBECK, QUADRATIC_DAMPING, DISPLACEMENT_DAMPING,
    BOUC_WEN, IMBALANCE, MISALIGNMENT, BOW, BALL_PASS, LOCAL_DEFECT, CRACK, RUB, CROSS_COUPLING, ANISOTROPY,
    GYROSCOPIC, PEDESTAL, STIFFNESS_DRIFT, CORRELATED_FORCE, COLOURED_EXCITATION, LINE, SENSOR_GAIN,
    SENSOR_CLIPPING, SENSOR_SKEW, SENSOR_RESONANCE, SENSOR_NOISE,
)  # fmt: skip
CATALOGUE: dict[str, Effect] = {effect.name: effect for effect in _CATALOGUE_EFFECTS}

MORE_LINES = {f"line_{k}": replace(LINE, name=f"line_{k}") for k in range(2, 10)}  # a place may have more than one
LINE_NAMES = (LINE.name, *MORE_LINES)
NAMED = CATALOGUE | MORE_LINES  # what a model's effects may be called


def found_by(name: str) -> FoundBy:
    """Data from which the parameters of an effect of this name are estimated; "law" for a user's own law.

    Parameters
    ----------
    name : str
        Name of an effect.
    """
    return NAMED[name].found_by if name in NAMED else "law"

"""The catalogue: one effect per file, listed by hand. A new effect is its file, its test and a line here."""

from dataclasses import replace

from estimator.model.effect import Effect

from .anisotropy import ANISOTROPY
from .ball_pass import BALL_PASS
from .bouc_wen import BOUC_WEN
from .bow import BOW
from .clearance import CLEARANCE
from .coloured_excitation import COLOURED_EXCITATION
from .correlated_force import CORRELATED_FORCE
from .coulomb import COULOMB
from .crack import CRACK
from .cross_coupling import CROSS_COUPLING
from .cubic import CUBIC
from .displacement_damping import DISPLACEMENT_DAMPING
from .gyroscopic import GYROSCOPIC
from .hertz import HERTZ
from .imbalance import IMBALANCE
from .line import LINE
from .local_defect import LOCAL_DEFECT
from .misalignment import MISALIGNMENT
from .pedestal import PEDESTAL
from .quadratic import QUADRATIC
from .quadratic_damping import QUADRATIC_DAMPING
from .quintic import QUINTIC
from .rub import RUB
from .sensor_clipping import SENSOR_CLIPPING
from .sensor_gain import SENSOR_GAIN
from .sensor_noise import SENSOR_NOISE
from .sensor_resonance import SENSOR_RESONANCE
from .sensor_skew import SENSOR_SKEW
from .stiffness_drift import STIFFNESS_DRIFT
from .stop import STOP

CATALOGUE: dict[str, Effect] = {
    "cubic": CUBIC,
    "quintic": QUINTIC,
    "quadratic": QUADRATIC,
    "clearance": CLEARANCE,
    "stop": STOP,
    "hertz": HERTZ,
    "coulomb": COULOMB,
    "quadratic_damping": QUADRATIC_DAMPING,
    "displacement_damping": DISPLACEMENT_DAMPING,
    "bouc_wen": BOUC_WEN,
    "imbalance": IMBALANCE,
    "misalignment": MISALIGNMENT,
    "bow": BOW,
    "ball_pass": BALL_PASS,
    "local_defect": LOCAL_DEFECT,
    "crack": CRACK,
    "rub": RUB,
    "cross_coupling": CROSS_COUPLING,
    "anisotropy": ANISOTROPY,
    "gyroscopic": GYROSCOPIC,
    "pedestal": PEDESTAL,
    "stiffness_drift": STIFFNESS_DRIFT,
    "correlated_force": CORRELATED_FORCE,
    "coloured_excitation": COLOURED_EXCITATION,
    "line": LINE,
    "sensor_gain": SENSOR_GAIN,
    "sensor_clipping": SENSOR_CLIPPING,
    "sensor_skew": SENSOR_SKEW,
    "sensor_resonance": SENSOR_RESONANCE,
    "sensor_noise": SENSOR_NOISE,
}

MORE_LINES = {f"line_{k}": replace(LINE, name=f"line_{k}") for k in range(2, 10)}  # a place may have more than one
NAMED = CATALOGUE | MORE_LINES  # what a model's effects may be called

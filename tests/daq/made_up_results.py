"""Results of a comparison, a diagnosis and an improvement, made up, for what draws them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

CHANNELS = ("b1x", "b1y", "b2x", "b2y")


def compared(missing: float, dead_zone: float) -> dict[str, Any]:
    """A comparison of a model that lacks a clearance of strength `dead_zone`, made up."""
    rng = np.random.default_rng(3)
    x, v = np.linspace(-9e-8, 9e-8, 41), np.linspace(-6e-4, 6e-4, 41)
    curves = []
    for channel in CHANNELS:
        size = dead_zone if channel.startswith("b1") else 0.0
        for against, at in (("displacement", x), ("velocity", v), ("shaft_angle", np.linspace(0, 360, 25))):
            law = np.sign(at) * np.maximum(np.abs(at) - 4e-8, 0) * 8e6 if against == "displacement" else 0 * at
            force = size * law + rng.normal(size=len(at)) * 0.004
            wide = 0.01 + 0.02 * np.abs(at / at.max()) ** 3
            curves.append(
                {"channel": channel, "against": against, "at": at.tolist(), "force": force.tolist()}
                | {"band_low": (force - wide).tolist(), "band_high": (force + wide).tolist()}
            )
    laws = [
        {"channel": c["channel"], "against": c["against"], "at": c["at"], "measured": c["force"]}
        | {"band_low": c["band_low"], "band_high": c["band_high"], "model": [0.0] * len(c["at"])}
        for c in curves
        if c["against"] in ("displacement", "velocity")
    ]
    f = np.geomspace(150, 8000, 300)
    spectra = {}
    for k, c in enumerate(CHANNELS):
        measured = f**4 / ((1.0 - (f / (1100 + 30 * k)) ** 2) ** 2 + (0.04 * f / 1100) ** 2) * 1e-15
        model = measured * (1 + dead_zone * np.exp(-(((f - 1300) / 200) ** 2)))
        noisy = measured * rng.gamma(20, 1 / 20, len(f))
        spectra[c] = {"frequency_hz": f.tolist(), "measured": noisy.tolist(), "model": model.tolist()}
    p = np.exp(-((x / 2.3e-8) ** 2) / 2) / (2.3e-8 * math.sqrt(2 * math.pi))
    t = np.linspace(0, 30, 900)
    orbit = [(4e-8 * np.cos(t) * np.cos(t / 7)).tolist(), (3e-8 * np.sin(t * 1.03)).tolist()]
    share = 70 * dead_zone
    names = [f"{b}.{d}" for b in ("bearing1", "bearing2") for d in "xy"]
    kL = {f"{n}.kL": {"value": 1.0e7 + 3e5, "sd": 4e4, "unit": "N/m", "identifiable": True} for n in names}
    lost = {
        "bearing1.x.m": {"value": None, "sd": None, "unit": "kg", "identifiable": False, "reason": "no displacement"}
    }
    return {
        "schema": 1,
        "heldout_nll": -1.2345 + missing / 1000,
        "reference_nll": -1.2360,
        "missing_force_percent": {"value": missing, "low": 0.8 * missing, "high": 1.2 * missing},
        "psd_distance_db": dict.fromkeys(CHANNELS, 0.4 + dead_zone),
        "pdf_distance": dict.fromkeys(CHANNELS, 0.01),
        "where": [{"channel": "b1x", "against": "displacement", "region": "|x| > 40 nm", "share_percent": share}]
        + [{"channel": c, "against": "velocity", "region": "all", "share_percent": 3.0} for c in CHANNELS],
        "adequate": missing < 1,
        "curves": curves,
        "laws": laws,
        "spectra": spectra,
        "densities": {c: {"at": x.tolist(), "measured": p.tolist(), "model": (p * 1.02).tolist()} for c in CHANNELS},
        "orbits": {b: {"measured": orbit, "model": orbit[::-1]} for b in ("bearing1", "bearing2")},
        "parameters": kL | lost,
        "messages": ["12 samples near full scale were left out"],
    }


def diagnosed(verdict: str = "clearance") -> dict[str, Any]:
    def row(effect: str, gain: float, p: float, after: float) -> dict[str, Any]:
        known = {"bearing1.x.clearance.k": {"value": 8e6, "sd": 3e5, "unit": "N/m", "identifiable": True}}
        limit = {"value": 2.0e5, "unit": "N/m"}
        return {"effect": effect, "at": ["bearing1.x", "bearing1.y"], "heldout_gain": gain, "p_value": p} | {
            "missing_force_before_percent": 12.0,
            "missing_force_after_percent": after,
            "parameters": known,
            "detectable_from": limit,
        }

    x = np.linspace(-9e-8, 9e-8, 31)
    shape = {"against": "displacement", "channel": "b1x", "at": x.tolist(), "force": (1e6 * x).tolist()}
    found = [row("clearance", 0.021, 1e-12, 0.6), row("stop", 0.011, 1e-6, 5.0), row("cubic", 0.004, 0.01, 9.0)]
    out = {"schema": 1, "verdict": verdict, "ranking": found}
    return out | ({"shape": shape} if verdict == "unknown" else {})


def made_up() -> dict[str, Any]:
    step = [{"value": 12.1, "low": 10.8, "high": 13.5}, {"value": 0.6, "low": 0.0, "high": 1.1}]
    ladder = [
        {"effects": ["cubic"], "heldout_nll": -1.2224, "missing_force_percent": step[0]},
        {"effects": ["cubic", "clearance"], "heldout_nll": -1.2339, "missing_force_percent": step[1]},
    ]
    return {
        "title": "Bearing comparison: tiwari_vyas_1997",
        "facts": {"log": "run.mcap", "rig": "rig.toml", "record": "60 s, 4 channels at 25600 Hz"},
        "comparison": compared(0.6, 0.02),
        "before": compared(12.1, 1.0),
        "diagnoses": [diagnosed(), diagnosed("complete")],
        "ladder": ladder,
        "notes": ["improvement stops here"],
        "rig_text": "schema = 1\n",
    }

"""The layers of a diagnosis in words: record, machine, structure, bearing, a few lines each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from .numbers import number, odds, unit_text

Json = Mapping[str, Any]
MAX_CHANNELS, MAX_TONES, MAX_STRIKES, MAX_MODES, MAX_FINDINGS = 4, 6, 3, 5, 5  # shown; --json has all
SPEED_SOURCES = {"tacho": "tacho", "record": "from the record", "rig file": "rig file"}


def lines(diagnosis: Json, units: Mapping[str, str]) -> list[tuple[str, str]]:
    """(layer, line) for people, in the order of the layers; the name of a layer stands in its first line alone.

    diagnosis : as JSON. units : channel -> SI unit.
    """
    out = []
    for name, lines_of in (
        ("record", _record),
        ("machine", _machine),
        ("structure", _structure),
        ("bearing", _bearing),
    ):
        if diagnosis.get(name):
            texts = lines_of(diagnosis[name], units)
            out += [(name if not k else "", text) for k, text in enumerate(texts)]
    return out


def _record(record: Json, units: Mapping[str, str]) -> Iterator[str]:
    channels = list(record["channels"].items())
    for name, level in channels[:MAX_CHANNELS]:
        yield f"{name}: {_level(level, units.get(name, ''))}"
    if len(channels) > MAX_CHANNELS:
        yield f"and {len(channels) - MAX_CHANNELS} other channels"
    yield from _first([finding["text"] for finding in record["findings"]], MAX_FINDINGS, "findings")


def _level(level: Json, unit: str) -> str:
    """Rms, peak, crest factor, kurtosis and velocity of a channel, as far as they are known."""
    if level["rms"] is None:
        return "no number is reliable" if level.get("void") else "no samples"
    said = [f"rms {number(level['rms'])} {unit_text(unit)}".strip()]
    said += [f"peak {number(level['peak'])}"] if level["peak"] is not None else []
    said += [f"{key} {level[key]:.1f}" for key in ("crest", "kurtosis") if level[key] is not None]
    if level["velocity_rms_mm_s"] is not None:
        zone = f", zone {level['zone']}" if level.get("zone") else ""
        said.append(f"velocity {number(level['velocity_rms_mm_s'])} mm/s rms (10 to 1000 Hz{zone})")
    return ", ".join(said)


def _machine(machine: Json, units: Mapping[str, str]) -> Iterator[str]:
    if speed := machine["speed_rpm"]:
        yield f"shaft {speed['value']:.5g} ± {number(speed['sd'], 1)} rpm ({SPEED_SOURCES[speed['source']]})"
    else:
        yield "shaft speed unknown: no order has a name"
    tones = sorted(machine["tones"], key=lambda tone: tone_name(tone) not in ("1X", "2X"))  # else as they come
    more = f"; and {len(tones) - MAX_TONES} others" if len(tones) > MAX_TONES else ""
    yield ("tones: " + "; ".join(map(tone_text, tones[:MAX_TONES])) + more) if tones else "no tones"
    trains = [strike_text(train) for train in machine["strikes"]]
    yield from _first(trains or ["no strike train"], MAX_STRIKES, "trains")


def tone_name(tone: Json) -> str:
    """ "2X", "mains 100 Hz" or the frequency."""
    if tone["kind"] == "order":
        return f"{tone['order']:g}X"
    hz = f"{tone['frequency_hz']:.5g} Hz"
    return f"mains {hz}" if tone["kind"] == "mains" else hz


def tone_text(tone: Json) -> str:
    """Name, frequency and largest amplitude of a tone."""
    channel, amplitude = max(tone["amplitude"].items(), key=lambda item: item[1])
    hz = f" {tone['frequency_hz']:.5g} Hz" if tone["kind"] == "order" else ""
    return f"{tone_name(tone)}{hz} ({channel} {number(amplitude)} {unit_text(tone['unit'])})"


def strike_text(train: Json) -> str:
    """One line about a strike train."""
    name = "strikes" if train["name"] == "other" else f"{train['name']} strikes"
    if train["order"] is None:
        where = f"{train['frequency_hz']:.5g} Hz"
    else:
        where = f"order {train['order']:.4g}"
        if train["slip_percent"] is not None:
            where += f" (slip {train['slip_percent']:+.2g} %)"
    how = f"p {odds(train['p_value'])}, severity {train['severity']:.2g}"
    return f"{name}: {where}, clearest in {train['channel']}, {how}"


def _structure(structure: Json, units: Mapping[str, str]) -> Iterator[str]:
    modes = [_mode(mode) for mode in structure["modes"][:MAX_MODES]]
    more = len(structure["modes"]) - len(modes)
    yield ("modes: " + "; ".join(modes) + (f"; and {more} others" if more else "")) if modes else "no mode in the band"


def _mode(mode: Json) -> str:
    """Place, frequency and damping ratio of a mode."""
    sd = f" ± {number(mode['frequency_sd'], 2)}" if mode["frequency_sd"] else ""
    whose = ", the bearing's" if mode["bearing"] else ""
    return f"{mode['place']} {mode['frequency_hz']:.4g}{sd} Hz (damping {100 * mode['damping']:.2g} %{whose})"


def _bearing(bearing: Json, units: Mapping[str, str]) -> Iterator[str]:
    yield "judged by the model of the rig file" if bearing["judged"] else f"cannot be judged here: {bearing['reason']}"


def _first(texts: Sequence[str], most: int, what: str) -> list[str]:
    """The first texts, and how many others there are."""
    more = len(texts) - most
    return [*texts[:most], *([f"and {more} other {what}: --json has them"] if more > 0 else [])]

"""The rig file: contract.md's own example, everything wrong at once, units, effects and where they act."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daq.base.contract.errors import ConfigError
from daq.commands.cli.app import main
from daq.rig.problems import line_numbers
from daq.rig.rig import Rig, load_rig
from daq.rig.units import UNITS_OF_KIND, canonical, factor
from daq.session.links import open_driver

CONFIGS = Path(__file__).parents[3] / "configs"
CHANNELS = "".join(
    f'[[channel]]\nname = "b{b}{d}"\nnode = "bearing{b}"\ndirection = "{d}"\nkind = "acceleration"\nunit = "m/s^2"\n'
    for b in (1, 2)
    for d in "xy"
)
HEAD = "schema = 1\n[band]\nlow = 150.0\nhigh = 8000.0\n"
CONTRACT = f"""
schema = 1
[rig]
name = "contract"
shaft = "chain"
speed_rpm = 2100.0
[rig.mass]
disc = 0.515
bearing1 = 0.2
bearing2 = 0.2
[rig.shaft_spring]
stiffness = 155e3
damping = 0.5
[rig.bearing]
balls = 6
ball_diameter_mm = 6.0
pitch_diameter_mm = 20.0
groove_radius_mm = 3.09
preload_um = 0.3
[band]
low = 150.0
high = 8000.0
[model]
effects = ["cubic"]
{CHANNELS}
"""


def problems(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        Rig.parse(text, where="rig.toml")
    return str(caught.value).splitlines()


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda p: p.name)
def test_every_shipped_rig_file_is_valid(path: Path) -> None:
    rig = load_rig(path)
    assert rig.path == path
    assert rig.model.places


@pytest.mark.parametrize("designation", ["6205", "SKF 6205-2RS/C3"])
def test_a_designation_stands_for_the_geometry_of_the_bearing(designation: str) -> None:
    text = HEAD + CHANNELS + "[rig.bearing]\n"
    bearing = Rig.parse(f'{text}designation = "{designation}"').model.bearing
    assert bearing is not None
    assert (bearing.balls, bearing.groove_radius) == (9, None)
    own = Rig.parse(f'{text}designation = "{designation}"\npitch_diameter_mm = 39.5').model.bearing
    assert own == replace(bearing, pitch_diameter=0.0395)
    assert "give balls" in problems(f'{text}designation = "9999"')[0]


def test_the_contracts_own_file_has_no_values_and_is_valid() -> None:
    model = Rig.parse(CONTRACT).model
    assert model.places == ("bearing1.x", "bearing1.y", "bearing2.x", "bearing2.y")
    assert all(s.value is None for table in model.linear.values() for s in table.values())
    assert model.effects[0].at == model.places
    assert model.bearing is not None
    assert model.bearing.preload == pytest.approx(0.3e-6)
    assert model.mass == {"disc": 0.515, "bearing1": 0.2, "bearing2": 0.2}


def test_everything_wrong_is_said_at_once_with_line_path_and_remedy() -> None:
    text = CONTRACT.replace('"chain"', '"chian"').replace("disc =", "disk =").replace("low = 150.0", "low = 9e3")
    text = text.replace('["cubic"]', '["cubik"]').replace('unit = "m/s^2"', 'unit = "mm"', 1) + "[extra]\n"
    found = problems(text)
    assert len(found) == 6
    for path, remedy in {
        "rig.shaft": 'did you mean "chain"',
        "rig.mass.disk": 'did you mean "disc"',
        "band.high": "not above low",
        "model.effects[0]": 'did you mean "cubic"',
        "channel[0].unit": "use m/s^2",
        "extra": "unknown key",
    }.items():
        (line,) = [f for f in found if f": {path}: " in f]
        assert remedy in line
        number = int(line.split(":")[1])
        assert path.split(".")[-1].split("[")[0] in text.splitlines()[number - 1]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("schema = 1", ""), "schema = 1 is missing"),
        (("schema = 1", "schema = 2"), "schema: 2 is not 1, the only value that is known"),
        (("[rig.shaft_spring]\nstiffness = 155e3\ndamping = 0.5", ""), "needs [rig.shaft_spring]"),
        (("pitch_diameter_mm = 20.0", "pitch_diameter_mm = 2.0"), "may be swapped"),
        (('name = "b1y"', 'name = "b1x"'), "channel[1].name"),
        (('direction = "y"', 'direction = "x"'), "already"),
        (('direction = "y"\n', ""), "channel[1].direction: is missing"),
        (("low = 150.0", "low = 0"), "cannot be integrated from 0 Hz"),
        (("disc = 0.515", "disc = nan"), "rig.mass.disc"),
        (("disc = 0.515", "disc = true"), "rig.mass.disc"),
        (('["cubic"]', '["cubic", "cubic"]'), "there twice"),
        (('["cubic"]', '["cubic"]\n[model.cubic]\nkNl = 1.0'), 'did you mean "kNL"'),
        (('["cubic"]', '["cubic"]\n[model.cubic]\nat = "bearing3"'), 'cannot act at "bearing3"'),
        (('["cubic"]', '["cubic"]\n[model.cubic]\nkNL = { value = 2.0, min = 3.0 }'), "beyond min"),
        (('["cubic"]', '["cubic"]\n[model.cubic]\nkNL = { fixed = true }'), "fixed without a value"),
        (('["cubic"]', "[]\n[model.cubic]\nkNL = 1.0"), "add it to model.effects"),
        (('["cubic"]', '[]\n[[model.custom]]\nname = "mine"'), "give expression or module"),
        (('["cubic"]', '[]\n[[model.custom]]\nname = "cubic"\nexpression = "x"'), "give the law another"),
        (("preload_um = 0.3", "preload_um = "), "not a TOML file"),
    ],
)
def test_each_mistake_has_its_words(change: tuple[str, str], said: str) -> None:
    assert CONTRACT.count(change[0]) >= 1
    assert any(said in line for line in problems(CONTRACT.replace(*change, 1)))


def test_no_channel_and_no_band_are_both_said() -> None:
    assert [line.split(": ")[1] for line in problems("schema = 1\n")] == ["band", "channel"]
    assert any("channel" in line for line in problems("schema = 1\nchannel = []\n[band]\nlow = 1.0\nhigh = 2.0\n"))


def test_one_bearing_alone_in_g_with_an_axial_channel() -> None:
    rig = Rig.parse(
        HEAD + '[[channel]]\nname = "a"\nnode = "bearing1"\ndirection = "x"\nunit = "g"\n'
        '[[channel]]\nname = "axial"\nnode = "bearing1"\ndirection = "z"\nunit = "m/s²"\n'
        '[[channel]]\nname = "pulse"\nkind = "tacho"\nunit = "V"\n'
    )
    assert rig.model.places == ("bearing1.x",)
    assert rig.model.shaft == "none"
    np.testing.assert_array_equal(rig.factors, [9.80665, 1.0, 1.0])
    assert rig.si_units[0] == "m/s^2"


def test_where_an_effect_acts_and_what_is_known_there() -> None:
    table = '[model]\neffects = ["cubic"]\n[model.cubic]\nkNL = 1e18\nat = ["bearing2", "b1y"]\n'
    table += "[model.cubic.bearing2.x]\nkNL = { value = 2e18, fixed = true, min = 0, max = 3e18 }\n"
    (use,) = Rig.parse(HEAD + table + CHANNELS).model.effects
    assert use.at == ("bearing1.y", "bearing2.x", "bearing2.y")
    assert use.parameters["bearing1.y"]["kNL"].value == 1e18
    own = use.parameters["bearing2.x"]["kNL"]
    assert (own.value, own.fixed, own.low, own.high) == (2e18, True, 0, 3e18)


@pytest.mark.parametrize(
    "table",
    [
        "kNL = 1e18\nat = 'bearing1'",
        "value = 1e18\nat = 'bearing1'",
        "kNL = { value = 1e18, at = 'bearing1' }",
        "[model.cubic.kNL]\nvalue = 1e18\nat = ['bearing1']",
        "at = ['b1x', 'b1y']\n[model.cubic.bearing1]\nkNL = 1e18",
    ],
)
def test_the_ways_to_say_a_value_and_a_place(table: str) -> None:
    text = HEAD + '[model]\neffects = ["cubic"]\n[model.cubic]\n' + table + "\n" + CHANNELS
    (use,) = Rig.parse(text.replace("[model.cubic]\n[model.cubic.kNL]", "[model.cubic.kNL]")).model.effects
    assert {place: p["kNL"].value for place, p in use.parameters.items()} == dict.fromkeys(
        ("bearing1.x", "bearing1.y"), 1e18
    )


def test_a_law_of_the_users_own_joins_the_effects() -> None:
    text = HEAD + (
        '[model]\neffects = ["soft_stop", "cubic"]\n[[model.custom]]\nname = "soft_stop"\nat = "bearing2"\n'
        'expression = "k*maximum(x - g, 0)"\n'
        'parameters = { k = { value = 1e6, unit = "N/m" }, g = { value = 1e-7, unit = "m" } }\n'
        "[model.soft_stop.bearing2.x]\nk = 2e6\n"
    )
    stop, cubic = Rig.parse(text + CHANNELS).model.effects
    assert cubic.name == "cubic"
    assert stop.custom is not None
    assert stop.custom.units == {"k": "N/m", "g": "m"}
    assert stop.at == ("bearing2.x", "bearing2.y")
    assert [stop.parameters[p]["k"].value for p in stop.at] == [2e6, 1e6]


LAW = '[[model.custom]]\nname = "mine"\nexpression = "{}"\nparameters = {{ k = 1.0 }}\n'
EFFECT = """
from dataclasses import replace
from estimator.effects.stiffness.quintic import QUINTIC
Mine = replace(QUINTIC, name="mine")
other = 3
"""


@pytest.mark.parametrize(
    ("expression", "said"),
    [
        ("k*gg", 'unknown name "gg"'),
        ("k*(x", "column"),
        ("__import__('os')", "column"),
        ("k*gg + " + "x + " * 30 + "x", 'x ...": unknown name "gg"'),
    ],
)
def test_a_wrong_expression_is_said_with_its_position(expression: str, said: str) -> None:
    (line,) = problems(HEAD + LAW.format(expression) + CHANNELS)
    assert ": model.custom[0].expression: " in line
    assert said in line


def test_a_parameter_that_the_law_does_not_use_or_that_is_not_in_si_is_said_with_its_own_position() -> None:
    (line,) = problems(HEAD + LAW.format("x**3") + CHANNELS)
    assert ": model.custom[0].parameters.k: the expression does not use it" in line
    for unit, part in (("N/mm", "mm"), ("kN/m", "kN"), ("um", "um")):
        law = LAW.format("k*x").replace("k = 1.0", f'k = {{ value = 1.0, unit = "{unit}" }}')
        (line,) = problems(HEAD + law + CHANNELS)
        assert f'model.custom[0].parameters.k.unit: "{unit}": {part} is no SI unit' in line
    law = LAW.format("k*x").replace("k = 1.0", 'k = { value = 1.0, unit = "N s^0.5/m^1.5" }')
    assert Rig.parse(HEAD + law + CHANNELS).model.effects[0].name == "mine"


def test_a_law_from_a_module(tmp_path: Path) -> None:
    (tmp_path / "laws.py").write_text(EFFECT)
    law = '[[model.custom]]\nname = "mine"\nmodule = "laws.py:{}"\nparameters = {{ k5 = 1e30 }}\n'
    (tmp_path / "rig.toml").write_text(HEAD + law.format("Mine") + CHANNELS)
    rig = load_rig(tmp_path / "rig.toml")
    (use,) = rig.model.effects
    assert use.custom is not None
    assert use.custom.effect is not None
    assert use.custom.units == {"k5": "N/m^5"}
    assert use.parameters["bearing1.x"]["k5"].value == 1e30
    assert set(rig.attachments()) == {"rig.toml", "laws.py"}
    for name, said in (("Yours", "its effects are QUINTIC, Mine"), ("other", "is a int, not")):
        (tmp_path / "rig.toml").write_text(HEAD + law.format(name) + CHANNELS)
        with pytest.raises(ConfigError, match=said):
            load_rig(tmp_path / "rig.toml")
    (tmp_path / "laws.py").write_text("1/0")
    with pytest.raises(ConfigError, match="fails with ZeroDivisionError"):
        load_rig(tmp_path / "rig.toml")
    (tmp_path / "laws.py").write_text("raise SystemExit(3)")
    with pytest.raises(ConfigError, match="fails with SystemExit"):
        load_rig(tmp_path / "rig.toml")


def test_an_effect_of_the_disc_needs_a_shaft() -> None:
    (line,) = problems(HEAD + '[model]\neffects = ["imbalance"]\n' + CHANNELS)
    assert 'say rig.shaft = "chain" or "beam"' in line


@pytest.mark.parametrize(
    ("model", "at"),
    [
        ('effects = ["ball_pass"]\n', "model.effects[0]"),
        ('[[model.custom]]\nname = "own"\nexpression = "k*x*cos(phase)"\nparameters = { k = { value = 1.0 } }\n',
         "model.custom[0].expression"),
    ],
)  # fmt: skip
def test_what_goes_with_the_shaft_angle_needs_one(model: str, at: str) -> None:
    text = HEAD + "[model]\n" + model + CHANNELS
    (line,) = problems(text)
    assert f"{at}: " in line
    assert "give rig.speed_rpm or a tacho channel" in line
    Rig.parse(HEAD + "[rig]\nspeed_rpm = 100.0\n[model]\n" + model + CHANNELS)
    Rig.parse(text + '[[channel]]\nname = "turn"\nkind = "tacho"\nunit = "V"\n')


def test_masses_by_direction() -> None:
    rig = Rig.parse(HEAD + "[rig.mass]\nbearing1 = { x = 0.22, y = 0.245 }\nbearing2.x = 0.2\n" + CHANNELS)
    assert rig.model.mass == {"bearing1.x": 0.22, "bearing1.y": 0.245, "bearing2.x": 0.2}
    assert rig.model.cap_mass("bearing2.y") is None


def test_paths_start_at_the_rig_file(tmp_path: Path) -> None:
    (tmp_path / "x.dbc").write_text('VERSION ""\n')
    (tmp_path / "rig.toml").write_text(HEAD + CHANNELS + '[link]\ndbc = "x.dbc"\nsignals = { b1x = "A.B" }\n')
    rig = load_rig(tmp_path / "rig.toml")
    assert rig.dbc == tmp_path / "x.dbc"
    assert set(rig.attachments()) == {"rig.toml", "x.dbc"}


def test_a_missing_or_binary_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such rig file"):
        load_rig(tmp_path / "none.toml")
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not a UTF-8"):
        load_rig(tmp_path / "b.toml")


@pytest.mark.parametrize(
    "spelling", ["m/s^2", "m/s²", "m/s2", "m/s**2", "m / s^2", "m/s/s", "m·s⁻²", "m s-2", "ms^-2", "m*s^(-2)"]
)
def test_spellings_of_a_unit(spelling: str) -> None:
    assert canonical(spelling) == "m/s^2"


def test_a_unit_of_another_kind_names_its_kind() -> None:
    with pytest.raises(ValueError, match="one of displacement.*use m/s, mm/s"):
        factor("velocity", "um")
    assert factor("displacement", "µm") == 1e-6
    assert {kind: next(iter(u)) for kind, u in UNITS_OF_KIND.items()}["force"] == "N"


@given(st.text(max_size=300))
def test_any_text_is_read_or_refused_in_words(text: str) -> None:
    line_numbers(text)
    with pytest.raises(ConfigError):
        Rig.parse(text)


@pytest.mark.parametrize(("word", "least", "most"), [("none", 0, 0), ("usual", 5, 12), ("catalogue", 15, 31)])
def test_the_rig_says_what_the_rolling_estimator_watches_for(word: str, least: int, most: int) -> None:
    from daq.session.estimators import maker
    from estimator.identification.rolling.estimator import RollingEstimator

    rig = Rig.parse(HEAD + CHANNELS + f'[estimator]\nwatch = "{word}"\n')
    table = rig.estimator
    made = maker(table.method, table.time_constant_s, table.watch)(rig.model, 25_600.0)
    assert isinstance(made, RollingEstimator)
    assert least <= len(made.watch) <= most
    maker("score-matching", 10.0, table.watch)(rig.model, 25_600.0)


def test_what_no_rig_file_needs_is_refused_in_a_line(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """The library trips over some of it, and would take minutes over a key of thousands of levels."""
    hostile = {
        "lists or tables nested too deeply": "x = " + 2000 * "[" + 2000 * "]",
        "not a TOML file: Exceeds the limit": "x = " + 5000 * "9",
        "a key of more than 100 levels": "\n".join(f"[{'a.' * 4000}b{k}]" for k in range(20)),
        "larger than 200 kB": 50_000_000 * "#",
    }
    path = tmp_path / "rig.toml"
    for said, text in hostile.items():
        path.write_text(text)
        with pytest.raises(ConfigError, match=said) as error:
            load_rig(path)
        assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match="larger than 200 kB"):
        load_rig("/dev/zero")
    row = "hostile rig file | 50 MB, /dev/zero, 2000 levels of lists, keys of 4000 levels, a number of 5000 digits"
    record_property("reliability", f"{row} | one line, bounded memory and time | held")


@pytest.mark.parametrize(
    ("dbc", "said"), [("/dev/zero", "is not a file"), ("big.dbc", "larger than 64 MB"), ("no.dbc", "No such file")]
)
def test_a_dbc_without_end_is_refused(dbc: str, said: str, tmp_path: Path) -> None:
    with (tmp_path / "big.dbc").open("wb") as file:
        file.truncate(100 << 30)  # takes no room
    link = f'[link]\ndbc = "{dbc}"\nsignals = {{ b1x = "A.B" }}\n'
    rig = Rig.parse(HEAD + CHANNELS + link, tmp_path, tmp_path / "rig.toml")
    with pytest.raises(ConfigError, match=said):
        open_driver("capture:x.log", rig)


@pytest.mark.parametrize(
    ("right", "wrong", "hz"),
    [("bearing1 = 0.2 ", "bearing1 = 200 ", "35.6 Hz"), ("high = 8000.0", "high = 0.9e3", "1.13e+03 Hz"),
     ("kL = 10.0e6", "kL = 10.0e3", "35.6 Hz"), ("", "", "")],
)  # fmt: skip
def test_check_notes_a_resonance_outside_the_band(
    right: str, wrong: str, hz: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Grams, kilohertz, newtons a millimetre: each is a number that a rig file may hold."""
    path, text = tmp_path / "rig.toml", (CONFIGS / "tiwari_vyas_1997.toml").read_text().replace("= 0.2\n", "= 0.2 \n")
    assert right in text
    path.write_text(text.replace(right, wrong))
    assert main(["check", str(path)]) == 0
    said = capsys.readouterr().out
    assert ("resonates at" in said) is bool(hz)
    assert f"resonates at {hz}, outside the band of" in said or not hz


def test_the_anti_alias_filter_is_part_of_the_model() -> None:
    given = '[acquisition]\nrate_hz = 25600.0\nanti_alias = { kind = "bessel", order = 4, cutoff_hz = 9000.0 }\n'
    own = Rig.parse(CONTRACT + given, where="rig.toml").model.anti_alias
    assert own is not None
    assert (own.kind, own.order, own.cutoff_hz, own.ripple_db) == ("bessel", 4, 9000.0, None)
    (text,) = problems(CONTRACT + given.replace('"bessel", order = 4', '"fir", order = 40').replace("9000", "12900"))
    assert "acquisition.anti_alias.cutoff_hz" in text
    (text,) = problems(CONTRACT + given.replace("order = 4", "order = 40"))
    assert "at most 20 poles" in text

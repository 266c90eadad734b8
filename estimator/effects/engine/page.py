"""docs/effects.md, written from the catalogue: `python -m estimator.effects.engine.page > docs/effects.md`."""

from __future__ import annotations

import sys

from estimator.effects import CATALOGUE
from estimator.model.effect import Effect, EffectParameter

KIND_TEXTS = {
    "force": "force on a cap",
    "memory": "force on a cap, with states of its own",
    "disc": "force on the disc",
    "shaft": "force between the disc and the caps",
    "excitation": "shape of the unknown excitation",
    "sensor": "fault of a measured channel",
}
SCALE_TEXTS = {
    "x": "displacement rms",
    "v": "velocity rms",
    "a": "acceleration rms",
    "m": "cap mass",
    "hz_peak": "resonance sqrt(kL/m)",
    "sample": "sampling interval",
    "band": "upper band edge",
}
PAGE_HEAD = """# Effects

<!-- Written from the catalogue by `python -m estimator.effects.engine.page`: change the file of the effect. -->

**Conventions.** All SI. Laws are *restoring* forces on the left-hand side: `M a + C v + K x + sum(laws) = F`. `x, v`
are displacement and velocity of the cap in one direction, `xo, vo` those of the other direction of the same cap; for
an effect on the shaft they are disc minus mean of the caps. Rotation takes x to y; `phi` is the shaft angle from the
tacho pulse, Omega its rate, `t` time. `(.)_+` is the positive part.

**Linear stiffness and damping are always in the model**, so a law says what comes on top of `kL x + c v`. Hertz contact
is written less its tangent at rest: `kL` stays the whole stiffness there.

**Places.** An effect of scope *direction* has parameters of its own at `bearing1.x`, `bearing1.y`, ...; of scope
*node* one set for both directions of `bearing1`, `bearing2` or `disc`. correlated_force belongs to a direction and
stands at the first bearing.

**Limits.** *amplitude*: the law is proportional to it, so it is solved for and needs no start. *search*: looked for
between the limits, which are multiples of a natural size of the rig (displacement rms and so on). *given*: taken from
the rig file or the default.

| effect | law | may be confused with | exp(-H/T) survives |
|---|---|---|---|
"""
OWN_LAW_TEXT = """
## A law of your own

By expression, in the rig file:

    [[model.custom]]
    name = "soft_stop"
    expression = "k*maximum(x - g, 0)"
    parameters = { k = { value = 1e6, unit = "N/m" }, g = { value = 1e-7, unit = "m" } }

Names: `x v xo vo t phase`, the parameters, `pi`, `e`; numbers; `+ - * / // % **`, comparisons, `and or not`, `a if
condition else b`; and FUNCTIONS. Nothing else is accepted: no attributes, indices or other calls. Errors give the
column. A law that is not finite, a parameter that is not used and a name that does not exist are refused. Parameters
that the law is linear in are found by trying and solved for exactly; the others are searched between `min` and `max`,
or within a factor of 30 of `value`. With `candidate = true` the law is not in the model, but on trial when the model is
diagnosed, until `add` or `improve` puts it in.

By module, for laws with memory, coupling or sensor behaviour: `module = "my_effects.py:SOFT_STOP"` names an
`estimator.Effect` with its `estimator.EffectParameter`s. Its law is a plain function
`force(x, v, xo, vo, t, phase, s, p)` of scalars and the parameter array `p` that numba can compile.

How to add an effect to the catalogue: [contributing](../CONTRIBUTING.md#add-an-effect).
"""


def _range(p: EffectParameter) -> str:
    if p.linear:
        return "amplitude, at least 0" if p.low == 0.0 else "amplitude"
    if p.given:
        return f"given, {p.low:g} to {p.high:g}, default {p.default:g}"
    unit = f" x {SCALE_TEXTS[p.scale]}" if p.scale in SCALE_TEXTS else ""
    known = "; from the geometry if known" if p.scale == "bpfo" else ""
    return f"search {p.low:g} to {p.high:g}{unit}, default {p.default:g}{known}"


def escape(text: str) -> str:
    """The text for a cell of a Markdown table."""
    return text.replace("|", "\\|")


def section(effect: Effect) -> str:
    """The section of one effect in Markdown."""
    rows = "\n".join(f"| `{p.name}` | {p.unit} | {p.description} | {_range(p)} |" for p in effect.parameters)
    where = KIND_TEXTS[effect.kind] + (", one set for both directions" if effect.scope == "node" else "")
    return f"""
## {effect.name}

`{effect.equation}` ({where})

| parameter | unit | meaning | limits |
|---|---|---|---|
{rows}

- **Signature.** {effect.signature}.
- **Confused with** {", ".join(f"[{c}](#{c})" for c in effect.confused_with)}: {effect.distinguish}.
- **On the machine.** {effect.on_machine}.
- **Reference.** {effect.reference}.
- **Checked.** {effect.check}.
"""


def markdown() -> str:
    """The page of all effects in Markdown."""
    from .expression import FUNCTION_CODES

    table = "".join(
        f"| [{e.name}](#{e.name}) | `{escape(e.equation)}` | {', '.join(e.confused_with)} "
        f"| {'-' if e.kind == 'sensor' else 'yes' if e.stationary_density else 'no'} |\n"
        for e in CATALOGUE.values()
    )
    functions = ", ".join(f"`{name}`" for name in sorted(FUNCTION_CODES))
    return (
        PAGE_HEAD
        + table
        + "".join(section(e) for e in CATALOGUE.values())
        + OWN_LAW_TEXT.replace("FUNCTIONS", functions)
    )


if __name__ == "__main__":
    sys.stdout.write(markdown())

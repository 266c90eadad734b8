"""Of spectra of inferred forces the filter before them is found, whatever it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_effects import RATE, one_bearing
from numpy.typing import NDArray
from scipy import signal

from estimator.identification.structure.filter_search import (
    NO_NUMBERS,
    Seen,
    Standing,
    _spectrum,
    likeliest,
    mean_or_none,
)
from estimator.identification.structure.pedestal_form import stiffness_lost
from estimator.identification.structure.spectral_cells import MAX_CELLS, SpectralCells
from estimator.identification.structure.spectral_models import coloured_power, resonant_power
from estimator.model.recorder import Filter, images
from estimator.signals.channel_response import corrected_record
from estimator.signals.filter_designs import chebyshev, designs

Array = NDArray[np.float64]
TOP, MASS, BINS, BLOCKS = 8000.0, 0.2, 2000, 300
BLANK = Filter(RATE, TOP)


def seen(
    off: Filter, resonance_hz: float, S: float, seed: int, noise: float = 0.0,
    true: tuple[float, float] | None = None, undone: tuple[float, float] | None = None,
    force: tuple[float, float] | None = None, thought: tuple[float, float] | None = None,
    stands: tuple[float, float, float] | None = None, pedestal: Array = NO_NUMBERS,
) -> Seen:  # fmt: skip
    """A cap's cells behind a filter, its model 2 % off in k and 10 % in c; nothing is at the other caps. true, undone :
    Hz and quality of a resonance of its sensor, as it is and as it has been taken back. force, thought : gain and
    corner of the colour of the force, as it is and in the model. pedestal, stands : kg, Hz and
    damping of a pedestal, as it is and in the model."""
    f = np.linspace(200.0, TOP, BINS)
    edges = np.unique(np.round(np.geomspace(12, BINS, MAX_CELLS)).astype(int))
    n = np.diff(edges, prepend=0)
    w = 2 * np.pi * np.add.reduceat(f, edges - n) / n
    k, c = MASS * (2 * np.pi * resonance_hz) ** 2, 40.0
    A, one = MASS - k / w**2 + c / (1j * w), np.ones(w.size)
    standing = None if stands is None else Standing(k, c, stands)
    if stands is not None:
        A += stiffness_lost(w, k, c, np.array(stands)) / w**2
    none = np.zeros((0, w.size))
    through = np.abs(A) ** 2 / MASS**2
    white = np.stack([through, 0 * w])
    cells = SpectralCells(
        power=one,
        n=n.astype(float) * BLOCKS,
        w=w,
        A=A,
        force_shape=one,
        noise_gain=np.abs(A) ** 2,
        others=0 * w,
        aliased_gain=0 * w,
        white=white,
        echoes=none,
        images=none,
    )
    hz = w / (2 * np.pi)
    passed, echoes = off.passed(hz), off.echoes(hz, "acceleration")
    if true is not None and undone is not None:
        was = resonant_power(hz, *undone)
        passed, echoes = (
            passed * resonant_power(hz, *true) / was,
            echoes * resonant_power(images(RATE, hz), *true) / was,
        )
        cells = replace(cells, noise_gain=cells.noise_gain / was)
    if force is not None and thought is not None:
        cells = replace(cells, force_shape=coloured_power(hz, *thought))
        passed = passed * coloured_power(hz, *force) / cells.force_shape
    u = np.array([np.log(S), noise, 0.02 * k, -0.1 * c])
    own = Seen(cells, "acceleration", undone, thought, standing)
    mean = _spectrum(own, u, passed, echoes.sum(axis=0) * through, pedestal)[0]
    power = mean * np.random.default_rng(seed).gamma(cells.n) / cells.n
    return replace(own, cells=replace(cells, power=power))


def both(off: Filter) -> list[Seen]:
    return [seen(off, 1100.0, 0.01, 1), seen(off, 900.0, 0.004, 2, noise=1e-3)]


@pytest.mark.parametrize("order", [3, 4, 8])
def test_chebyshev_filters_are_those_of_scipy(order: int) -> None:
    f = np.linspace(0.0, 3.0, 50)
    H = signal.freqs(*signal.cheby1(order, 0.5, 1.0, analog=True), f)[1]
    assert Filter(1.0, 1.0, poles=chebyshev(order, 10**0.05 - 1)).passed(f) == pytest.approx(
        abs(H / H[0]) ** 2, rel=1e-6
    )


@pytest.mark.parametrize(
    ("off", "name"),
    [
        (replace(BLANK, poles=chebyshev(6, 0.12), cutoff_hz=10300.0), "Chebyshev filter of order 6"),
        (replace(BLANK, poles=(0.0, 1.0), cutoff_hz=9000.0), "Butterworth filter of order 2"),
        (replace(BLANK, poles=(0.0, 0.0, 0.0, 1.0), cutoff_hz=20000.0), "Butterworth filter of order 4"),
    ],
)
def test_a_design_is_found_with_its_cutoff(off: Filter, name: str) -> None:
    """The last lets through almost all that is above half the rate: of it searches from one cutoff found nothing."""
    places = both(off)
    information, found = likeliest(places, BLANK)
    assert found.name == name
    assert found.cutoff_hz == pytest.approx(off.cutoff_hz, rel=0.01)
    df = sum(own.cells.n.size for own in places)
    assert abs(information - df) < 4 * np.sqrt(2 * df)


def test_means_that_fold_back_half_as_much_again_are_found() -> None:
    off = replace(BLANK, means=1.0, echo=1.5)
    found = likeliest(both(off), BLANK)[1]
    assert not found.poles
    assert found.means == pytest.approx(1.0, abs=0.02)
    assert found.echo == pytest.approx(1.5, abs=0.05)


class Digital(Filter):
    """A Bessel filter of order 6 by the bilinear rule at ten times the rate, as scipy makes it."""

    poles_of = signal.bessel(6, 0.45 * RATE, fs=10 * RATE, norm="mag", output="sos")

    def passed(self, f_hz: Array) -> Array:
        H = signal.sosfreqz(self.poles_of, np.ravel(f_hz), fs=10 * RATE)[1].reshape(np.shape(f_hz))
        return np.asarray(np.where(f_hz < 5 * RATE, abs(H) ** 2, 0.0))


def test_poles_on_more_samples_than_are_kept_are_those_of_scipy() -> None:
    off, f = replace(BLANK, poles=designs()["Bessel filter of order 6"], kept=0.1), np.linspace(1.0, 6 * RATE, 500)
    off = replace(off, cutoff_hz=10 * RATE / np.pi * np.tan(0.045 * np.pi))
    assert off.passed(f) == pytest.approx(Digital(RATE, TOP).passed(f), rel=1e-6, abs=1e-12)
    f = f[f < TOP]
    delay = np.unwrap(np.angle(signal.sosfreqz(Digital.poles_of, f, fs=10 * RATE)[1] / off.response(f))) / f
    assert delay == pytest.approx(np.full(f.size, delay[0]), rel=1e-5)


def test_a_digital_filter_is_found_and_what_it_folds_is_no_noise_of_the_sensors() -> None:
    """A mean was found in its place, S up to 0.7 % high, of 0.15 % that was said: it fits as well, and what S is then
    is in what is in doubt. With the poles before the samples the deviance of a record was 57 more."""
    off = Digital(RATE, TOP)
    places = [seen(off, hz, S, k) for k, (hz, S) in enumerate(((1500.0, 0.01), (900.0, 0.004)))]
    information, found = likeliest(places, BLANK)
    f = np.linspace(200.0, TOP, 100)
    np.testing.assert_allclose(found.passed(f), off.passed(f), rtol=0.02)
    np.testing.assert_allclose(found.folded(f, "acceleration"), off.folded(f, "acceleration"), rtol=0.1)
    assert 1e-3 < found.doubt < 0.02
    df = sum(own.cells.n.size for own in places)
    assert abs(information - df) < 4 * np.sqrt(2 * df)


def test_what_is_folded_from_about_the_rate_is_no_noise_of_the_sensors() -> None:
    off = replace(BLANK, means=1.0, flat=0.02)
    places = [seen(off, hz, S, k) for k, (hz, S) in enumerate(((1500.0, 0.01), (900.0, 0.004)))]
    assert likeliest(places, BLANK)[1].flat == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize("resonance_hz", [700.0, 1100.0])
def test_a_mean_is_told_from_none_the_better_the_higher_the_resonance(resonance_hz: float) -> None:
    def asked(off: Filter) -> tuple[float, float]:
        return mean_or_none([seen(off, resonance_hz, 0.01, 1), seen(off, 0.8 * resonance_hz, 0.004, 2, 1e-3)], BLANK)

    gain, doubt = asked(replace(BLANK, means=1.0))
    cost, little = asked(replace(BLANK, nepers=(0.0,) * 5))
    assert gain > 0.0 > cost
    assert doubt > 10 * little
    assert (gain > 24.0) == (cost < -24.0) == (resonance_hz > 1000.0)


@pytest.mark.parametrize("true", [(5600.0, 12.0), (4000.0, 5.0)])
def test_a_mean_is_seen_where_a_sensor_resonates(true: tuple[float, float]) -> None:
    """Behind it a white acceleration stays white: the other place alone shows almost nothing of it."""
    off, undone = replace(BLANK, means=1.0), (0.994 * true[0], 0.94 * true[1])
    places = [seen(off, 1100.0, 0.01, 1, true=true, undone=undone), seen(off, 900.0, 0.004, 2, noise=1e-3)]
    information, found = likeliest(places, BLANK)
    assert not found.poles
    assert found.means == pytest.approx(1.0, abs=0.05)
    df = sum(own.cells.n.size for own in places)
    assert abs(information - df) < 4 * np.sqrt(2 * df)


@pytest.mark.parametrize(("gain", "corner"), [(12.0, 1900.0), (-0.7, 900.0)])
def test_a_filter_is_found_where_all_forces_have_a_colour(gain: float, corner: float) -> None:
    """The colours had taken over most of the fall, and a filter of a quarter of it was found."""
    off = replace(BLANK, poles=designs()["Bessel filter of order 6"], cutoff_hz=0.45 * RATE)
    thought = (1.2 * gain, 1.05 * corner)
    places = [seen(off, hz, 0.01, k, force=(gain, corner), thought=thought) for k, hz in enumerate((1100.0, 900.0))]
    information, found = likeliest(places, BLANK)
    f = np.linspace(200.0, TOP, 100)
    np.testing.assert_allclose(found.passed(f), off.passed(f), rtol=0.06)  # all that colours leave of it
    df = sum(own.cells.n.size for own in places)
    assert abs(information - df) < 4 * np.sqrt(2 * df)


def test_a_filter_is_found_where_every_cap_is_on_a_pedestal() -> None:
    """With the numbers that they had without the filter, a colour of every force fitted better than any filter."""
    off = replace(BLANK, poles=designs()["Bessel filter of order 6"], cutoff_hz=0.45 * RATE)
    places = [
        seen(off, hz, 0.01, k, stands=(0.1, 1.2 * hz, 0.05), pedestal=np.array([0.08, 1.32 * hz, 0.065]))
        for k, hz in enumerate((1100.0, 900.0))
    ]
    information, found = likeliest(places, BLANK)
    f = np.linspace(200.0, TOP, 100)
    np.testing.assert_allclose(found.passed(f), off.passed(f), rtol=0.06)  # all that the pedestals leave of it
    df = sum(own.cells.n.size for own in places)
    assert abs(information - df) < 4 * np.sqrt(2 * df)


@pytest.mark.parametrize("standing", [None, Standing(8e6, 40.0, (0.3, 1400.0, 0.05))])
def test_derivatives_are_those_of_the_spectrum(standing: Standing | None) -> None:
    own = seen(replace(BLANK, means=1.0), 1000.0, 0.01, 3)
    c = replace(own.cells, others=1e-3 / own.cells.w**0.5)
    own = replace(own, cells=c, standing=standing)
    hz = c.w / (2 * np.pi)
    passed, back = np.sinc(hz / RATE) ** 2, 0.1 * c.white[0]
    u, pedestal = np.array([-4.0, 1e-3, 1e5, 5.0]), np.array([0.36, 1330.0, 0.035])
    _, J = _spectrum(own, u, passed, back, pedestal)
    for row, one, small in zip(J, np.eye(4), (1e-6, 1e-9, 1.0, 1e-5), strict=True):
        ends = [_spectrum(own, u + side * small * one, passed, back, pedestal)[0] for side in (1, -1)]
        assert row == pytest.approx((ends[0] - ends[1]) / (2 * small), rel=1e-4, abs=1e-11)
    A = c.tangent(u)
    if standing is not None:
        A += (
            stiffness_lost(c.w, 8.1e6, 45.0, pedestal) - stiffness_lost(c.w, 8e6, 40.0, np.array(standing.pedestal))
        ) / c.w**2
    assert _spectrum(own, u, passed, back, pedestal)[0] == pytest.approx(
        replace(c, aliased_gain=back).spectrum(np.array([u[0], np.log(u[1]), *u[2:]]), A, passed)
    )


@pytest.mark.parametrize("name", ["Bessel filter of order 4", "Butterworth filter of order 5", "Chebyshev"])
def test_the_phase_of_poles_is_that_of_scipy_but_for_a_delay(name: str) -> None:
    made = {"Bessel": signal.bessel(4, 1.0, analog=True, norm="mag"), "Butterworth": signal.butter(5, 1.0, analog=True)}
    made["Chebyshev"] = signal.cheby1(5, 0.5, 1.0, analog=True)
    f = np.linspace(0.001, 2.0, 200)
    H = signal.freqs(*made[name.split()[0]], f)[1]
    own = Filter(1.0, 1.0, poles=designs().get(name, chebyshev(5, 10**0.05 - 1))).response(f)
    delay = np.unwrap(np.angle(H / own)) / f
    assert abs(H / own) == pytest.approx(1.0, rel=1e-6)
    assert delay == pytest.approx(np.full(f.size, delay[-1]), rel=1e-6)


def test_what_is_undone_is_what_the_filter_did() -> None:
    rig = one_bearing()
    off = Filter(RATE, rig.band[1], poles=designs()["Bessel filter of order 4"], cutoff_hz=5000.0)
    y = np.random.default_rng(1).normal(size=(4096, 2))
    f = np.fft.rfftfreq(4096, 1 / RATE)
    through = np.fft.irfft(np.fft.rfft(y, axis=0) * off.response(f)[:, None], axis=0)
    back = np.fft.rfft(corrected_record(replace(rig, roll_off=dict.fromkeys(rig.places, off)), through, RATE), axis=0)
    inside = (f > 0.0) & (f <= rig.band[1])
    assert back[inside] == pytest.approx(np.fft.rfft(y, axis=0)[inside], rel=1e-6)

"""The page and the pictures of an identification.

For each excited axis: measured and fitted frequency response with the coherence, the errors over the scatter with their
autocorrelation from line to line, and the response over one period, measured, simulated from the input and predicted row by
row, on a held-out flight if there is one. For the paper's method one picture explains its result.
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from hil.pictures import curves
from hil.pictures.drawing import WIDTH
from hil.pictures.pages import saved, write_page
from hil.research.design.axes import ROLL
from hil.research.identify.identify import IDENTIFIED, Identification, rows_of
from hil.research.identify.joint import Estimate, Excited, excited_axes, whitened
from hil.research.identify.record import Record
from hil.research.identify.response import one_step, response
from hil.research.identify.spectra import PERIOD_S
from hil.research.identify.two_controllers import SIGMAS, closed_loop

OUTPUTS = {"roll": "roll rate", "pitch": "pitch rate", "yaw": "yaw rate", "height": "height"}
HERTZ = (0.5, 1, 2, 4, 8)
SHOWN_S = 1.5  # of the one-step prediction
UNITS = {"roll": "rad/s", "pitch": "rad/s", "yaw": "rad/s", "height": "m"}


def write_pages(out: Path, found: Identification, held_out: Record | None) -> Path:
    """Write the pictures and `identify.html`; return its path. `held_out` is one that `check_held_out` accepts."""
    new = [] if held_out is None else excited_axes([held_out])
    figures = []
    for axis in dict.fromkeys(one.axis for one in found.excited):
        fitted = [one for one in found.excited if one.axis is axis]
        shown = [one for one in new if one.axis is axis]
        flights = found.records if held_out is None or not shown else (held_out,)
        title, draw = f"{axis.name}, from u{axis.input + 1}", partial(_axis, found, fitted, shown, flights)
        figures.append(saved(out, f"identify_{axis.name}", title, "", draw))
    if found.free:
        title = "why the paper's equations contain no information about the robot"
        figures.append(saved(out, "identify_paper", title, "", partial(_identity, found.free)))
    known = rows_of([one for one in found.constants if one.verdict == IDENTIFIED])
    others = rows_of([one for one in found.constants if one.verdict != IDENTIFIED])
    names = ", ".join(record.name for record in (*found.records, *found.free))
    return write_page(
        out / "identify.html", "identify.html.j2", known=known, others=others, figures=figures, names=names
    )


def _axis(
    found: Identification, fitted: list[Excited], held_out: list[Excited], records: tuple[Record, ...]
) -> Figure:
    """Draw one axis; `records` belong to the shown response."""
    figure = Figure(figsize=(WIDTH, 8.0), layout="constrained")
    panels = figure.subplot_mosaic([["gain", "phase"], ["errors", "step"], ["answer", "answer"]])
    gain, phase, errors, step, answer = panels.values()
    _responses(gain, phase, errors, fitted, found.estimate)
    seen, late = (held_out or fitted)[0], found.estimate.late
    _period(answer, seen, found.estimate.values)
    answer.set_title(
        "a flight that was not fitted" if held_out else "the fitted flight; --validate RUN: another"
    )
    _one_step(step, records[seen.record], seen, found.estimate.values, late[seen.record])
    return figure


def _responses(gain: Axes, phase: Axes, errors: Axes, fitted: list[Excited], found: Estimate) -> None:
    """Draw the measured and the fitted response of one axis, and the errors of the fit."""
    axis = fitted[0].axis
    grid = np.geomspace(fitted[0].spectra.w[0], fitted[0].spectra.w[-1], 200)
    model = response(axis, found.values, grid)[:, 0]
    gain.loglog(grid / 2 / np.pi, np.abs(model), color=curves.BLUE, label="joint fit")
    phase.semilogx(grid / 2 / np.pi, np.degrees(np.unwrap(np.angle(model))), color=curves.BLUE)
    together = gain.twinx()
    together.set(ylim=(0, 1.05), ylabel="coherence with the excitation")
    for one in fitted:
        Z, hertz = one.spectra.Z, one.spectra.w / 2 / np.pi
        measured = Z[:, 1] / Z[:, 0]
        expected = response(axis, found.values, one.spectra.w)[:, 0]
        turned = np.angle(measured / expected) + np.interp(one.spectra.w, grid, np.unwrap(np.angle(model)))
        gain.loglog(hertz, np.abs(measured), "+", color=curves.RED, label="measured")
        phase.semilogx(hertz, np.degrees(turned), "+", color=curves.RED)
        together.semilogx(hertz, one.spectra.coherence[:, 1], ":", color=curves.GREY)
        late = found.late[one.record] if one.record < len(found.late) else 0.0
        left = whitened(one, found.values, late).reshape(2, len(hertz), -1)[:, :, 0]
        errors.plot(hertz, left[0], ".", color=curves.RED)
        errors.plot(hertz, left[1], ".", color=curves.SKY)
        correlation = np.mean([np.corrcoef(part[:-1], part[1:])[0, 1] for part in left])
        errors.set_title(f"error over scatter, real and imaginary; from line to line {correlation:+.2f}")
    gain.set(ylabel=f"{OUTPUTS[axis.name]} per u{axis.input + 1} [{UNITS[axis.name]}/rad]")
    gain.legend(loc="lower left")
    for axes in (gain, phase):
        axes.set_xticks(HERTZ, [f"{hertz:g}" for hertz in HERTZ])
        axes.xaxis.set_minor_locator(NullLocator())
    phase.set(xlabel="frequency [Hz]", ylabel="phase [deg]")
    errors.axhspan(-2, 2, color=curves.GREY, alpha=0.2)
    errors.set(xlabel="frequency [Hz]")


def _period(answer: Axes, seen: Excited, values: Mapping[str, float]) -> None:
    """Draw the response over one period."""
    t, axis = np.linspace(0.0, PERIOD_S, 1001), seen.axis
    Z = seen.spectra.Z * seen.spectra.excitation[:, None]
    predicted = response(axis, values, seen.spectra.w)[:, 0] * Z[:, 0]
    wave = np.exp(1j * np.outer(t, seen.spectra.w))
    answer.plot(t, (wave @ Z[:, 1]).real, color=curves.RED, label="measured")
    answer.plot(t, (wave @ predicted).real, color=curves.BLUE, label="simulated from the input")
    label = f"{OUTPUTS[axis.name]} [{UNITS[axis.name]}]"
    answer.set(xlim=(0, 5), xlabel="time in the period [s]", ylabel=label)
    answer.legend(loc="upper right")


def _one_step(axes: Axes, record: Record, seen: Excited, values: Mapping[str, float], late: float) -> None:
    """Draw the model's prediction of each next row."""
    name = seen.axis.name
    t, measured, predicted = one_step(record, seen.axis.input, values, late)
    left = np.std((measured - predicted)[len(t) // 10 :])  # after the filter has settled
    t -= t[0]
    axes.plot(t, measured, ".", markersize=3, color=curves.RED)
    axes.plot(t, predicted, color=curves.BLUE, label=f"predicted {1e3 * record.period_s:.0f} ms before")
    middle = t[-1] / 2
    inside = (t > middle) & (t < middle + SHOWN_S)
    level, reach = measured[inside].mean(), 1.3 * np.ptp(measured[inside]) / 2
    axes.set(xlim=(middle, middle + SHOWN_S), ylim=(level - reach, level + reach), xlabel="time [s]")
    axes.set(ylabel=f"{OUTPUTS[name]} [{UNITS[name]}]")
    axes.set_title(f"one step ahead: error {left:.2g} of {np.std(measured):.2g} {UNITS[name]} rms")
    axes.legend(loc="upper right")


def _identity(records: tuple[Record, ...]) -> Figure:
    """Draw, bin by bin, the data to which eq. (roll_dynamics_sys_of_equations) is fitted."""
    figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
    panels = figure.subplots(1, min(2, len(records)), squeeze=False)[0]
    for axes, record in zip(panels, records, strict=False):
        loop = closed_loop(record, ROLL)
        bins = (loop.acceleration / loop.angle).real
        axes.plot(loop.w**2, bins, ".", color=curves.RED, markersize=2, label="every bin")
        axes.plot(np.sort(loop.w**2), -np.sort(loop.w**2), color="black", label="−ω², for any robot")
        estimated = f"c* = {loop.starred[1]:.1f} ± {SIGMAS * loop.errors[1]:.1f}"
        axes.axhline(loop.starred[1], color=curves.BLUE, label=estimated)
        axes.set(xlabel="ω² [1/s²]", ylabel="jωȦ / A, real part [1/s²]", ylim=(-1000, 100))
        axes.set_title(f"{record.name}: b* = {loop.starred[0]:.2f}")
        axes.legend(loc="lower left")
    return figure

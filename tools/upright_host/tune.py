"""`upright tune kalman`: Q and R of the scalar Kalman filter scanned on a recorded trial; table, sentences, picture."""

from pathlib import Path

import numpy as np
import typer
from rich.table import Table

from upright_host import console, options, plotting, trials
from upright_host.console import Wrong
from upright_host.kalman_scan import (
    ACCELEROMETER,
    COLUMNS,
    Q_GRID,
    R_GRID,
    REST_S,
    USUAL,
    Setting,
    Signal,
    advised,
    best,
    by_ratio,
    filtered,
    grid,
    kalman_filter,
    scan,
    signal,
    spread,
    usual,
)

_UNTUNED_RATIO = 1e-3  # drawn where there is no truth to tune by


# ------------------------------------------------------------------------------------------- output
def table(found: list[Setting]) -> Table:
    """A row for each Q/R: that is all that counts."""
    made = Table(box=None, pad_edge=False)
    for head in ("Q/R", "K", "settles, s", "lag, s", "noise, deg", "RMSE, deg"):
        made.add_column(head, justify="right", no_wrap=True)
    made.add_column("")
    marks = {id(usual(found)): "Q = 10, R = 0.05", id(best(found)): "best"}
    for ratio, group in by_ratio(found).items():
        s = group[0]
        made.add_row(
            *(
                f"{ratio:.3g}",
                f"{s.K:.4f}" if s.K > 0.1 else f"{s.K:.3g}",
                _or_dash(s.settling),
                _or_dash(s.lag),
            ),
            *(f"{s.noise:.3f}", f"{s.rmse:.3f}"),
            ", ".join(marks[id(one)] for one in group if id(one) in marks),
        )
    return made


def _or_dash(seconds):
    return "-" if seconds is None else f"{seconds:.3f}"


def _pair(s) -> str:
    return f"Q = {s.Q:.3g}, R = {s.R:.3g}"


def remarks(of: Signal, found: list[Setting]) -> list[str]:
    """What the scan says, in sentences."""
    common, least = usual(found), best(found)
    raw = np.array(of.z) / 1000
    start, first, second = advised(found)
    ratios = [s.ratio for s in found]
    edge = least.ratio < 1.5 * min(ratios) or least.ratio > max(ratios) / 1.5
    moved = second.R != first.R
    return [
        f"unfiltered: RMSE {of.rmse(raw):.3f} deg, noise {of.noise(raw):.3f} deg in the stillest {REST_S:g} s",
        f"Q = 10, R = 0.05: K = {common.K:.3f}: the estimate is the measurement, nearly: RMSE {common.rmse:.3f} deg,"
        f" noise {common.noise:.3f} deg",
        f"best: Q/R = {least.ratio:.3g}, for instance {_pair(least)}: K = {least.K:.3g}, RMSE {least.rmse:.3f} deg,"
        f" noise {least.noise:.3f} deg, lag {_or_dash(least.lag)} s"
        + ("; it lies at the edge of the grid" if edge else ""),
        f"pairs of equal Q/R differ by {spread(found):.4f} deg RMSE at most: the filter knows nothing but the ratio",
        f"the usual advice: from {_pair(start)} ({start.rmse:.3f} deg) Q up to {first.Q:.3g}: {first.rmse:.3f} deg;"
        + (
            f" then R down to {second.R:.3g}: {second.rmse:.3f} deg: it turns the same knob on"
            if moved
            else " then any lower R is worse: it turns the same knob back"
        ),
    ]


# ------------------------------------------------------------------------------------------- pictures
_GREY, _TRUTH = "0.8", "black"
_MOTION_S = 8.0
_ZOOM_S = 1.2


def draw_scan(of: Signal, found: list[Setting], name: str, path: Path) -> None:
    """The RMSE over Q and R, over Q/R alone, and what four pairs make of the angle. Raises what plotting does."""
    picture = plotting.figure(14, 9.5)
    places = picture.add_gridspec(2, 2, width_ratios=(1, 1.25))
    _heat_map(picture, picture.add_subplot(places[0, 0]), found)
    _all_on_one_line(picture.add_subplot(places[1, 0]), found)
    least = best(found)
    far = max(least.ratio / 1000, min(s.ratio for s in found))
    pairs = [
        (*USUAL, "-", 1.1),
        (least.Q, least.R, "-", 2.2),
        (100 * least.Q, 100 * least.R, ":", 2.2),
        (far * USUAL[1], USUAL[1], "-", 1.1),
    ]
    tints = ("tab:red", "tab:blue", "gold", "tab:green")
    lines = [
        (filtered(of.z, Q, R), f"Q = {Q:.3g}, R = {R:.3g}", tint, style, width)
        for (Q, R, style, width), tint in zip(pairs, tints, strict=True)
    ]
    motion = picture.add_subplot(places[0, 1])
    _waves(motion, of, _liveliest(of, _MOTION_S / 2), lines)
    motion.legend(fontsize=8, loc="best", framealpha=0.8)
    motion.set_title("in motion", fontsize=10)
    still = picture.add_subplot(places[1, 1])
    _waves(still, of, of.rest, lines)
    still.set_title("where it lies most still", fontsize=10)
    picture.suptitle(
        f"{name}: {of.axis} of {_source(of)}, through the scalar Kalman filter",
        x=0.01, ha="left", fontsize=12, fontweight="bold",
    )  # fmt: skip
    picture.tight_layout()
    plotting.save(picture, path)


def _source(of: Signal) -> str:
    return "the accelerometer alone" if of.source == ACCELEROMETER else of.source


def _heat_map(picture, panel, found):
    from matplotlib.colors import LogNorm

    rmse = {(s.Q, s.R): s.rmse for s in found}
    values = np.array([[rmse[Q, R] for R in R_GRID] for Q in Q_GRID])
    mesh = panel.pcolormesh(
        R_GRID, Q_GRID, values, norm=LogNorm(), cmap="viridis_r", shading="nearest"
    )
    bar = picture.colorbar(mesh, ax=panel, label="RMSE, deg")
    bar.ax.yaxis.set_major_formatter(lambda v, _: f"{v:g}")
    bar.ax.yaxis.set_minor_formatter(lambda v, _: f"{v:g}")
    bar.ax.tick_params(which="both", labelsize=7)
    panel.set_xscale("log")
    panel.set_yscale("log")
    limits = panel.get_xlim(), panel.get_ylim()
    pale = {"facecolor": "white", "alpha": 0.5, "linewidth": 0, "pad": 1}
    for ratio in [10.0**k for k in range(-6, 5, 2)]:
        line = np.array(limits[0])
        panel.plot(line, ratio * line, color="black", linewidth=0.7, linestyle="--", alpha=0.6)
        at = min(limits[0][1], limits[1][1] / ratio) / 1.5
        if limits[1][0] < ratio * at and at > limits[0][0] * 3:
            panel.text(at, ratio * at, f"Q/R = {ratio:g}", fontsize=7, ha="right", bbox=pale)
    start, first, second = advised(found)
    way = np.array([(s.R, s.Q) for s in (start, first, second)])
    panel.plot(*way.T, color="tab:orange", marker="o", markersize=5, label="as the advice goes")
    least = best(found)
    panel.plot(USUAL[1], USUAL[0], "*", color="tab:red", markersize=13, label="10 and 0.05")
    panel.plot(least.R, least.Q, "*", color="tab:blue", markersize=13, label="best")
    panel.set_xlim(limits[0])
    panel.set_ylim(limits[1])
    panel.set_xlabel("R, deg²")
    panel.set_ylabel("Q, deg²")
    panel.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    panel.set_title("along a line of equal Q/R nothing changes", fontsize=10, pad=22)


def _all_on_one_line(panel, found):
    for what, label, tint in (
        ("rmse", "RMSE, deg", "tab:purple"),
        ("noise", "noise at rest, deg", "tab:olive"),
        ("lag", "lag, s", "tab:cyan"),
        ("K", "K", "tab:gray"),
    ):
        pairs = [(s.ratio, getattr(s, what)) for s in found if getattr(s, what)]
        panel.plot(*zip(*pairs, strict=True), "o", markersize=4, alpha=0.5, color=tint, label=label)
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_ylim(bottom=1e-4)
    panel.set_xlabel("Q/R")
    panel.set_title(f"all {len(found)} pairs, over their ratio", fontsize=10)
    panel.legend(fontsize=8, loc="best", framealpha=0.8)
    plotting.tidy(panel)


def draw_waveform(trial: trials.Trial, path: Path, seconds: float | None = None) -> None:
    """The pitch of the accelerometer alone, as it comes and filtered; and how K and P settle.

    With Q and R as they are widely copied, and with the Q that is best at this R. Raises what plotting does.
    """
    of = signal(trial, seconds=seconds)
    R = USUAL[1]
    if of.truth is None:
        tuned = (_UNTUNED_RATIO * R, R)
    else:
        tuned = min(((q, R) for q in Q_GRID), key=lambda pair: of.rmse(filtered(of.z, *pair)))
    picture = plotting.figure(14, 10)
    places = picture.add_gridspec(3, 2, height_ratios=(1.25, 1, 1))
    lines = []
    for (q, r), tint in zip((USUAL, tuned), ("tab:red", "tab:blue"), strict=True):
        x = filtered(of.z, q, r)
        error = "" if of.truth is None else f": RMSE {of.rmse(x):.2f} deg"
        lines.append(
            (
                x,
                f"filtered, Q = {q:.3g}, R = {r:.3g}{error}",
                tint,
                "-",
                1.0 if (q, r) == USUAL else 1.8,
            )
        )
    wide = picture.add_subplot(places[0, :])
    whole = _liveliest(of, _MOTION_S)
    _waves(wide, of, whole, lines)
    raw = "" if of.truth is None else f": RMSE {of.rmse(np.array(of.z) / 1000):.2f} deg"
    wide.get_lines()[0].set_label(f"not filtered{raw}")
    wide.legend(fontsize=9, loc="best", framealpha=0.8)
    wide.set_title("pitch of the accelerometer alone, filtered and not", fontsize=10)
    zoom = picture.add_subplot(places[1, 0])
    _waves(zoom, of, _liveliest(of, _ZOOM_S, whole), lines)
    zoom.set_title("in motion: lag", fontsize=10)
    still = picture.add_subplot(places[1, 1])
    _waves(still, of, of.rest, lines)
    still.set_title("where it lies most still: noise", fontsize=10)
    _settling(picture.add_subplot(places[2, 0]), (USUAL, tuned), "K")
    _settling(picture.add_subplot(places[2, 1]), (USUAL, tuned), "P")
    picture.suptitle(trial.name, x=0.01, ha="left", fontsize=12, fontweight="bold")
    picture.tight_layout()
    plotting.save(picture, path)


def _settling(panel, pairs, what):
    """K or P over the first updates: they do not depend on what is measured."""
    for (Q, R), tint in zip(pairs, ("tab:red", "tab:blue"), strict=True):
        filter = kalman_filter()(0, Q, R)
        values = []
        for _ in range(1000):
            filter.update(0)
            values.append(getattr(filter, what))
        label = f"Q = {Q:.3g}, R = {R:.3g}: settles at {values[-1]:.3g}"
        panel.plot(range(1, 1001), values, color=tint, label=label)
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_ylim(panel.get_ylim()[0] / 2, panel.get_ylim()[1] * 2)
    for scale in (panel.xaxis, panel.yaxis):
        scale.set_major_formatter(lambda v, _: f"{v:g}")
        scale.set_minor_formatter(lambda v, _: "")
    panel.set_xlabel("updates")
    panel.set_title({"K": "gain K", "P": "covariance P, deg²"}[what], fontsize=10)
    panel.legend(fontsize=8, loc="best", framealpha=0.8)
    plotting.tidy(panel)


def _waves(panel, of: Signal, span: slice, lines):
    """The measured angle, the truth, and filtered ones over a span of samples."""
    t = np.arange(len(of.z)) / of.rate
    raw = np.unwrap(np.array(of.z[span]) / 1000, period=360)
    # broad and pale: where a filter changes nothing, its line lies on it
    panel.plot(t[span], raw, color=_GREY, linewidth=3.5, label="not filtered")
    if of.truth is not None:
        inside = (of.at >= span.start) & (of.at < span.stop)
        if inside.any():
            near = raw[of.at[inside] - span.start]
            shown = near + plotting.wrap(of.truth[inside] - near)
            panel.plot(t[of.at[inside]], shown, color=_TRUTH, linewidth=1.3, label="truth")
    for x, label, tint, style, width in lines:
        shown = np.unwrap(x[span], period=360)
        shown += 360 * np.rint(np.median(raw - shown) / 360)
        panel.plot(t[span], shown, color=tint, linestyle=style, linewidth=width, label=label)
    panel.set_xlim(t[span.start], t[span.stop - 1])
    panel.set_xlabel("s")
    panel.set_ylabel(f"{of.axis}, deg")
    plotting.tidy(panel)


def _liveliest(of: Signal, seconds: float, within: slice | None = None) -> slice:
    """The span in which the angle changes most."""
    first, last = (within.start, within.stop) if within else (0, len(of.z))
    n = min(last - first, max(2, round(seconds * of.rate)))
    z = np.unwrap(np.array(of.z[first:last]) / 1000, period=360)
    if of.truth is not None:
        z = np.interp(np.arange(first, last), of.at, np.unwrap(of.truth, period=360))
    sums = [np.cumsum(np.concatenate([[0], z**k])) for k in (1, 2)]
    mean, square = [(s[n:] - s[:-n]) / n for s in sums]
    begin = first + int(np.argmax(square - mean**2))
    return slice(begin, begin + n)


# ------------------------------------------------------------------------------------------ command
def register(app: typer.Typer) -> None:
    """Give an app the command `tune kalman`."""
    tune = typer.Typer(no_args_is_help=True, help="Scan a filter's parameters on a recorded trial.")
    app.add_typer(tune, name="tune")

    @tune.callback()
    def _():
        """Scan a filter's parameters on a recorded trial."""

    @tune.command("kalman")
    def kalman(
        trial: Path = typer.Argument(..., help="Recorded trial, .npz."),
        axis: str = typer.Option("pitch", help="roll or pitch."),
        source: str = typer.Option(
            ACCELEROMETER, help="Whose angle: accelerometer, or a filter of the registry."
        ),
        runtime: str = options.runtime(help="For a filter's angle: "),
        csv: Path = options.output("Write the figures of every pair to this file."),
        png: Path = options.output("Draw them, and waveforms."),
        seconds: float = options.seconds(),
        jobs: int = options.jobs("Filters"),
    ):
        """The scalar Kalman filter for many Q and R: what they come to, and what the usual advice does."""
        loaded = trials.load(trial)
        of = signal(loaded, axis, source, runtime, seconds)
        if of.truth is None:
            raise Wrong(f"{trial}: no truth in it, or in this span: nothing to tune by")
        pairs = grid()
        with console.progress(f"{len(pairs)} pairs of Q and R", len(pairs)) as at:
            found = scan(of, pairs, jobs, at)
        title = f"{loaded.name}: {axis} of {_source(of)}, {len(of.z)} samples at {of.rate:.1f} Hz"
        console.say(title, "bold")
        console.show(table(found))
        for line in remarks(of, found):
            console.say(line)
        if csv:
            # Q, R in deg**2: a row for each pair
            console.write_csv(csv, COLUMNS, (s.cells() for s in found), ".6g")
            console.say(f"figures: {csv}")
        if png:
            draw_scan(of, found, loaded.name, png)
            console.say(f"picture: {png}")

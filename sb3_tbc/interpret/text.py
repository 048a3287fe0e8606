"""What the command prints: the findings as a page of text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sb3_tbc.interpret.findings import PAPER, Findings, summary
from sb3_tbc.interpret.lesions import Drop, LesionResult


def describe(found: Findings) -> str:
    """All findings, in plain words."""
    parts = [
        _head(found),
        _table(figure_rows(found)),
        _lesions(found),
        _correlation(found),
        _information(found),
        _time(found),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _head(found: Findings) -> str:
    what = f"NDBC circuit, {found.dynamics} dynamics" if found.kind == "circuit" else "MLP: its hidden units"
    alike = "\nall episodes are the same, nothing in this task is random: intervals and p-values mean nothing here"
    return (
        f"{found.task}: {len(found.traces)} held-out episodes, success {found.success:.2f}, "
        f"subgoals reached {found.subgoals:.2f}\nlow level: {what}, {len(found.units.names)} units, "
        f"memory: {found.memory if found.kind == 'circuit' else 'none, an MLP has no state'}"
        f"{alike if found.all_alike else ''}"
    )


def figure_rows(found: Findings) -> list[tuple[str, str, str, str]]:
    """The paper's figures, ours, and those of the controls; the first row is the head."""
    ours = summary(found)
    rows = [("", "paper (UR5)", "here", "control")]
    rows.append((
        f"drop of success, {found.most} most active clamped to rest", f"{PAPER['drop_top5']:.1%}",
        _percent(ours["drop_top5_rest"]), f"{_percent(ours['drop_random5_rest'])} ({found.most} random)",
    ))  # fmt: skip
    rows.append((
        "the same, clamped to their means", "-", _percent(ours["drop_top5_mean"]),
        f"{_percent(ours['drop_random5_mean'])} ({found.most} random)",
    ))  # fmt: skip
    rows.append((
        "mean |r| of units and task features", f"{PAPER['mean_correlation']:.2f}", _number(ours["mean_correlation"]),
        f"{_number(ours['mean_correlation_control'])} (shifted in time)",
    ))  # fmt: skip
    for name, label in (("mean", "mean"), ("p90", "90th percentile")):
        rows.append((
            f"bits about the phase of the window, {label}", f"{PAPER[f'information_{name}']:.2f}",
            _number(ours[f"information_{name}"]), f"{_number(ours['information_control'])} (phases shifted)",
        ))  # fmt: skip
    return rows


def _lesions(found: Findings) -> str:
    rows: list[tuple[str, ...]] = [
        ("lesion", "clamped to", "success", "drop of success", "drop of subgoals", "change of actions")
    ]
    shown = [r for r in found.lesions if r.what not in ("random", "alone", "unread", "synapse")]
    rows += [_lesion_row(r) for r in shown]
    for what in ("alone", "unread", "synapse"):
        some = [r for r in found.lesions if r.what == what and r.clamped_to in ("mean", "")]
        some.sort(key=lambda r: (-(r.success.drop if r.success else 0.0), -r.action_change))
        rows += [_lesion_row(r) for r in some[:8]]
    note = "alone: one unit clamped. unread: the unit still acts on other units, but the readout does not hear it."
    if found.success == 0:
        note += "\nThe agent never succeeds, so success cannot drop."
    return _table(rows) + "\n" + note


def _lesion_row(result: LesionResult) -> tuple[str, ...]:
    name = {"top": f"{len(result.units)} most active", "memory": "memory wiped at each step"}.get(result.what)
    if result.what == "layer":
        name = f"layer {result.units[0].rstrip('0123456789').rstrip('.')}"
    return (
        name or f"{result.what} {' to '.join(result.units)}", result.clamped_to or "-", f"{result.success_rate:.2f}",
        _drop(result.success), _drop(result.subgoals), f"{result.action_change:.3f}",
    )  # fmt: skip


def _correlation(found: Findings) -> str:
    c = found.correlation
    lines = [
        f"correlation: {c.significant:.0%} of {c.r.size} pairs significant (Holm, p < .05; episodes are the unit). "
        "Strongest unit of each feature:"
    ]
    for k, feature in enumerate(found.features):
        best = int(np.abs(c.r[:, k]).argmax())
        lines.append(
            f"  {feature:22s} {found.units.names[best]:12s} r = {c.r[best, k]:+.2f} "
            f"[{c.low[best, k]:+.2f}, {c.high[best, k]:+.2f}], corrected p {c.p_holm[best, k]:.3f}, "
            f"shifted in time |r| = {c.control[best, k]:.2f}"
        )
    return "\n".join(lines)


def _information(found: Findings) -> str:
    information = found.information
    if information is None:
        return "information: no window is long enough to have phases"
    best = int(information.bits.argmax())
    return (
        f"information about the phase, of at most 2 bits, from {information.n_windows} windows: most in "
        f"{found.units.names[best]}, {information.bits[best]:.2f} bits (control {information.control[best]:.2f})"
    )


def _time(found: Findings) -> str:
    constants, share = found.time_constants, found.memory_share
    if constants is None:
        return "time constants and memory: an MLP has none"
    slow, fast = int(constants.median.argmax()), int(constants.median.argmin())
    names = found.units.names
    lines = [
        f"time constants in control steps: median of all neurons {np.median(constants.median):.3f}; slowest "
        f"{names[slow]} {constants.median[slow]:.3f} [{constants.low[slow]:.3f}, {constants.high[slow]:.3f}], fastest "
        f"{names[fast]} {constants.median[fast]:.4f}"
    ]
    if share is None:
        lines.append("memory: none, the membranes are reset at every step, so there is nothing to measure")
    else:
        lines.append(
            f"memory: without the membrane of the step before, actions change by {share.share:.2%} of their variance, "
            f"by {share.largest:.3f} at most"
        )
    return "\n".join(lines)


def _drop(drop: Drop | None) -> str:
    return "-" if drop is None else f"{drop.drop:+.1%} [{drop.low:+.1%}, {drop.high:+.1%}]"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _table(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)

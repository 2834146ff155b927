"""What `identify` found in a log, as messages for Foxglove and PlotJuggler: phases, contacts, forces."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from autotune.errors import UsageError
from autotune.formats.atomic import check_target, write_atomic
from autotune.recording.mcap_log import StampedChannel, StampedKind, TextChannel, TextKind, write_channels
from autotune.results import Identification
from identification.evidence import Evidence
from identification.result import Timeline, Touch
from identification.signals.recording import AXES
from problems.arrays import FloatArray

_PREFIX = "/autotune/"
WRENCH, PREDICTED, PHASE, CONTACTS = (_PREFIX + name for name in ("wrench", "predicted_wrench", "phase", "contacts"))
_FRAME = "sensor"


def layout_path(path: Path) -> Path:
    """Return where the layout of Foxglove beside the messages `path` lies."""
    return path.with_suffix(".foxglove.json")


def check_annotations(path: Path, sources: Iterable[Path]) -> None:
    """Refuse now what could not be written later; `sources` are the files that the command reads and writes.

    Raises UsageError: the path is not that of an MCAP, is one of `sources`, holds another file, or cannot be written.
    """
    if path.suffix.lower() != ".mcap":
        raise UsageError(f"{path} is to be a log, so its name must end in .mcap; name it with --annotate.")
    check_target(path, sources, kind="annotated log", option="--annotate", is_own=_is_own)
    check_target(layout_path(path), kind="layout of Foxglove", option="--annotate", is_own=_is_layout)


def _is_own(path: Path) -> bool:
    """Whether a file holds nothing but what was written here."""
    from mcap.reader import make_reader  # noqa: PLC0415 - mostly there is no file

    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except Exception:  # noqa: BLE001 - bytes that are no MCAP make the reader fail in many ways; none of them is ours
        return False
    topics = [] if summary is None else [channel.topic for channel in summary.channels.values()]
    return bool(topics) and all(topic.startswith(_PREFIX) for topic in topics)


def _is_layout(path: Path) -> bool:
    return f'"{_PREFIX}' in path.read_text(encoding="utf-8", errors="replace")


def write_annotations(path: Path, found: Identification) -> None:
    """Write what was found as a ROS 2 MCAP with the log's own times, and a layout of Foxglove beside it.

    Topics: the wrench in the sensor frame without weight and bias (as logged where these are not known), the wrench
    that the fitted model predicts from the command (along the fitted axis, in the spans that were fitted), the phase
    as a text from its first time on, and each touch as a line of a log. `found` must hold its evidence.

    Raises UsageError: a file cannot be written.
    """
    if not found.evidence:
        raise UsageError("There is nothing to annotate: no recording could be identified.")
    write_channels([each for index in range(len(found.evidence)) for each in _channels(found, index)], path)
    axes = sorted({axis for evidence in found.evidence for axis in evidence.axes} or {"x"}, key=AXES.index)
    write_atomic(layout_path(path), json.dumps(foxglove_layout(axes), indent=2) + "\n")


def _channels(found: Identification, index: int) -> Iterator[StampedChannel | TextChannel]:
    """Yield the channels of a recording; a further recording's topics end with its number."""
    evidence = found.evidence[index]
    end = "" if index == 0 else f"_{index + 1}"

    def stamps(times_s: Iterable[float]) -> list[int]:
        return [evidence.start_ns + round(1e9 * time) for time in times_s]

    def wrenches(topic: str, rows: FloatArray) -> StampedChannel:
        known = np.flatnonzero(np.all(np.isfinite(rows), axis=1))
        return StampedChannel(
            topic=topic + end,
            frame_id=_FRAME,
            kind=StampedKind.WRENCH,
            stamps_ns=stamps((known * evidence.period_s).tolist()),
            row=lambda i: rows[known[i]].tolist(),
        )

    yield wrenches(WRENCH, _measured(evidence))
    predicted = _predicted(evidence)
    if np.any(np.isfinite(predicted)):
        yield wrenches(PREDICTED, predicted)
    timelines = [each for each in found.result.timelines if each.log in ("", evidence.log)]
    timeline = timelines[0] if timelines else Timeline(phases=())
    texts = [(phase.start_s, " ".join(filter(None, (phase.kind.value, phase.axis)))) for phase in timeline.phases]
    touches = [
        (touch.onset_s if touch.onset_s is not None else touch.peak_s, _line(touch)) for touch in timeline.touches
    ]
    for topic, kind, said in ((PHASE, TextKind.STRING, texts), (CONTACTS, TextKind.LOG, sorted(touches))):
        if said:
            times, lines = zip(*said, strict=True)
            yield TextChannel(topic=topic + end, kind=kind, stamps_ns=stamps(times), texts=lines)


def _measured(evidence: Evidence) -> FloatArray:
    """Return force and torque (n, 6) without weight and bias, as logged where they are not known."""
    force, torque = evidence.compensated_S_n, evidence.compensated_torque_S_n_m
    if force is None or torque is None:
        force, torque = evidence.raw_S_n, evidence.raw_torque_S_n_m
    return np.hstack([force, torque])


def _predicted(evidence: Evidence) -> FloatArray:
    """Return the wrench (n, 6) of the model: along an axis where that was fitted, 0 beside it, NaN where none was."""
    rows = np.full((len(evidence.raw_S_n), len(AXES)), np.nan)
    for axis, fitted in evidence.axes.items():
        for span in fitted.spans:
            part = rows[span.start : span.start + len(span.predicted)]
            np.nan_to_num(part, copy=False)
            part[:, AXES.index(axis)] = span.predicted[: len(part)]
    return rows


def _line(touch: Touch) -> str:
    """Return what is said of a touch where it begins."""
    is_turn = touch.axis.startswith("r")
    force, speed = ("N·m", "mrad/s") if is_turn else ("N", "mm/s")
    side = "+" if touch.sign > 0 else "−"
    approach = "" if touch.approach_speed is None else f" at {1e3 * touch.approach_speed:.1f} {speed}"
    surface = "" if touch.surface is None else f", surface {touch.surface}"
    return f"{touch.cause.value} along {side}{touch.axis}{approach}: largest {touch.peak_force:.1f} {force}{surface}"


def foxglove_layout(axes: list[str]) -> dict[str, Any]:
    """Return a layout for Foxglove: measured and predicted wrench of each axis, the phases, and the contacts below."""
    plots = {f"Plot!{axis}": _plot(axis) for axis in axes}
    others = {
        "StateTransitions!phase": {
            "paths": [{"value": f"{PHASE}.data", "timestampMethod": "receiveTime", "label": "phase"}],
            "isSynced": True,
        },
        "RosOut!contacts": {"searchTerms": [], "minLogLevel": 1, "topicToRender": CONTACTS},
    }
    return {
        "configById": {**plots, **others},
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _column([*plots, *others]),
    }


def _plot(axis: str) -> dict[str, Any]:
    field = f"wrench.{'torque' if axis.startswith('r') else 'force'}.{axis[-1]}"
    shown = ((WRENCH, "measured"), (PREDICTED, "predicted"))
    paths = [
        {"value": f"{topic}.{field}", "enabled": True, "timestampMethod": "headerStamp", "label": label}
        for topic, label in shown
    ]
    unit = "N·m" if axis.startswith("r") else "N"
    return {"title": f"{axis} [{unit}]", "paths": paths, "showLegend": True, "isSynced": True, "xAxisVal": "timestamp"}


def _column(panels: list[str]) -> Any:
    """Return panels one below the other, all of one height."""
    if len(panels) == 1:
        return panels[0]
    share = 100.0 / len(panels)
    return {"direction": "column", "first": panels[0], "second": _column(panels[1:]), "splitPercentage": share}

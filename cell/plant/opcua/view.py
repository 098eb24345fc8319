"""The cell as the OPC UA server knows it: its status, and counts that it makes itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from cell.plant.messages import FaultNotice, MessageKind, Notice, Status, status_after
from cell.plant.opcua.packml import transition_between

#: So many faults are remembered.
FAULTS = 32


@dataclass(frozen=True)
class PastFault:
    """A fault, and when it was acknowledged, Unix time; None = it is not yet."""

    fault: FaultNotice
    acknowledged_s: float | None = None


@dataclass(frozen=True)
class PackmlView:
    """The cell's status and counts at one moment.

    Times are on the computer's monotonic clock, which nobody sets, unless marked as Unix time.

    status        None = no cell was reached yet; otherwise as last known
    lost_s        since when the cell is not there any more; None = it is there
    seconds       time spent in each state until `counted_s`
    entered_s     when the present state began
    started_s     when the cycle under way began; None = none is
    cycle_s       duration of the last cycle, s
    faults        the newest first
    acknowledged  name and note of the last acknowledgement
    transitions   the newest of each state machine, by its level: name, and id if PackML knows it
    refusal       why the last command over OPC UA was refused
    """

    status: Status | None = None
    lost_s: float | None = 0.0
    seconds: Mapping[str, float] = field(default_factory=dict)
    counted_s: float = 0.0
    entered_s: float = 0.0
    started_s: float | None = None
    cycle_s: float | None = None
    faults: tuple[PastFault, ...] = ()
    acknowledged: str = ""
    transitions: Mapping[int, tuple[str, int | None]] = field(default_factory=dict)
    refusal: str = ""

    @property
    def connected(self) -> bool:
        """Whether the cell is there."""
        return self.lost_s is None

    def after_status(self, status: Status, now_s: float, unix_s: float) -> PackmlView:
        """The view after a status that replaces all that was known of the cell.

        unix_s  now, Unix time
        """
        view = replace(
            self,
            status=status,
            lost_s=None,
            seconds=status.state_seconds,
            counted_s=now_s,
            entered_s=now_s - max(0.0, unix_s - status.since_s),
        )
        if self.status is None or self.status.run != status.run:
            view = replace(view, started_s=None, cycle_s=None, transitions={})
        known = any(past.fault == status.fault for past in self.faults)
        return view if status.fault is None or known else view._with_fault(status.fault)

    def after_notice(self, notice: Notice) -> PackmlView:
        """The view after a notice.  Raises ValueError: there is no status that it follows on."""
        if self.status is None:
            raise ValueError("a notice came before any status")
        view = replace(self, status=status_after(self.status, notice), lost_s=None)
        match notice.kind:
            case MessageKind.STATE:
                return view._after_transition(self, notice.ran_s)
            case MessageKind.CYCLE:
                return replace(view, started_s=notice.ran_s)
            case MessageKind.RESULT if self.started_s is not None:
                return replace(view, started_s=None, cycle_s=notice.ran_s - self.started_s)
            case MessageKind.FAULT if view.status is not None and view.status.fault is not None:
                return view._with_fault(view.status.fault)
            case MessageKind.ACKNOWLEDGED:
                text = f"{notice.data['by']}: {notice.data['note']}"
                first = [replace(past, acknowledged_s=notice.time_s) for past in self.faults[:1]]
                return replace(view, acknowledged=text, faults=(*first, *self.faults[1:]))
        return view

    def lost(self, now_s: float) -> PackmlView:
        """The view when the cell is there no more: nothing is counted on."""
        return replace(self, lost_s=now_s)

    def reconnected(self) -> PackmlView:
        """The view when the same cell is there again, and nothing has happened meanwhile."""
        return replace(self, lost_s=None)

    def last_known_s(self, now_s: float) -> float:
        """Now, or when the cell was lost."""
        return now_s if self.lost_s is None else min(now_s, self.lost_s)

    def seconds_at(self, now_s: float) -> dict[str, float]:
        """Time spent in each state, the present one included, s."""
        seconds = dict(self.seconds)
        if self.status is not None:
            state = self.status.state.value
            seconds[state] = seconds.get(state, 0.0) + max(
                0.0, self.last_known_s(now_s) - self.counted_s
            )
        return seconds

    def _after_transition(self, before: PackmlView, now_s: float) -> PackmlView:
        """This view, updated by the transition of the state from the former view."""
        assert before.status is not None
        assert self.status is not None
        level, name, known = transition_between(before.status.state, self.status.state)
        newest = (name, None if known is None else known.id)
        return replace(
            self,
            seconds=before.seconds_at(now_s),
            counted_s=now_s,
            entered_s=now_s,
            transitions={**self.transitions, level: newest},
        )

    def _with_fault(self, fault: FaultNotice) -> PackmlView:
        return replace(self, faults=(PastFault(fault), *self.faults)[:FAULTS])

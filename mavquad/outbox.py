"""What the companion says, and what it counts: frames into a flight's outbox, in its own sequence. Pure."""

from typing import Any

from mavquad import lifecycle, wire
from mavquad.flight import Flight
from mavquad.lifecycle import Send
from mavquad.plan import Plan


def send(plan: Plan, f: Flight, name: str, fields: tuple[Any, ...]) -> None:
    """One message, at the arrival time of the event that caused it."""
    own = plan.settings.link
    raw = wire.encode(name, fields, seq=f.seq, system=own.system, component=own.component)
    f.seq = (f.seq + 1) & 0xFF
    f.outbox.append((f.arrival_us, raw))


def send_all(plan: Plan, f: Flight, sends: tuple[Send, ...]) -> None:
    """Several, in order."""
    for name, fields in sends:
        send(plan, f, name, fields)


def say(plan: Plan, f: Flight, words: str, severity: int = 6) -> None:
    """A STATUSTEXT of ours."""
    send(plan, f, *lifecycle.text(f"mavquad: {words}", severity))


def release(plan: Plan, f: Flight, why: str) -> None:
    """No more setpoints; the autopilot's own mode and failsafe take over."""
    f.life, sends = lifecycle.release(f.life, f.arrival_us, why)
    send_all(plan, f, sends)


def count(f: Flight, what: str) -> None:
    """One more of what a person is told at the end."""
    f.counts[what] = f.counts.get(what, 0) + 1

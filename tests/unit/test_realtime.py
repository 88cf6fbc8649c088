"""SCHED_FIFO: what is asked of the kernel, and what is said where it is not given."""

import os

import pytest

from mavquad import __main__ as companion
from mavquad import realtime
from mavquad.errors import ConfigError


def test_it_asks_for_a_low_realtime_priority(monkeypatch):
    asked = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda *words: asked.append(words))
    realtime.ask()
    ((pid, policy, param),) = asked
    assert (pid, policy, param.sched_priority) == (0, os.SCHED_FIFO, 20)


def test_what_is_not_allowed_is_said_with_what_would_allow_it(monkeypatch):
    def refuse(*words):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with pytest.raises(ConfigError, match=r"--realtime: Operation not permitted; run as root, allow it \(`ulimit -r 20`"):
        realtime.ask()


def test_where_vehicle_time_waits_it_is_refused(capsys):
    assert companion.main(["--endpoint", "udpin:127.0.0.1:0", "--lockstep", "--realtime"]) == 1
    assert "a vehicle that waits for us needs no haste" in capsys.readouterr().err

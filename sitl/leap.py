"""Several periods of the loop in one compiled call: the vehicle moves, and what its streams say at their instants is queued."""

from mavquad.jit import kernel
from sitl import frames, helicopter, told, vehicle

DONE, FULL = -1, -2  # in place of a stream's number: nothing left to say; no slots left


@kernel
def speak(machine, setpoint, voice, wire, streams, moves, slots, words, more, t_us, rank, all_laid_out):
    """Queue what is due at this instant from stream `rank` on: DONE, FULL, or the number of a stream that Python has to make."""
    w = wire[0]
    if w.count + streams.shape[0] > slots.shape[0]:
        return FULL
    told.tell(machine[0], setpoint[0], voice[0], t_us)
    return frames.emit(t_us, rank, w, streams, moves, slots, words, more, all_laid_out)


@kernel
def multirotor(machine, setpoint, constants, gusts, normals, voice, wire, streams, moves, slots, words, more, log, span, case):
    """`speak` now and after each step; after the last where `last` says so. span: (t_us, steps, dt_us, last, all_laid_out, when the truth
    is wanted, as `told.write_truth` of `case` and `log`).

    Returns (steps made, as `speak`, when the next stream is due, bytes in `log`): all steps, unless something is left to Python.
    """
    t_us, steps, dt_us, last, all_laid_out, truth_us = span
    w, logged = wire[0], 0
    for k in range(steps + 1):
        if k > 0:
            vehicle.advance(machine, setpoint, constants, gusts, normals, 1)
            t_us += dt_us
            if t_us == truth_us:
                logged = told.write_truth(machine, constants, voice, t_us, streams, moves, words, more, case, log)
        if t_us >= w.next_us and (k < steps or last):
            rank = speak(machine, setpoint, voice, wire, streams, moves, slots, words, more, t_us, 0, all_laid_out)
            if rank != DONE:
                return k, rank, w.next_us, logged
    return steps, DONE, w.next_us, logged


@kernel
def rotorcraft(
    machine, setpoint, constants, heli, gusts, normals, voice, wire, streams, moves, slots, words, more, log, span, case
):
    """`multirotor` for the helicopter."""
    t_us, steps, dt_us, last, all_laid_out, truth_us = span
    w, logged = wire[0], 0
    for k in range(steps + 1):
        if k > 0:
            helicopter.advance(machine, setpoint, constants, heli, gusts, normals, 1)
            t_us += dt_us
            if t_us == truth_us:
                logged = told.write_truth(machine, constants, voice, t_us, streams, moves, words, more, case, log)
        if t_us >= w.next_us and (k < steps or last):
            rank = speak(machine, setpoint, voice, wire, streams, moves, slots, words, more, t_us, 0, all_laid_out)
            if rank != DONE:
                return k, rank, w.next_us, logged
    return steps, DONE, w.next_us, logged

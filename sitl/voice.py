"""The compiled half of what the autopilot says: its records, and the calls of the kernels that read them."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from sitl import frames, leap, telemetry, told
from sitl.autopilot import Autopilot
from sitl.helicopter import Helicopter
from sitl.ring import Ring
from sitl.state import Record
from sitl.vehicle import Vehicle

if TYPE_CHECKING:
    from sitl import config

_LOG = 1024  # bytes: room for the records of the truth
Wanted = tuple[int, int, int, bool]  # the truth: when, its stamp, misses so far, whether engaged
NOTHING: Wanted = (-1, 0, 0, False)


class Voice:
    """The records of one vehicle's autopilot; each `Ring` is a peer that hears it."""

    def __init__(self, sitl: "config.Sitl", vehicle: Vehicle, gyro: str) -> None:
        self.told = Record(told.TOLD, mocap_age_us=1000 * sitl.noise.mocap_delay_ms)
        self._words = {**told.WORDS, telemetry.GYRO: told.WORDS[gyro]}
        self._vehicle = vehicle
        self._leap: Any = leap.rotorcraft if isinstance(vehicle, Helicopter) else leap.multirotor
        self._blocks = vehicle.state.array.view(np.float64), self.told.array.view(np.float64)
        self._truth = frames.tables(telemetry.TRUTH, self._words)
        self._system, self._said = sitl.system, 0
        self._log = np.zeros(_LOG, np.uint8)
        self._echo: tuple[float, ...] | None = None
        self._heard: object = None  # the arrays in `_arguments`
        self._arguments: tuple[np.ndarray, ...] = ()

    def tables(self, streams: Iterable[str]) -> frames.Tables:
        """Of the streams of a peer, in their order."""
        plain = {
            name: telemetry.without_sensors(telemetry.LAYOUTS[name]) if name in telemetry.LAYOUTS else None for name in streams
        }
        return frames.tables({**plain, **telemetry.TRUTH}, self._words)

    def heed(self, autopilot: Autopilot) -> None:
        """What the kernels have to know of the autopilot before they speak."""
        if autopilot.echo_q is not self._echo and not autopilot.shapes:
            self._echo = autopilot.echo_q
            self.told["echo"] = told.TARGET if self._echo is None else told.GIVEN
            if self._echo is not None:
                self.told["echo_q_wxyz"] = self._echo

    def booted(self, autopilot: Autopilot) -> None:
        """Its clock is that of this autopilot."""
        self._echo = None
        self.told["booted_us"], self.told["echo"] = autopilot.boot_us, told.SHAPED if autopilot.shapes else told.TARGET

    def leap(self, ring: Ring, steps: int, last: bool, all_laid_out: bool, wanted: Wanted = NOTHING) -> tuple[int, int, bytes]:
        """Speak now, move on by at most `steps` and speak on the way, at the last of them where `last` says so.

        Returns (`leap.DONE`, FULL: some room was made, go on, or the number of a stream that Python has to make at this instant;
        when the next stream is due; the log's records of the truth, if its instant was passed).
        """
        vehicle = self._vehicle
        if ring.arrays is not self._heard:
            self._heard = ring.arrays
            self._arguments = *vehicle.arrays, self.told.array, *ring.arrays, *self._blocks, self._log
        span = vehicle.t_us, vehicle.at_once(steps), vehicle.dt_us, last, all_laid_out, wanted[0]
        made, rank, next_us, logged = self._leap(*self._arguments, span, self._case(*wanted[1:]))
        if made:
            vehicle.passed(made)
        if rank == leap.FULL:
            ring.room(len(ring.slots))
        return rank, next_us, self._written(logged) if logged else b""

    def speak(self, ring: Ring, rank: int, all_laid_out: bool) -> int:
        """Queue what is due now from stream `rank` on; what it returns is as of `leap`."""
        v = self._vehicle
        while True:
            found: int = leap.speak(
                v.state.array, v.setpoint.array, self.told.array, *ring.arrays, *self._blocks, v.t_us, rank, all_laid_out
            )
            if found != leap.FULL:
                return found
            ring.room(len(ring.slots))

    def truth(self, stamp_us: int, misses: int, engaged: bool) -> bytes:
        """The log's records of this instant's truth."""
        v, case = self._vehicle, self._case(stamp_us, misses, engaged)
        state, constants, voice = v.state.array, v.constants.array, self.told.array
        return self._written(told.write_truth(state, constants, voice, v.t_us, *self._truth, *self._blocks, case, self._log))

    def _case(self, stamp_us: int, misses: int, engaged: bool) -> tuple[int, int, int, float, float]:
        return stamp_us, self._said, self._system, float(misses), float(engaged)

    def _written(self, size: int) -> bytes:
        self._said = (self._said + told.TRUTHS) & 0xFF
        return self._log[:size].tobytes()

    def find_truth(self, misses: int, engaged: bool) -> Record:
        """The truth of this instant, in a record."""
        v = self._vehicle
        told.find_truth(v.state.array, v.constants.array, self.told.array, v.t_us, float(misses), float(engaged))
        return self.told

"""companion.toml as frozen typed structures: what one flight of the companion is made of."""

from typing import Any, Literal

import msgspec

from mavquad import config
from mavquad.errors import ConfigError
from mavquad.paths import Path
from mavquad.setpoint.limits import Limits

CONTROLLERS = ("pd", "pid", "adrc", "iadrc", "eskf-mpc", "autopilot", "sweep")


class Link(config.Section, frozen=True):
    """[link]: who we are, whom we listen to, and the message rates we ask for [Hz] (granted rates may be lower)."""

    system: int = 1
    component: int = 191
    target_system: int = 0  # 0: the first autopilot heard
    rates_hz: dict[str, float] = msgspec.field(
        default_factory=lambda: {
            "ATTITUDE_QUATERNION": 250.0,
            "HIGHRES_IMU": 250.0,
            "SERVO_OUTPUT_RAW": 250.0,
            "ATTITUDE": 100.0,
            "LOCAL_POSITION_NED": 50.0,
            "ATTITUDE_TARGET": 50.0,
            "EXTENDED_SYS_STATE": 5.0,
            "SYS_STATUS": 2.0,
        }
    )
    signing_key: str = ""  # a file with the key of MAVLink 2 signing; empty: nothing is signed
    timesync_hz: float = 5.0
    publish_hz: float = 5.0

    def __post_init__(self) -> None:
        for key, least in (("system", 1), ("component", 1), ("target_system", 0)):
            if not least <= getattr(self, key) <= 255:
                raise ConfigError(f"link.{key} = {getattr(self, key)}: expected {least} to 255")
        for key in ("timesync_hz", "publish_hz"):
            if not 0.01 <= getattr(self, key) <= 100.0:
                raise ConfigError(f"link.{key} = {getattr(self, key)}: expected 0.01 to 100 Hz")


class Safety(config.Section, frozen=True):
    """[safety]: when to hold, level, release or land."""

    hold_s: float = 0.25  # attitude or position older than this: hold the last setpoint
    level_s: float = 0.75  # ... level, at hover thrust
    release_s: float = 1.5  # ... stop sending, so that the autopilot's own failsafe acts
    late_s: float = 0.4  # our own lateness, for half a second: release
    delay_s: float = 0.5  # measured to the autopilot and back: land, by its own loops
    fence_m: float = 500.0  # horizontal, from where the vehicle was armed
    ceiling_m: float = 120.0
    battery_percent: float = 15.0  # land below
    reset_m: float = 0.6  # a position jump that velocity cannot explain

    def __post_init__(self) -> None:
        for key in ("hold_s", "level_s", "release_s", "late_s", "delay_s", "fence_m", "ceiling_m", "reset_m"):
            if not 0.0 < getattr(self, key) <= 1e6:
                raise ConfigError(f"safety.{key} = {getattr(self, key)}: expected more than 0, at most 1e6")
        if not 0.0 <= self.battery_percent <= 100.0:
            raise ConfigError(f"safety.battery_percent = {self.battery_percent}: expected 0 to 100")


class Companion(config.Section, frozen=True):
    """A whole companion file."""

    airframe: str = "x500"
    airframe_set: tuple[str, ...] = ()
    controller: Literal["pd", "pid", "adrc", "iadrc", "eskf-mpc", "autopilot", "sweep"] = "pid"
    estimator: str = "auto"  # the controller's own
    compensator: Literal["none", "asmf"] = "none"
    observers: tuple[str, ...] = ("gsmo",)
    loop: Literal["attitude", "rates"] = "attitude"
    body_rates: Literal["autopilot", "observer"] = (
        "autopilot"  # what controllers get; where it sends none, the first observer's
    )
    control_hz: float = 125.0
    takeoff_m: float = 5.0
    settle_s: float = 2.0  # engaged at the start point before the path begins
    seed: int | None = None  # of the scenario; kept in the plan, used by nothing here
    link: Link = Link()
    safety: Safety = Safety()
    limits: Limits = Limits()
    path: Path = Path()
    tune: dict[str, dict[str, Any]] = msgspec.field(default_factory=dict)  # per stage: tune.pid.wc_rad_s = 2.0

    def __post_init__(self) -> None:
        if not 1.0 <= self.control_hz <= 1000.0:
            raise ConfigError(f"control_hz = {self.control_hz}: expected 1 to 1000")
        if not 0.0 <= self.settle_s <= 600.0:
            raise ConfigError(f"settle_s = {self.settle_s}: expected 0 to 600")
        if self.body_rates == "observer" and not self.observers:
            raise ConfigError('body_rates = "observer" needs one in observers, for instance "gsmo"')
        if not 0.5 <= self.takeoff_m <= 100.0:
            raise ConfigError(f"takeoff_m = {self.takeoff_m}: expected 0.5 to 100")
        for name, hz in self.link.rates_hz.items():
            if not 0.01 <= hz <= 1000.0:
                raise ConfigError(f"link.rates_hz.{name} = {hz}: expected 0.01 to 1000 Hz")

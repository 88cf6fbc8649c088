"""A campaign's file: scenarios x personalities x variants x seeds, each flight as the words of one `mavquad fly`.

about = "who holds the rectangle best in wind"
seeds = "1-5"
personalities = ["px4", "ardupilot"]     # an axis of its own; without it a variant may choose its personality
baseline = "pid"                         # ratios are paired: same scenario, personality and seed
metrics = ["rmse_m", "max_error_m"]      # columns of the store; the table shows each
set = ["wind.mean_m_s=4"]                # of every flight

[[scenario]]
name = "rectangle"                       # a scenario's name; `scenario = "..."` where the label differs, or for a TOML file
set = ["vehicle.mass=+20%"]

[[variant]]
name = "iadrc"
controller = "iadrc"                     # also estimator, compensator, observers, loop, attitude, airframe, personality, set

[draw]                                   # see tools/campaigns/draw.py; drawn once per scenario and seed: variants are paired
"vehicle.mass" = {uniform = [-10, 20], percent = true}
"""

import hashlib
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec

from mavquad import config, toml
from mavquad.errors import ConfigError
from tools.campaigns.draw import draw
from tools.papers.common import parse_seeds

FOLDER = Path(__file__).resolve().parent
_CHOICES = ("personality", "airframe", "controller", "estimator", "compensator", "attitude", "loop")


class Case(config.Section, frozen=True):
    """[[scenario]]: what is flown, in which conditions."""

    name: str
    scenario: str | None = None  # None: that of the name
    set: tuple[str, ...] = ()


class Variant(config.Section, frozen=True):
    """[[variant]]: who flies it. None leaves the default of `mavquad fly`."""

    name: str
    personality: Literal["px4", "ardupilot"] | None = None
    airframe: str | None = None
    controller: str | None = None
    estimator: str | None = None
    compensator: str | None = None
    observers: list[str] | None = None
    loop: Literal["attitude", "rates"] | None = None
    attitude: Literal["ahrs", "mocap", "both"] | None = None
    set: tuple[str, ...] = ()


class Campaign(config.Section, frozen=True):
    """The whole file."""

    about: str
    scenario: list[Case]
    variant: list[Variant]
    seeds: str | list[int] = "1-5"
    personalities: tuple[Literal["px4", "ardupilot"], ...] = ()
    baseline: str | None = None
    metrics: tuple[str, ...] = ("rmse_m",)
    set: tuple[str, ...] = ()
    draw: dict[str, Any] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        for kind, names in (("scenario", [c.name for c in self.scenario]), ("variant", [v.name for v in self.variant])):
            if not names or len(set(names)) < len(names):
                raise ConfigError(f"[[{kind}]] names {names}: expected at least one, none twice; give each a name of its own")
        if self.baseline is not None and self.baseline not in [v.name for v in self.variant]:
            raise ConfigError(f"baseline = {self.baseline!r}: expected a variant, {', '.join(v.name for v in self.variant)}")
        if self.personalities and any(v.personality for v in self.variant):
            raise ConfigError("personalities: an axis of the whole campaign; a variant cannot choose its own beside it")


class Flight(NamedTuple):
    """One flight of a campaign."""

    scenario: str  # labels of the file
    personality: str  # "" where it is no axis
    variant: str
    seed: int
    words: tuple[str, ...]  # of `mavquad fly`
    drawn: dict[str, Any]

    @property
    def id(self) -> str:
        """Which flight this is: a hash of all that decides it."""
        return hashlib.sha256(json.dumps(self.words).encode()).hexdigest()[:16]

    @property
    def command(self) -> str:
        """What repeats this flight alone."""
        return shlex.join(["mavquad", "fly", *self.words])

    @property
    def label(self) -> str:
        return " ".join(filter(None, (self.scenario, self.personality, self.variant, f"seed {self.seed}")))


def names() -> list[str]:
    """The campaigns that come with mavquad."""
    return sorted(p.stem for p in FOLDER.glob("*.toml"))


def load(name_or_path: str, seeds: str | None = None) -> Campaign:
    """A campaign by name or by a path that ends in .toml, with other seeds on request. Raises ConfigError."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = FOLDER / f"{name_or_path}.toml"
        if name_or_path not in names():
            raise ConfigError(
                f"no campaign is called {name_or_path!r}; known: {', '.join(names())}; or give a path that ends in .toml"
            )
    campaign = config.load(path, Campaign)
    if seeds is not None:
        campaign = msgspec.structs.replace(campaign, seeds=seeds)
    return campaign


def flights(campaign: Campaign) -> Iterator[Flight]:
    """Every flight, seed by seed, so that an unfinished campaign already compares. Raises ConfigError."""
    seeds = parse_seeds(campaign.seeds) if isinstance(campaign.seeds, str) else campaign.seeds
    for seed in seeds:
        for case in campaign.scenario:
            drawn = {key: draw(key, value, case.name, seed) for key, value in campaign.draw.items()}
            changes = [f"{key}={_text(value)}" for key, value in drawn.items()]
            for personality in campaign.personalities or ("",):
                for variant in campaign.variant:
                    words = _words(campaign, case, variant, personality, seed, changes)
                    yield Flight(case.name, personality, variant.name, seed, words, drawn)


def _words(
    campaign: Campaign, case: Case, variant: Variant, personality: str, seed: int, changes: list[str]
) -> tuple[str, ...]:
    words = [case.scenario or case.name, "--seed", str(seed)]
    for name in _CHOICES:
        value = personality if name == "personality" and personality else getattr(variant, name)
        if value is not None:
            words += [f"--{name}", value]
    for observer in variant.observers or []:
        words += ["--observer", observer]
    for change in (*campaign.set, *case.set, *variant.set, *changes):
        words += ["--set", change]
    return tuple(words)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else toml.value(value)

"""Airframe files and the errors a person gets from a wrong one."""

import pytest

from mavquad import airframe, config
from mavquad.errors import ConfigError


def test_the_x500_loads_and_hovers_at_its_hover_thrust():
    frame = airframe.load("x500")
    assert frame.rotors is not None
    assert frame.hover_thrust * 4 * frame.rotors.thrust_max_n == pytest.approx(frame.body.mass_kg * 9.80665, rel=1e-3)


def test_a_mass_changed_by_percent():
    assert airframe.load("x500", ("body.mass_kg=+20%",)).body.mass_kg == pytest.approx(2.4)
    assert airframe.load("x500", ("body.inertia_kg_m2=-10%",)).body.inertia_kg_m2[2] == pytest.approx(0.036)


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        ("body.mass=2", r'x500.toml: unknown key "mass" in \[body\]; did you mean "mass_kg"\?'),
        ("body.inertia_kg_m2=[2.0, 2.0, 2.0]", r"impossible for 2.0 kg on arms of 0.246 m"),
        ("body.inertia_kg_m2=[0.01, 0.01, 0.05]", r"no body has one axis above the sum"),
        ("body.mass_kg=-1", r"body.mass_kg = -1.0: expected 0.01 to 1000 kg"),
        ("rotors.arm_m=1e300", r"\[rotors\] = .*expected arm_m 0 to 100"),
        ("rotors.arm_m=0", r"\[rotors\] = .*expected arm_m 0 to 100"),
        ("body.mass_kg=heavy", r"body.mass_kg = 'heavy': Expected `float`, got `str`"),
        ("rotors.thrust_max_n=2", r"must lift at least 1.1 times the weight"),
        ("bdoy.mass_kg=1", r'there is no \[bdoy\]; did you mean "body"\?'),
        ("name=+10%", r"not a number to change by"),
        ("name", r"expected KEY.KEY=VALUE"),
        ("hover_thrust=3", r"hover_thrust = 3.0: expected 0.05 to 0.95"),
    ],
)
def test_a_wrong_value_is_named_with_file_key_and_what_is_allowed(assignment, said):
    with pytest.raises(ConfigError, match=said):
        airframe.load("x500", (assignment,))


def test_a_missing_and_a_broken_file(tmp_path):
    with pytest.raises(ConfigError, match=r"no airframe is called 'x50'; known: .*x500"):
        airframe.load("x50")
    with pytest.raises(ConfigError, match="no such file"):
        config.read(tmp_path / "a.toml")
    (tmp_path / "b.toml").write_text("a = = 1")
    with pytest.raises(ConfigError, match="not valid TOML"):
        airframe.load(str(tmp_path / "b.toml"))


def test_the_x500_flies_with_bounds_of_its_own_log_and_the_guess_stays_the_note_s():
    own, guess = airframe.load("x500").bounds, airframe.ModelBounds()
    assert own != guess
    assert own.e_velocity_m_s > 3.0 * 0.03  # three sigma of what it is sent
    assert airframe.load("helicopter").bounds == guess  # none from a log: its filter has bounds of its own
